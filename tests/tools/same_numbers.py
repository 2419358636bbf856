"""Proof that a renovation changed no number: the same commands before and after it, and their documents compared.

``python -m tests.tools.same_numbers record --armident COMMAND --data FOLDER --out DIR`` runs the command line only. It
leaves one folder per case in DIR, with the documents, and with exit code and message in ``run.json``.

``python -m tests.tools.same_numbers compare BEFORE AFTER`` prints one line per case. Its exit code is 1 if anything
differs.

``record`` makes its recordings itself, with fixed seeds, so that importing and the virtual arm are part of the proof.
With ``--recordings DIR`` it takes those of an earlier call instead, ``OUT/recordings`` there. Both are possible: every
version reads them, and ``compare`` says where the samples of two recordings differ.

Keys and words that the renovation renames stand in ``KEYS`` and ``VALUES``. Either folder may have old or new names.
"""

import argparse
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armident.identify.estimators.methods import METHODS

KEYS = {
    "gap_foretold": "gap_without_derivative_noise",
    "could_hide": "detection_limits",
    "torque_foretold": "torque_without_derivative_noise",
    "says": "description",
    "confidence_with_equals": "confidence_with_ambiguous",
    "better_without_name": "better_unnamed_dependences",
    "equally_good": "equally_likely",
    "needs": "required_motion",
    "below": "limits",
}
"""Renamed keys of documents, old to new, wherever they stand."""

VALUES = {
    "armident/diagnosis/1": "armident/diagnosis/2",
    "time, in bursts": "transients",
}
"""Renamed words in the values of documents, old to new, also inside a longer text."""

OPTIONAL = {"further_recordings", "considered"}
"""Keys that older or newer documents lack; null and an empty list count as absent."""

EXTENDED = {"criteria"}
"""Mappings to which newer documents add keys."""

SKIPPED = {"timing_s", "versions", "path", "sha256"}
"""Keys whose values may differ wherever they stand: they tell of a run and its machine."""

SKIPPED_AT_TOP = {"model"}
"""The same for keys of the first level: a path, too."""

PROSE = {
    "warnings", "hint", "description", "title", "reference", "reason", "required_motion", "recommended_experiment",
    "stop_reason", "equally_likely",
}  # fmt: skip
"""Keys of sentences for people: their wording may change, the numbers in them may not."""

TOLERANCE = 1e-9
"""Relative difference up to which two numbers are the same."""

SHOWN = 5
"""Differences that are printed for each case."""

DOCUMENTS = ("identification.json", "diagnosis.json")
RUN = "run.json"
RECORDINGS = "recordings"
DONE = (0, 4)
"""Exit codes of a command that has written its document."""

CELL = ("robot", "--config", "tx40_cell.yaml")
WORN = ("--scenario", "scenarios/tx40_worn_joint2.yaml")
GRIPPER = ("--scenario", "scenarios/tx40_gripper_and_loose_belt.yaml")
MISWIRED = ("--scenario", "scenarios/tx40_miswired.yaml")

TAKES: dict[str, tuple[str, ...]] = {
    "tx40": (
        "import", "{data}/tx40/pos_read_data.csv", "--effort", "{data}/tx40/curr_data.csv", "--config", "tx40.yaml",
        "--motor-side", "--rate", "5000", "--out",
    ),
    "emps": ("import", "{data}/emps/DATA_EMPS.mat", "--config", "emps.yaml", "--out"),
    "panda": (
        "import", "{data}/panda/exciting_traj_positions.txt", "--effort", "{data}/panda/exciting_traj_torques.txt",
        "--config", "panda.yaml", "--polled", "--rate", "1000", "--out",
    ),
    "virtual": (*CELL, "--seed", "1", "--to-file"),
    "healthy": (*CELL, "--seed", "2", "--to-file"),
    # The demo repeats its trajectory three times; --to-file runs it once, so there are three recordings.
    "worn_1": (*CELL, *WORN, "--seed", "11", "--to-file"),
    "worn_2": (*CELL, *WORN, "--seed", "12", "--to-file"),
    "worn_3": (*CELL, *WORN, "--seed", "13", "--to-file"),
    "gripper": (*CELL, *GRIPPER, "--seed", "21", "--to-file"),
    "transients": (*CELL, *GRIPPER, "--seed", "1", "--to-file"),
    "miswired": (*CELL, *MISWIRED, "--seed", "31", "--to-file"),
}  # fmt: skip
"""Recordings and the arguments that make them; the file to write comes last."""


