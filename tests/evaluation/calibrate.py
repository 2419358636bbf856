"""Calibration of a diagnosis on development arms: ``python -m tests.evaluation.calibrate DIR [DIR ...]``.

DIR has the results of ``python -m tests.evaluation --arms random --half development --out DIR``. The command fits the
map from evidence to probabilities and the level of the sets, prints how well both hold for arms that took no part
(cross-fitted), and writes ``identify/diagnosis/calibration.json``. With ``--several``, DIR has the investigations of
``python -m tests.evaluation.asking --half development --out DIR``: their diagnoses have a map of their own.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from armident.identify.diagnosis.probabilities import (
    FILE,
    NOTHING,
    STATES,
    Calibration,
    features,
    joint_outcomes,
    joint_state,
    outcomes,
)
from armident.identify.documents.diagnosis import DiagnosisDocument, Finding
from armident.identify.documents.files import load_document
from armident.identify.effects.unnamed import NAME as UNNAMED
from tests.evaluation.cases import VISIBLE
from tests.evaluation.run import RESULTS
from tests.evaluation.store import Store
from tests.tools.markdown import table

Array = NDArray[np.float64]

FOLDS = 10
"""Folds of the arms for the cross-fitted figures."""
COVERAGE = 0.9
"""Share of the sets that hold the truth."""
PENALTY = 0.5
"""Penalty of the squared weights of the standardised evidence, nats: a prior of one standard deviation."""
PRIOR = 0.5
"""Count added to each outcome of a state (Jeffreys)."""
TEMPERS = (0.03, 0.1, 0.2, 0.3, 0.5, 1.0)
"""Powers of the odds among other names that are tried."""
DRAWS = 400
"""Draws of right and wrong findings for the error of calibration by chance."""
BINS, PER_BIN = 10, 10
"""Most bins with equal numbers of findings in the table of calibration, and fewest findings of one."""


@dataclass(frozen=True)
class Entry:
    """Result of a diagnosis at one joint of a case, and the true outcome there.

    ``finding`` is ``None`` at a joint without one; ``state``: see `STATES`. ``visible``: a visible effect is here.
    """

    case: int
    state: str
    finding: Finding | None
    truth: str
    visible: bool

    @property
    def right(self) -> bool:
        """True if the finding has the right name."""
        return self.finding is not None and self.truth == self.finding.effect

    def outcomes(self, known: Calibration) -> dict[str, float]:
        """Probability of every outcome."""
        return joint_outcomes(self.state, known) if self.finding is None else outcomes(self.finding, known)


def entries_of(number: int, document: DiagnosisDocument, hidden: Mapping[str, Any]) -> Iterator[Entry]:
    """Entries of one case: findings of the selection, and joints without any finding."""
    accepted, joints = set(hidden["accepted"]), set(hidden["joints"])
    healthy = hidden["family"] == "healthy"
    seen = not healthy and hidden["visibility"] >= VISIBLE
    taken: set[str | None] = set()
    explained = healthy
    for finding in document.findings:
        places = {finding.joint, finding.other}
        taken |= places
        here = not explained and (not joints or not joints.isdisjoint(places))
        rivals = sorted(accepted & set(finding.evidence.get("odds", {})))
        truth = NOTHING
        if here:
            truth = finding.effect if finding.effect in accepted else (*rivals, UNNAMED)[0]
        if "odds" in finding.evidence:
            yield Entry(number, "unnamed" if finding.effect == UNNAMED else "named", finding, truth, seen and here)
        explained |= truth == finding.effect
    left = {each.joint for each in document.unexplained}
    for joint in document.gap.validation.after.by_joint:
        # What acts on the whole arm may be found at any joint.
        if joint not in taken and (joints or explained):
            here = not explained and joint in joints
            state = joint_state(joint in left, bool(document.findings))
            yield Entry(number, state, None, UNNAMED if here else NOTHING, seen and here)


def fitted(entries: Sequence[Entry]) -> Calibration:
    """Calibration of the probabilities on entries, without a level."""
    named = [e for e in entries if e.finding is not None and e.state == "named"]
    rows = [features(e.finding) for e in named if e.finding is not None]
    x, y = np.array([[*row.values()] for row in rows]), np.array([float(e.right) for e in named])
    mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-9)
    z = (x - mean) / scale

    def loss(w: Array) -> float:
        value = w[0] + z @ w[1:]
        return float(np.sum(np.logaddexp(0.0, value) - y * value) + PENALTY * np.sum(w[1:] ** 2))

    # More evidence never makes a name less probable.
    bounds = [(None, None), *((0.0, None) for _ in range(z.shape[1]))]
    w = optimize.minimize(loss, np.zeros(z.shape[1] + 1), bounds=bounds, method="L-BFGS-B").x
    weights = w[1:] / scale
    shares = {state: _shares([e for e in entries if e.state == state and not e.right]) for state in STATES}
    known = Calibration(
        float(w[0] - mean @ weights), dict(zip(rows[0], map(float, weights), strict=True)), shares, 1.0, 1.0
    )
    return max((replace(known, temper=t) for t in TEMPERS), key=lambda c: _likelihood(entries, c))


def _shares(entries: Sequence[Entry]) -> dict[str, float]:
    counts = {"rival": PRIOR, UNNAMED: PRIOR, NOTHING: PRIOR}
    for entry in entries:
        counts[entry.truth if entry.truth in counts else "rival"] += 1.0
    return {name: count / sum(counts.values()) for name, count in counts.items()}


def _likelihood(entries: Sequence[Entry], known: Calibration) -> float:
    return sum(float(np.log(max(e.outcomes(known).get(e.truth, 0.0), 1e-12))) for e in entries)


def needed_level(entry: Entry, known: Calibration) -> float:
    """Sum of the probabilities of all outcomes more probable than the truth: a set of a higher level holds it."""
    names = entry.outcomes(known)
    own = names.get(entry.truth, 0.0)
    return sum(p for p in names.values() if p > own)


def with_level(known: Calibration, scores: Sequence[float]) -> Calibration:
    """Calibration with the level at which sets hold the truth in `COVERAGE` of new cases (split conformal)."""
    rank = int(np.ceil((len(scores) + 1) * COVERAGE))
    conformal = float(np.sort(scores)[min(rank, len(scores)) - 1]) if scores else COVERAGE
    # By its own probabilities, a set holds as much, too.
    return replace(known, level=float(np.clip(np.nextafter(conformal, 1.0), COVERAGE, 1.0)))


def calibrated(entries: Sequence[Entry]) -> Calibration:
    """Calibration on all entries; the level from cross-fitted probabilities."""
    scores = [needed_level(e, known) for e, known in cross_fitted(entries) if e.state != "clear"]
    return with_level(fitted(entries), scores)


def cross_fitted(entries: Sequence[Entry]) -> list[tuple[Entry, Calibration]]:
    """Entries, each with a calibration on other arms."""
    made = {k: fitted([e for e in entries if e.case % FOLDS != k]) for k in range(FOLDS)}
    return [(e, made[e.case % FOLDS]) for e in entries]


@dataclass(frozen=True)
class Figures:
    """Figures of probabilities and sets; ``ece``: expected calibration error, ``by_chance``: if they were right.

    ``coverage``: share of the sets that hold the truth; ``visible``: of those of visible effects.
    """

    cases: int
    findings: int
    right: float
    ece: float
    by_chance: float
    sets: int
    coverage: float
    visible: float
    size: float


def figures(entries: Sequence[Entry], rows: list[tuple[str, ...]]) -> Figures:
    """Figures of cross-fitted calibrations; appends the rows of the table of calibration."""
    pairs = cross_fitted(entries)
    scores = {
        k: [needed_level(e, c) for e, c in pairs if e.state != "clear" and e.case % FOLDS != k] for k in range(FOLDS)
    }
    levelled = [(e, with_level(c, scores[e.case % FOLDS])) for e, c in pairs]
    p, y = [], []
    for e, c in levelled:
        if e.finding is not None and e.state == "named":
            p.append(e.outcomes(c)[e.finding.effect])
            y.append(float(e.right))
    said, right = np.array(p), np.array(y)
    parts = np.array_split(np.argsort(said), max(1, min(BINS, said.size // PER_BIN)))
    for part in parts:
        low, high = said[part].min(), said[part].max()
        rows.append(
            (f"{low:.2f} to {high:.2f}", str(part.size), f"{said[part].mean():.2f}", f"{right[part].mean():.2f}")
        )
    drawn = np.random.default_rng(0).random((DRAWS, said.size)) < said
    told = [(e, c.likely(e.outcomes(c))) for e, c in levelled if e.state != "clear"]
    hits = [e.truth in found for e, found in told]
    seen = [hit for (e, _), hit in zip(told, hits, strict=True) if e.visible and e.truth != NOTHING]
    size = [float(len(found)) for _, found in told]
    return Figures(
        len({e.case for e in entries}), said.size, float(right.mean()), _calibration_error(said, right, parts),
        float(np.mean([_calibration_error(said, one, parts) for one in drawn])), len(told), float(np.mean(hits)),
        float(np.mean(seen)), float(np.mean(size)),
    )  # fmt: skip


def _calibration_error(said: Array, right: NDArray[Any], parts: Sequence[NDArray[np.int64]]) -> float:
    """Mean difference of probability and share of right ones over the bins (Naeini, Cooper, Hauskrecht 2015, AAAI)."""
    return float(sum(abs(said[part].mean() - right[part].mean()) * part.size for part in parts) / said.size)


def read(folders: Sequence[Path]) -> list[Entry]:
    """Entries of the stored results of folders, of any version of the code."""
    results = [r for folder in folders for r in Store(folder / RESULTS, "", any_version=True).results]
    drawn = [(r.document, r.hidden) for r in results if r.document is not None and r.hidden is not None]
    arms = [(document, hidden) for document, hidden in drawn if hidden["family"] != "setup"]
    return [entry for k, arm in enumerate(arms) for entry in entries_of(k, *arm)]


def read_several(folders: Sequence[Path]) -> list[Entry]:
    """Entries of diagnoses of several recordings in folders of `tests.evaluation.asking`: one after each motion."""
    entries: list[Entry] = []
    truths = [truth for folder in folders for truth in sorted(folder.glob("*/*.truth.json"))]
    for number, truth in enumerate(truths):
        hidden = json.loads(truth.read_text(encoding="utf-8"))
        if hidden["family"] != "setup":
            for path in sorted(truth.parent.glob("*/diagnosis_[1-9].json")):
                entries += entries_of(number, load_document(path, DiagnosisDocument), hidden)
    return entries


def main() -> None:
    """Fit, judge and write the calibration."""
    parser = argparse.ArgumentParser(prog="python -m tests.evaluation.calibrate", description=main.__doc__)
    parser.add_argument("folders", nargs="+", type=Path, help="folders of the results of development arms")
    parser.add_argument(
        "--several", action="store_true", help="of several recordings: folders of tests.evaluation.asking"
    )
    parser.add_argument("--out", type=Path, default=FILE, help="file of the calibration")
    options = parser.parse_args()
    entries = (read_several if options.several else read)(options.folders)
    rows: list[tuple[str, ...]] = []
    found = figures(entries, rows)
    content = json.loads(options.out.read_text(encoding="utf-8")) if options.out.exists() else {}
    content["several" if options.several else "one"] = {**asdict(calibrated(entries)), "cross_fitted": asdict(found)}
    options.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(table(["probability", "findings", "mean", "right"], rows))
    for name, value in asdict(found).items():
        print(f"{name}: {value if isinstance(value, int) else round(value, 3)}")


if __name__ == "__main__":
    main()
