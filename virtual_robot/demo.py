"""``armident demo``: the whole story on one machine, told by the real processes of a plant."""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NoReturn

import yaml

from armident.configs import ArmidentError, ConfigError, SessionConfig, load_session
from armident.drivers.vcan import ensure_vcan, have_socketcan, launcher_command, launcher_obstacle

CELL = "tx40_cell.yaml"
SCENARIO = "scenarios/tx40_worn_joint2.yaml"
GUEST_VARIABLE = "ARMIDENT_GUEST"
REPEATS = 3
"""How often the second chapter runs the trajectory: an effect as small as its own needs more than one pass."""
UDP_GROUP = "239.74.163.2"
UDP_PERIOD_US = 2000
SLOW_PERIOD_US = 1000
"""For a machine that cannot run arm, bus, capture and worker at once at 5 kHz."""
MAX_LOST_SHARE = 0.02
HEARTBEAT_MS = 1000
"""Everything shares this machine: a drive that is late is not a drive that is lost."""
READY_S = 120.0
"""How long a process may take to say that it is ready; compiling its loops for the first time takes most of it."""
CHAPTER_S = 300.0
STOP_S = 10.0
TAIL_LINES = 8
PATIENT, URGENT = 19, -10
"""Nice values of the worker, and of the arm where we may: all share one CPU, and an arm cannot wait as a reader can."""
Say = Callable[[str], None]
_CHAPTER = re.compile(r"<!-- chapter begins -->(.*?)<!-- chapter ends -->", re.DOTALL)


def demo(*, out: Path, keep_going: bool = False, quick: bool = False) -> None:
    """Run both chapters and write the report.

    Parameters
    ----------
    out
        Directory of recordings, results and the report.
    keep_going
        Leave the virtual cell of the last chapter running until Ctrl-C.
    quick
        Only the first chapter.

    Raises
    ------
    ConfigError
        If the bus cannot be set up.
    ArmidentError
        If a process fails; says which, and the end of what it printed.
    """
    session = _session_for_this_machine(out, keep_going, quick)
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()

    def say(line: str) -> None:
        print(f"[{time.monotonic() - begin:5.1f} s] {line}", flush=True)

    first, session = _first_chapter(session, out, say)
    second = None if quick else _second_chapter(session, out, say)
    report = _write_report(out, first, second)
    _print_table(first, second)
    if keep_going:
        with ExitStack() as stack:
            robot = _start_robot(_write_session(session, out, "running"), out, say, stack)
            say(f"the virtual arm keeps running; Ctrl-C ends it; the report is {report}")
            robot.process.wait()
    print(f"report: {report}", flush=True)


@dataclass(frozen=True)
class Identified:
    """The first chapter's results: the document, the page, and what the virtual arm says its parameters are."""

    document: dict[str, Any]
    report: Path
    truth: dict[str, float]
    lost: int


@dataclass(frozen=True)
class Recorded:
    """A capture's file, and how many of its samples are in gaps."""

    path: Path
    lost: int
    lost_share: float


@dataclass(frozen=True)
class Diagnosed:
    """The second chapter's results."""

    document: dict[str, Any]
    report: Path


def _session_for_this_machine(out: Path, keep_going: bool, quick: bool) -> SessionConfig:
    """The demo's session on the best bus there is; starts over inside the guest where that has it."""
    session = load_session(CELL).model_copy(update={"heartbeat_ms": HEARTBEAT_MS})
    if have_socketcan():
        ensure_vcan(session.bus.channel)
        return session
    reason = "the guest has no SocketCAN" if os.environ.get(GUEST_VARIABLE) else launcher_obstacle()
    if reason is None:
        print("this kernel has no SocketCAN: running under a User-Mode Linux guest that has", flush=True)
        _start_over_in_guest(out, keep_going, quick)
    print(f"no vcan here ({reason}): running on udp_multicast at a lower rate, which may lose frames", flush=True)
    bus = session.bus.model_copy(update={"interface": "udp_multicast", "channel": UDP_GROUP})
    sync = session.sync.model_copy(update={"period_us": UDP_PERIOD_US})
    return session.model_copy(update={"bus": bus, "sync": sync})