@dataclass(frozen=True)
class Case:
    """One command whose document is kept.

    ``command``: ``identify`` or ``diagnose``; ``recordings``: keys of ``TAKES``; ``options``: further arguments;
    ``needs``: case whose document the options name.
    """

    name: str
    command: str
    recordings: tuple[str, ...]
    options: tuple[str, ...] = ()
    needs: str | None = None

    @property
    def arguments(self) -> list[str]:
        """Arguments of the command, paths relative to the folder of all cases."""
        return [self.command, *map(recording_file, self.recordings), *self.options, "--out", self.name]


def recording_file(name: str) -> str:
    """Path of a recording, relative to the folder of all cases."""
    return f"{RECORDINGS}/{name}.mcap"


BASELINE = "virtual-idim-piv"

CASES: tuple[Case, ...] = (
    *(
        Case(f"{arm}-{method}", "identify", (arm,), ("--method", method))
        for arm in ("tx40", "emps", "panda")
        for method in ("idim-ls", "idim-piv")
    ),
    *(Case(f"virtual-{method}", "identify", ("virtual",), ("--method", method)) for method in METHODS),
    Case("diagnose-worn", "diagnose", ("worn_1", "worn_2", "worn_3")),
    Case("diagnose-healthy", "diagnose", ("healthy",)),
    # With the first seed a structure and numbers are found; with the second something is left that comes in bursts.
    *(
        Case(
            f"diagnose-{take}-baseline",
            "diagnose",
            (take,),
            ("--baseline", f"{BASELINE}/identification.json"),
            needs=BASELINE,
        )
        for take in ("gripper", "transients")
    ),
    # Beyond the stories of the demo: mistakes of wiring, and a measured machine that leaves something unexplained.
    Case("diagnose-miswired", "diagnose", ("miswired",)),
    Case("diagnose-emps", "diagnose", ("emps",)),
)


def record(armident: Path, data: Path, out: Path, recordings: Path | None, cases: Sequence[Case]) -> int:
    """Make the recordings, run the cases, and keep what comes out.

    ``data``: folder of the measured data. ``out``: folder of all cases; made if it is absent. Its recordings are used
    if it has any, its cases are run again. ``recordings``: folder of recordings to use; those that it lacks are made.
    ``cases``: what to run. Returns the exit code: 1 if a recording could not be made.
    """
    (out / RECORDINGS).mkdir(parents=True, exist_ok=True)
    for name in dict.fromkeys(name for case in cases for name in case.recordings):
        if (problem := provide(name, armident, data, out, recordings)) is not None:
            print(f"{name}: {problem}", file=sys.stderr)
            return 1
    for case in cases:
        folder = out / case.name
        if folder.exists():
            shutil.rmtree(folder)
        begin = time.monotonic()
        code, message = run(armident, case.arguments, out)
        seconds = time.monotonic() - begin
        folder.mkdir(exist_ok=True)
        told = {"arguments": case.arguments, "exit": code, "message": message, "seconds": round(seconds, 1)}
        (folder / RUN).write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
        print(f"{case.name}: exit code {code}, {seconds:.0f} s{f', {message}' if message else ''}", flush=True)
    return 0


def provide(name: str, armident: Path, data: Path, out: Path, recordings: Path | None) -> str | None:
    """Put a recording where the cases look for it. Returns what went wrong."""
    target = out / recording_file(name)
    if recordings is not None and (kept := recordings / target.name).is_file():
        if kept.resolve() != target.resolve():
            shutil.copyfile(kept, target)
        print(f"{target.name}: from {recordings}", flush=True)
        return None
    if target.is_file():
        print(f"{target.name}: there already", flush=True)
        return None
    # Under another name until it is complete: an interrupted call leaves nothing that looks like a recording.
    unfinished = target.with_name(f"unfinished_{target.name}")
    unfinished.unlink(missing_ok=True)
    arguments = [part.format(data=data) for part in TAKES[name]]
    code, message = run(armident, [*arguments, str(unfinished.relative_to(out))], out)
    if code:
        return f"exit code {code}, {message}"
    unfinished.replace(target)
    print(f"{target.name}: made", flush=True)
    return None


