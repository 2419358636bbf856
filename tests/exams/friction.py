"""Joint friction of a Franka arm: white-box models of two speeds on the third, beside published networks.

Target of the recordings, by the program that made them: link-side torque of the robot's sensor, minus its own model of
gravity, minus the first such difference. So it contains friction behind the sensor, inertial and Coriolis torques, the
error of the gravity model, and a zero that depends on the friction of the first moment. The published networks learn
while the recording runs, from the torque that they predict; our parameters come from the other two speeds alone.

The published figures follow with a zero-phase Butterworth filter of order 4 at 1 Hz on target and prediction, in the
time of the files. Case 4 was recorded by a program whose clock ran twice as fast.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.compiled import compiled
from armident.configs import ConfigError, DataError
from armident.configs.yaml_loader import is_file
from armident.identify.signals.bandpass import butterworth, central_difference
from tests.tools.markdown import table

Floats = NDArray[np.float64]

REPOSITORY = "github.com/longshike/NNFM-A-Novel-Neural-Network-Modeling-Approach-for-Robot-Flexible-Joints-Friction"
WHERE = f"clone {REPOSITORY} and repeat with --data FOLDER"
FOLDER = "Comparative data"
PUBLISHED = "friction_model_comparison_all_results_filtered.csv"
CASES, SPEEDS = ("case1", "case2", "case3", "case4"), ("slow", "middle", "high")
MODELS = ("CV", "LuGre", "SVM", "PINN", "NNFM")
JUDGED_HZ = 1.0
"""Cutoff with which the published figures follow from the published predictions."""
VELOCITY_HZ, ACCELERATION_HZ = 20.0, 3.0
"""Cutoffs of velocity and acceleration."""
PRESLIDING_RAD = (1e-4, 1e-3, 3e-3)
STRIBECK_RAD_S = (0.02, 0.08)
"""Trial values of the presliding distance and of the Stribeck velocity."""
COULOMB_VISCOUS = ("coulomb", "viscous")
STRUCTURES = (
    COULOMB_VISCOUS,
    (*COULOMB_VISCOUS, "stribeck"),
    (*COULOMB_VISCOUS, "inertia"),
    (*COULOMB_VISCOUS, "stribeck", "inertia"),
    (*COULOMB_VISCOUS, "inertia", "sine", "cosine"),
    (*COULOMB_VISCOUS, "stribeck", "inertia", "sine", "cosine"),
)
"""Candidates. ``sine``, ``cosine``: error of the gravity model over the joint's own angle."""
FIRST = 0.1
"""Part of the recording from which the second zero is taken; it is not judged there."""
FOLLOWED_S = 1.0
"""Time constant of the third zero."""


@dataclass(frozen=True)
class Record:
    """One recording (N,): angle rad, velocity rad/s, acceleration rad/s2, target N m; ``dt`` of its time stamps, s.

    ``period``: mean sampling period, s, with which the velocities are the derivative of the angles.
    """

    q: Floats
    qd: Floats
    qdd: Floats
    target: Floats
    dt: float
    period: float

    def judged(self, signal: Floats) -> Floats:
        """Return a signal after the filter of the published figures."""
        return butterworth(signal, self.dt, JUDGED_HZ, 4, 15)


@dataclass(frozen=True)
class Choice:
    """Terms of a model, and the values of its nonlinear parameters."""

    terms: tuple[str, ...]
    presliding: float
    stribeck: float

    def columns(self, record: Record) -> Floats:
        """Return the regressor (N, terms), filtered as the target."""
        dry = bristles(record.q, self.presliding)
        every = {
            "coulomb": dry,
            "viscous": record.qd,
            "stribeck": dry * np.exp(-((record.qd / self.stribeck) ** 2)),
            "inertia": record.qdd,
            "sine": np.sin(record.q),
            "cosine": np.cos(record.q),
        }
        return record.judged(np.column_stack([every[term] for term in self.terms]))


@compiled(kept=True)
def bristles(q: Floats, distance: float) -> Floats:
    """Return the state (N,) of dry friction, -1 to 1, that reverses over a distance (Dahl 1968)."""
    state = np.zeros(q.size)
    for k in range(1, q.size):
        step = (q[k] - q[k - 1]) / distance
        state[k] = (state[k - 1] + step) / (1.0 + abs(step))
    return state


@dataclass(frozen=True)
class Fit:
    """A model of some recordings: coefficients (terms,), and the zeros of the recordings, N m."""

    choice: Choice
    coefficients: Floats
    zeros: Floats

    def torque(self, record: Record) -> Floats:
        """Return the predicted target (N,) but for its zero."""
        return self.choice.columns(record) @ self.coefficients


def fit(choice: Choice, records: Sequence[Record]) -> Fit:
    """Return the least-squares model of recordings that have a zero each."""
    zeros = np.repeat(np.eye(len(records)), [record.q.size for record in records], axis=0)
    columns = np.hstack([np.vstack([choice.columns(record) for record in records]), zeros])
    target = np.concatenate([record.judged(record.target) for record in records])
    found = np.linalg.lstsq(columns, target, rcond=None)[0]
    return Fit(choice, found[: len(choice.terms)], found[len(choice.terms) :])