def _start_over_in_guest(out: Path, keep_going: bool, quick: bool) -> NoReturn:
    options = ["--keep-going"] * keep_going + ["--quick"] * quick
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    if out.is_relative_to(Path.cwd()) or out.is_relative_to("/tmp"):
        command = launcher_command([*_armident(), "demo", "--out", str(out), *options])
        raise SystemExit(subprocess.run(command, check=False).returncode)
    # The guest can write below the working directory only: there the results go first.
    raise ConfigError(
        f"--out {out}: expected a folder below the working directory or /tmp, the guest writes nowhere else"
    )


def _armident() -> list[str]:
    return [sys.executable, "-m", "armident.daq.cli"]


def _first_chapter(session: SessionConfig, out: Path, say: Say) -> tuple[Identified, SessionConfig]:
    """Record and identify; at a lower rate where this machine cannot keep up. Returns the session that worked too."""
    say(f"chapter 1: a virtual TX40 is recorded at {_rate(session)} and identified")
    truth_file = out / "truth.json"
    while True:
        config = _write_session(session, out, "cell")
        options = ["--config", str(config), "--once", "--out", str(out)]
        with _running("worker", ["worker", *options], out, "worker: ready", PATIENT) as worker:
            say("worker: ready")
            recorded = _record("capture", config, out, say, ["--truth", str(truth_file)])
            slower = _slower(session)
            if recorded.lost_share > MAX_LOST_SHARE and slower is not None:
                say(
                    f"this machine is too busy for {_rate(session)}: {100 * recorded.lost_share:.0f} % of the samples "
                    f"came late or not at all; once more at {_rate(slower)}"
                )
                session = slower
                continue
            say("worker: identifying what it heard")
            worker.wait(CHAPTER_S, say)
            log = worker.text()
        break
    result, report = _line_after(log, "result: ", worker.name), _line_after(log, "report: ", worker.name)
    document = json.loads(Path(result).read_text(encoding="utf-8"))
    essential = sum(1 for p in document["parameters"] if p["essential"])
    say(f"identified: {essential} essential parameters, relative torque error {document['relative_error_pct']:.1f} %")
    truth = json.loads(truth_file.read_text(encoding="utf-8"))
    return Identified(document, Path(report), truth, recorded.lost), session


def _second_chapter(session: SessionConfig, out: Path, say: Say) -> Diagnosed:
    say("chapter 2: the same arm with an effect hidden in it; nobody tells the diagnosis which")
    if session.setpoints is not None:
        session = session.model_copy(update={"setpoints": session.setpoints.model_copy(update={"repeat": REPEATS})})
    config = _write_session(session, out, "cell_worn")
    recorded = _record("capture_worn", config, out, say, ["--scenario", SCENARIO])
    say("diagnosing")
    folder = out / "diagnosis"
    with _running("diagnose", ["diagnose", str(recorded.path), "--out", str(folder), "--json"], out) as diagnosis:
        diagnosis.wait(CHAPTER_S, say, accepted=(0, 4))
    document = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    for finding in document["findings"]:
        say(
            f"found: {finding['effect'].replace('_', ' ')} in {finding['joint']}; its torque error on held-out data "
            f"{finding['gap_before']:.2f} % -> {finding['gap_after']:.2f} %"
        )
    if not document["findings"]:
        say(f"nothing found: verdict {document['verdict']}")
    return Diagnosed(document, folder / "report.html")


def _record(name: str, config: Path, out: Path, say: Say, robot_options: Sequence[str]) -> Recorded:
    """Start the virtual arm, capture it to the end of its trajectory, and stop it."""
    with ExitStack() as stack:
        _start_robot(config, out, say, stack, robot_options)
        options = ["--config", str(config), "--out", str(out / "recordings"), "--json"]
        capture = stack.enter_context(_running(name, ["capture", *options], out))
        # A drive whose heartbeat comes too late ends a capture with 1: on a busy machine that is one more lost sample.
        capture.wait(CHAPTER_S, say, accepted=(0, 1))
        said = next((json.loads(line) for line in capture.text().splitlines() if line.startswith('{"recording"')), None)
        if said is None or (capture.process.returncode and not said["counters"]["samples.in_gaps"]):
            raise capture.failed(f"ended with exit code {capture.process.returncode}")
    counters = said["counters"]
    got, lost = counters["samples.rows"], counters["samples.in_gaps"]
    return Recorded(Path(said["recording"]), lost, lost / max(got + lost, 1))


def _slower(session: SessionConfig) -> SessionConfig | None:
    """The same session at the demo's lower rate, set points on every SYNC; ``None`` if it is slow already."""
    if session.sync.period_us >= SLOW_PERIOD_US:
        return None
    return _at_period(session, SLOW_PERIOD_US)