def run(armident: Path, arguments: Sequence[str], folder: Path) -> tuple[int, str]:
    """Run the command in a folder.

    Returns the exit code, and the last line on standard error if the command did not do its work.
    """
    done = subprocess.run(
        [str(armident), *arguments],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        # Whatever the terminal, a message is one line.
        env={**os.environ, "COLUMNS": "1000", "NO_COLOR": "1"},
        check=False,
    )
    if done.returncode in DONE:
        return done.returncode, ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return done.returncode, lines[-1] if lines else "no message"


def renamed(value: Any) -> Any:
    """Return a document's value with the new keys and words in place of the old ones."""
    if isinstance(value, dict):
        return {KEYS.get(key, key): renamed(item) for key, item in value.items()}
    if isinstance(value, list):
        return [renamed(item) for item in value]
    if isinstance(value, str):
        for old, new in VALUES.items():
            value = value.replace(old, new)
    return value


def is_number(value: Any) -> bool:
    """Return True for a number; true and false are not numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_array(value: Any) -> bool:
    """Return True for a list of numbers or of such lists; null stands for a number that is not finite."""
    return isinstance(value, list) and all(item is None or is_number(item) or is_array(item) for item in value)


def largest(array: Iterable[Any]) -> float:
    """Return the largest magnitude in an array."""
    return max((largest(a) if isinstance(a, list) else abs(a) for a in array if a is not None), default=0.0)


@dataclass
class Comparison:
    """Two documents, value by value.

    A difference is taken relative to the larger of the two numbers, or to a floor if that is larger still. Floors stand
    where rounding is proportional to something else than the number itself:

    - a parameter's standard deviation, for its value. A parameter that the data do not determine is a small difference
      of large numbers. Of its value only what exceeds a billionth of that deviation means anything.
    - the square of a relative standard deviation, percent, over 100. It is 100 std / value: an error of a billionth of
      std in the value changes it that much.
    - the square root of the product of the two variances, for an entry of a covariance matrix. No entry can be larger,
      and the correlation is what rounding leaves at full precision.
    - the largest entry of an array, for its other entries, for example the coefficients of a filter: they act together.
    """

    numbers: int = 0
    largest: float = 0.0
    reworded: int = 0
    differences: list[str] = field(default_factory=list)

    def documents(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
        """Compare two documents, with old or new names."""
        old, new = renamed(dict(before)), renamed(dict(after))
        found, told = findings(old), findings(new)
        if found != told:
            # Without the same findings in the same order hardly any number can be the same.
            self.differ("findings", found, told)
            self.values(old.get("verdict"), new.get("verdict"), "verdict")
            return
        for document in (old, new):
            for key in SKIPPED_AT_TOP:
                document.pop(key, None)
        self.values(old, new, "")

    def differ(self, where: str, before: object, after: object) -> None:
        """Note a difference."""
        self.differences.append(f"{where or 'document'}: {shown(before)} -> {shown(after)}")

    def values(self, before: Any, after: Any, where: str, floor: float = 0.0) -> None:
        """Compare two values of any kind; ``floor`` is the least scale of a number."""
        if is_number(before) and is_number(after):
            self.number(before, after, where, floor)
        elif isinstance(before, dict) and isinstance(after, dict):
            self.mappings(before, after, where)
        elif isinstance(before, list) and isinstance(after, list):
            self.lists(before, after, where, floor)
        elif type(before) is not type(after) or before != after:
            self.differ(where, before, after)

    def number(self, before: float, after: float, where: str, floor: float) -> None:
        """Compare two numbers."""
        self.numbers += 1
        scale = max(abs(before), abs(after), floor)
        relative = abs(after - before) / scale if scale > 0 else 0.0
        self.largest = max(self.largest, relative)
        # Not "greater than": a NaN differs.
        if not relative <= TOLERANCE:
            self.differences.append(f"{where}: {before!r} -> {after!r} (relative {relative:.1e})")

    def mappings(self, before: Mapping[str, Any], after: Mapping[str, Any], where: str) -> None:
        """Compare two objects, key by key."""
        for key in [*before, *(key for key in after if key not in before)]:
            place = f"{where}.{key}" if where else key
            if key in SKIPPED or (key in OPTIONAL and not before.get(key) and not after.get(key)):
                continue
            if key not in before and where.rpartition(".")[2] in EXTENDED:
                continue
            if key not in before or key not in after:
                self.differences.append(f"{place}: only {'before' if key in before else 'after'}")
            elif key in PROSE:
                self.prose(before[key], after[key], place)
            elif key == "covariance":
                self.covariances(before[key], after[key], place)
            else:
                self.values(before[key], after[key], place, floor_of(key, before))

    def lists(self, before: Sequence[Any], after: Sequence[Any], where: str, floor: float) -> None:
        """Compare two lists, entry by entry."""
        if len(before) != len(after):
            self.differ(f"{where}, number of entries", len(before), len(after))
            return
        if is_array(before):
            floor = max(floor, largest(before))
        for k, (one, other) in enumerate(zip(before, after, strict=True)):
            self.values(one, other, f"{where}[{label(one, k)}]", floor)

    def covariances(self, before: list[list[float]], after: list[list[float]], where: str) -> None:
        """Compare two covariance matrices, entries in units of the two standard deviations."""
        if [len(row) for row in before] != [len(row) for row in after]:
            self.differ(f"{where}, number of entries", len(before), len(after))
            return
        std = [math.sqrt(abs(row[k])) for k, row in enumerate(before)]
        for i, (one, other) in enumerate(zip(before, after, strict=True)):
            for j, (a, b) in enumerate(zip(one, other, strict=True)):
                self.values(a, b, f"{where}[{i}][{j}]", std[i] * std[j])

    def prose(self, before: Any, after: Any, where: str) -> None:
        """Compare the numbers in two texts, or in two lists of texts."""
        if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
            for k, (one, other) in enumerate(zip(before, after, strict=True)):
                self.prose(one, other, f"{where}[{k}]")
        elif isinstance(before, str) and isinstance(after, str):
            self.reworded += before != after
            told = [[float(n) for n in NUMBER.findall(text)] for text in (before, after)]
            if told[0] != told[1]:
                self.differ(f"{where}, numbers in the text", before, after)
        elif before != after:
            self.differ(where, before, after)


NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""A number in a text; the digit of a name, as in ``joint_2``, is none."""