def chosen(records: Sequence[Record]) -> Choice:
    """Return the model that predicts each of two recordings best from the other, but for its zero."""

    def error(choice: Choice) -> float:
        pairs = ((records[0], records[1]), (records[1], records[0]))
        return sum(float(np.var(b.judged(b.target) - fit(choice, [a]).torque(b))) for a, b in pairs)

    choices = [
        Choice(terms, presliding, stribeck)
        for terms, presliding in product(STRUCTURES, PRESLIDING_RAD)
        for stribeck in (STRIBECK_RAD_S if "stribeck" in terms else STRIBECK_RAD_S[:1])
    ]
    return min(choices, key=error)


def rms(error: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(error**2)))


@compiled(kept=True)
def followed(error: Floats, share: float) -> Floats:
    """Return the zero (N,) before each sample, learnt from the errors before it, as the published networks learn."""
    zero = np.zeros(error.size)
    for k in range(1, error.size):
        zero[k] = zero[k - 1] + share * (error[k - 1] - zero[k - 1])
    return zero


def errors(model: Fit, record: Record) -> tuple[float, float, float]:
    """Return RMS errors, N m: zero of the other speeds, of the first tenth, and followed."""
    remainder = record.judged(record.target) - model.torque(record)
    first = round(FIRST * remainder.size)
    zero = followed(remainder, record.period / FOLLOWED_S)
    return (
        rms(remainder - model.zeros.mean()),
        rms(remainder[first:] - remainder[:first].mean()),
        rms(remainder - zero),
    )


def read(file: Path) -> Record:
    """Read a recording of one joint; its columns are time, angle, velocity, acceleration, target, predictions."""
    try:
        t, q, qd, _, target = np.genfromtxt(file, delimiter=",", skip_header=1, usecols=range(5)).T
    except (OSError, ValueError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    if not np.isfinite(q + qd + target).all():
        raise DataError(f"{file}: expected finite numbers")
    period = float(np.diff(q) @ qd[1:] / (qd[1:] @ qd[1:]))
    qd, smooth = butterworth(qd, period, VELOCITY_HZ), butterworth(qd, period, ACCELERATION_HZ)
    return Record(q, qd, central_difference(smooth, period), target, float(t[-1] - t[0]) / (t.size - 1), period)


def published(file: Path) -> dict[tuple[str, str, str], float]:
    """Return the published RMS errors, N m, by case, speed and model."""
    rows = np.genfromtxt(file, delimiter=",", names=True, dtype=None, encoding="utf-8")
    return {(str(row["Case"]), str(row["Speed"]), str(row["Model"])): float(row["RMS"]) for row in rows}


def row(title: str, values: Sequence[float], ours: Sequence[float]) -> list[str]:
    """Return a row of the table."""
    return [title, *(f"{value:.3f}" for value in (*values, *ours))]


def report(folder: Path | None) -> str:
    """Return the table of the exam. Raises ConfigError if there are no recordings."""
    if folder is None or not is_file(folder / FOLDER / PUBLISHED):
        place = "no folder given" if folder is None else f"{folder / FOLDER / PUBLISHED} is missing"
        raise ConfigError(f"{place}: {WHERE}")
    figures = published(folder / FOLDER / PUBLISHED)
    files = {key: folder / FOLDER / "Franka Robot" / f"{'_'.join(key)}.csv" for key in product(CASES, SPEEDS)}
    present: Mapping[tuple[str, str], Record] = {key: read(file) for key, file in files.items() if is_file(file)}
    rows, ours, theirs, terms = [], [], [], []
    for case in CASES:
        records = {speed: present[case, speed] for speed in SPEEDS if (case, speed) in present}
        for speed, record in records.items() if len(records) == len(SPEEDS) else ():
            others = [other for name, other in records.items() if name != speed]
            model = fit(chosen(others), others)
            simple = fit(Choice(COULOMB_VISCOUS, PRESLIDING_RAD[0], STRIBECK_RAD_S[0]), others)
            ours.append((*errors(simple, record), *errors(model, record)))
            theirs.append([figures[case, speed, name] for name in MODELS])
            rows.append(row(f"{case} {speed}", theirs[-1], ours[-1]))
            terms.append(f"{case} {speed}: {', '.join(model.choice.terms)}")
    if not rows:
        raise ConfigError(f"{folder / FOLDER}: no case has its three speeds: {WHERE}")
    every = [[figures[case, speed, name] for name in MODELS] for case, speed in files]
    rows.append(row("median of these", np.median(theirs, axis=0), np.median(ours, axis=0)))
    rows.append([*row("median of 12", np.median(every, axis=0), ()), *[""] * 6])
    zeros = ("zero of the others", "of the first tenth", "followed")
    headings = ("RMS, N m", *MODELS, *(f"{kind}: {zero}" for kind in ("Coulomb, viscous", "chosen") for zero in zeros))
    count = f"{len(rows) - 2} of {len(files)} recordings are here with all three speeds."
    return "\n\n".join([count, table(headings, rows), "Terms chosen on the other speeds:\n" + "\n".join(terms)])