def _at_period(session: SessionConfig, period_us: int) -> SessionConfig:
    return session.model_copy(
        update={
            "sync": session.sync.model_copy(update={"period_us": period_us}),
            "streams": {name: s.model_copy(update={"every": 1}) for name, s in session.streams.items()},
            "setpoints": session.setpoints and session.setpoints.model_copy(update={"every": 1}),
        }
    )


def _rate(session: SessionConfig) -> str:
    return f"{1 / session.sync_period:.0f} Hz"


def _start_robot(config: Path, out: Path, say: Say, stack: ExitStack, options: Sequence[str] = ()) -> "_Process":
    niceness = URGENT if os.geteuid() == 0 else 0
    robot = stack.enter_context(_running("robot", ["robot", "--config", str(config), *options], out, "ready", niceness))
    say(f"robot: {robot.text().strip().splitlines()[-1]}")
    return robot


def _write_session(session: SessionConfig, out: Path, name: str) -> Path:
    """A session file with absolute paths."""
    path = out / f"{name}.yaml"
    path.write_text(yaml.safe_dump(session.model_dump(mode="json", by_alias=True), sort_keys=False), encoding="utf-8")
    return path


class _Process:
    """A command of ours, running, with everything it prints in a file."""

    def __init__(self, name: str, arguments: Sequence[str], out: Path, niceness: int) -> None:
        self.name = name
        self._seen: list[str] = []
        logs = out / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        self.log = logs / f"{name}.log"
        environment = dict(os.environ)
        if cache := environment.get("NUMBA_CACHE_DIR"):
            # The one cache folder that a guest can write to serves matplotlib's fonts too.
            environment.setdefault("MPLCONFIGDIR", str(Path(cache) / "matplotlib"))
        with self.log.open("wb") as output:
            self.process = subprocess.Popen(
                [*(("nice", "-n", str(niceness)) if niceness else ()), *_armident(), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
            )

    def text(self) -> str:
        """Read what it has printed so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def wait_for(self, line_start: str, seconds: float) -> None:
        """Wait until it prints a line that begins so."""
        until = time.monotonic() + seconds
        while not any(line.startswith(line_start) for line in self._seen):
            self._seen = self.text().splitlines()
            if self.process.poll() is not None:
                raise self.failed(f"ended with exit code {self.process.returncode} before it was ready")
            if time.monotonic() > until:
                raise self.failed(f"was not ready within {seconds:.0f} s")
            time.sleep(0.1)

    def wait(self, seconds: float, say: Say, accepted: Sequence[int] = (0,)) -> None:
        """Wait for its end and pass on what it prints on the way."""
        until, shown = time.monotonic() + seconds, len(self._seen)
        while True:
            code = self.process.poll()
            lines = self.text().splitlines()
            for line in lines[shown:]:
                if not line.startswith(("{", " ", "}")) and len(line) < 160:
                    say(f"{self.name}: {line.removeprefix(self.name + ': ')}")
            shown = len(lines)
            if code is not None:
                break
            if time.monotonic() > until:
                raise self.failed(f"did not end within {seconds:.0f} s")
            time.sleep(0.2)
        if code not in accepted:
            raise self.failed(f"ended with exit code {code}")

    def stop(self) -> None:
        """Ask it to end, and make it."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()

    def failed(self, how: str) -> ArmidentError:
        """Build the error of this process, with the end of what it printed."""
        tail = [line.strip() for line in self.text().splitlines() if line.strip()][-TAIL_LINES:]
        return ArmidentError(f"demo: {self.name} {how} (log: {self.log}): {' | '.join(tail) or 'it printed nothing'}")


@contextmanager
def _running(
    name: str, arguments: Sequence[str], out: Path, ready: str | None = None, niceness: int = 0
) -> Iterator[_Process]:
    process = _Process(name, arguments, out, niceness)
    try:
        if ready is not None:
            process.wait_for(ready, READY_S)
        yield process
    finally:
        process.stop()


def _line_after(text: str, start: str, who: str) -> str:
    for line in text.splitlines():
        if line.startswith(start):
            return line.removeprefix(start).strip()
    raise ArmidentError(f"demo: {who} did not say where its {start.strip(': ')} is")


def _write_report(out: Path, first: Identified, second: Diagnosed | None) -> Path:
    """One page of both chapters, from the pages that the commands wrote."""
    page = first.report.read_text(encoding="utf-8")
    chapters = [_chapter(page)] + ([] if second is None else [_chapter(second.report.read_text(encoding="utf-8"))])
    head = page[: page.index("<!-- chapter begins -->")]
    tail = page[page.index("<!-- chapter ends -->") :].removeprefix("<!-- chapter ends -->")
    path = out / "report.html"
    handle, temporary = tempfile.mkstemp(dir=out, prefix=".report.")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(head + _SUMMARY.substitute(_summary(first, second)))
        file.write("".join(f'<section style="margin-top:56px">{chapter}</section>' for chapter in chapters) + tail)
    os.chmod(temporary, 0o644)
    os.replace(temporary, path)
    return path


def _chapter(page: str) -> str:
    found = _CHAPTER.search(page)
    if found is None:
        raise ArmidentError("demo: a report has no chapter to take over")
    return found.group(1)


_SUMMARY = Template("""
<h1>armident: what just happened on this machine</h1>
<p class="sub">A virtual Staubli TX40, its drives and its bus were started; everything else is what runs in a plant.</p>
<ol>
<li>The arm's six drives were configured over CANopen and recorded at $rate samples per second: $rows samples of each of
$joints joints, $gaps lost.</li>
<li>A worker heard the samples on Zenoh and identified the arm's dynamic model: $essential parameters matter, the model
predicts the torques to $error %, and $close of the $compared parameters that can be compared with the virtual arm's
own lie within three standard deviations of them (the farthest: $worst).</li>
$second
</ol>
""")


def _summary(first: Identified, second: Diagnosed | None) -> dict[str, str]:
    document = first.document
    compared = _against_truth(first)
    worst = max(compared, key=lambda row: abs(row[4]), default=None)
    line = ""
    if second is not None:
        found = second.document["findings"]
        names = ", ".join(f"{f['effect'].replace('_', ' ')} in {f['joint']}" for f in found) or "nothing"
        gap = second.document["gap"]["validation"]
        line = (
            f"<li>Then an effect was hidden in the arm. The diagnosis, which was not told, found: "
            f"<b>{escape(names)}</b>. On data it had not seen the torque error went from "
            f"{gap['before']['all']:.2f} % to {gap['after']['all']:.2f} %; "
            f"the noise floor is {second.document['noise_floor']['all']:.2f} %.</li>"
        )
    counters = {} if worst is None else {"worst": f"{worst[0]}, {abs(worst[4]):.1f}"}
    return {
        "rate": f"{document['recording']['sample_rate_hz']:.0f}",
        "rows": str(document["recording"]["samples"]),
        "joints": str(len(document["relative_error_pct_by_joint"])),
        "gaps": str(first.lost or "none"),
        "essential": str(sum(1 for p in document["parameters"] if p["essential"])),
        "error": f"{document['relative_error_pct']:.1f}",
        "close": str(sum(1 for row in compared if abs(row[4]) <= 3)),
        "compared": str(len(compared)),
        "worst": "none",
        "second": line,
        **counters,
    }


def _against_truth(first: Identified) -> list[tuple[str, float, float, float, float]]:
    """Essential parameters: name, value, standard deviation, the plant's own, and the distance in deviations."""
    return [
        (p["name"], p["value"], p["std"], first.truth[p["name"]], (p["value"] - first.truth[p["name"]]) / p["std"])
        for p in first.document["parameters"]
        if p["essential"] and p["name"] in first.truth and p["std"] > 0
    ]


def _print_table(first: Identified, second: Diagnosed | None) -> None:
    print(f"\n{'parameter':>10} {'identified':>11} {'+- std':>9} {'true':>9} {'off by':>9}")
    for name, value, std, truth, distance in _against_truth(first):
        print(f"{name:>10} {value:11.4f} {std:9.4f} {truth:9.4f} {distance:5.1f} std")
    if second is not None:
        gap = second.document["gap"]["validation"]
        print(f"\nhidden effect: {second.document['verdict'].replace('_', ' ')}")
        for f in second.document["findings"]:
            print(
                f"  {f['effect']} in {f['joint']}: {f['gap_before']:.2f} % -> {f['gap_after']:.2f} % on held-out data"
            )
        print(f"  all joints: {gap['before']['all']:.2f} % -> {gap['after']['all']:.2f} %\n")