def shown(value: object) -> str:
    """Return a value as a line shows it."""
    text = json.dumps(value)
    return text if len(text) <= 160 else f"{text[:157]}..."


def label(entry: Any, position: int) -> str:
    """Return what an entry of a list is called: by its names where it has any."""
    if not isinstance(entry, dict):
        return str(position)
    names = [entry[key] for key in ("name", "parameter", "effect", "joint", "other") if isinstance(entry.get(key), str)]
    return " ".join(names) or str(position)


def floor_of(key: str, entry: Mapping[str, Any]) -> float:
    """Return the least scale of an entry's number, as `Comparison` justifies it."""
    std, value = entry.get("std"), entry.get(key)
    if key == "value" and is_number(std):
        return abs(float(std or 0.0))
    if key == "relative_std_pct" and is_number(value):
        return float(value or 0.0) ** 2 / 100
    return 0.0


def findings(document: Mapping[str, Any]) -> list[str]:
    """Return effect, joints and kind of every finding, in order."""
    return [
        " ".join(str(f[key]) for key in ("effect", "joint", "other", "kind") if f.get(key) is not None)
        for f in document.get("findings", [])
    ]


def remarks(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Return what is no difference of a result and may explain one: other samples, other libraries."""
    said = []
    one, other = ([r["sha256"] for r in d.get("recordings", [d.get("recording")]) if r] for d in (before, after))
    if one != other:
        said.append("from other samples")
    old, new = before.get("versions", {}), after.get("versions", {})
    said += [f"{name} {old.get(name)} -> {new.get(name)}" for name in old | new if old.get(name) != new.get(name)]
    return said


def compare_case(before: Path, after: Path) -> tuple[str, list[str]]:
    """Compare the folders of one case. Returns what was compared, and the differences."""
    if absent := [str(folder) for folder in (before, after) if not (folder / RUN).is_file()]:
        return "nothing compared", [f"no {RUN} in {folder}" for folder in absent]
    old, new = (json.loads((folder / RUN).read_text(encoding="utf-8")) for folder in (before, after))
    found = Comparison()
    words = [f"exit code {old['exit']}"]
    for key in ("exit", "message", "arguments"):
        if old[key] != new[key]:
            found.differ(key, old[key], new[key])
    names = [name for name in DOCUMENTS if (before / name).is_file() or (after / name).is_file()]
    if old["exit"] in DONE and not names:
        found.differences.append("no document, though the command did its work")
    if old["message"]:
        words.append(shown(old["message"]))
    for name in names:
        if not ((before / name).is_file() and (after / name).is_file()):
            found.differences.append(f"{name}: only {'before' if (before / name).is_file() else 'after'}")
            continue
        one, other = (json.loads((folder / name).read_text(encoding="utf-8")) for folder in (before, after))
        found.documents(one, other)
        words.append(name)
        if "verdict" in one:
            words += [f"verdict {one['verdict']}", f"findings [{', '.join(findings(one))}]"]
        words += remarks(one, other)
    if names:
        words += [f"{found.numbers} numbers", f"largest relative difference {found.largest:.1e}"]
    if found.reworded:
        words.append(f"{found.reworded} texts reworded")
    return ", ".join(words), found.differences


def compare(before: Path, after: Path, only: Sequence[str]) -> int:
    """Compare all cases of two folders and print a line for each.

    ``before``, ``after``: what ``record`` wrote. ``only``: names of cases; empty: all that either folder has. Returns
    the exit code: 0 if nothing differs, 1 if anything does, 2 if there is nothing to compare.
    """
    there = {path.parent.name for folder in (before, after) for path in folder.glob(f"*/{RUN}")}
    known = [case.name for case in CASES]
    names = list(only) or [*(name for name in known if name in there), *sorted(there - set(known))]
    if not names:
        print(f"no cases in {before} and {after}", file=sys.stderr)
        return 2
    differing = 0
    for name in names:
        words, differences = compare_case(before / name, after / name)
        outcome = f"{len(differences)} DIFFERENCES" if differences else "OK"
        print(f"{name}: {words}: {outcome}")
        for line in differences[:SHOWN]:
            print(f"    {line}")
        differing += bool(differences)
    print(f"{len(names) - differing} of {len(names)} cases are the same")
    return 1 if differing else 0


def chosen(only: Sequence[str]) -> list[Case]:
    """Return the cases of these names, with those that they need; all without names."""
    wanted = set(only) or {case.name for case in CASES}
    wanted |= {case.needs for case in CASES if case.name in wanted and case.needs is not None}
    return [case for case in CASES if case.name in wanted]


def main() -> int:
    """Carry out the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.same_numbers",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    every = [case.name for case in CASES]
    making = commands.add_parser("record", help="run all cases and keep their documents")
    making.add_argument(
        "--armident", type=Path, default=Path(sys.executable).with_name("armident"),
        help="the command; default: the one beside this Python",
    )  # fmt: skip
    making.add_argument("--data", type=Path, required=True, help="folder of the measured data")
    making.add_argument("--out", type=Path, required=True, help="folder to write, one folder per case")
    making.add_argument("--recordings", type=Path, help="folder of recordings to use instead of making them")
    making.add_argument("--only", nargs="+", choices=every, default=[], metavar="CASE", help="default: all cases")
    judging = commands.add_parser("compare", help="compare two such folders")
    judging.add_argument("before", type=Path)
    judging.add_argument("after", type=Path)
    judging.add_argument("--only", nargs="+", choices=every, default=[], metavar="CASE", help="default: all cases")
    given = parser.parse_args()
    if given.command == "compare":
        return compare(given.before, given.after, given.only)
    for path in (given.armident, given.data, given.recordings):
        if path is not None and not path.exists():
            parser.error(f"{path}: no such file or folder")
    # Not resolved: the command of a virtual environment may be a link.
    armident, data = given.armident.absolute(), given.data.resolve()
    return record(armident, data, given.out.resolve(), given.recordings, chosen(given.only))


if __name__ == "__main__":
    sys.exit(main())
