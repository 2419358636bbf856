"""Joint friction of a Franka arm: white-box models of two speeds on the third, beside published networks.

Target of the recordings, by the program that made them: torque of the robot's link-side sensor, minus its own model of
gravity, minus the first such difference. So it contains friction behind the sensor, inertial and Coriolis torques, the
error of the gravity model, and a zero that depends on the friction at the start. All of them are in the model here,
only the law of friction is chosen, and the parameters come from the other two speeds. In the published program the
networks learn while they run, from the torque that they predict.

The published figures follow with a zero-phase Butterworth filter of order 4 at 1 Hz on target and prediction, in the
time of the files. Case 4 was recorded by a program whose clock ran twice as fast.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
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
PLANAR_CASE, AMPLITUDE_M, EASE_S = "case3", 0.07, 3.0
"""Case whose program draws an eight in the vertical plane: its half width, and the duration of its smooth start."""
FREQUENCY_HZ = {"slow": 0.04, "middle": 0.08, "high": 0.16}
UPPER_ARM_M, FOREARM_M = (0.0825, 0.316), (-0.0825, 0.384)
"""Next joint before and above the joint (DH parameters of the manufacturer)."""
START_RAD = (-np.pi / 4, np.pi / 2)
"""Tilts of upper arm and forearm at the start."""
LATEST_S = 0.2
"""Largest delay of the arm behind the program."""
FIRST = 0.1
"""Part of the recording from which the second zero is taken; it is not judged there."""
FOLLOWED_S = 1.0
"""Time constant of the fourth zero."""


@dataclass(frozen=True)
class Record:
    """One recording (N,): angle rad, velocity rad/s, target N m; ``dt`` of its time stamps, s.

    ``period``: mean sampling period, s, with which the velocities are the derivative of the angles. ``forearm``: its
    tilt, rad, if the arm moves in its vertical plane.
    """

    q: Floats
    qd: Floats
    target: Floats
    dt: float
    period: float
    forearm: Floats | None

    def judged(self, signal: Floats) -> Floats:
        """Return a signal after the filter of the published figures."""
        return butterworth(signal, self.dt, JUDGED_HZ, 4, 15)

    def derivatives(self, angle: Floats) -> tuple[Floats, Floats]:
        """Return velocity and acceleration of an angle."""
        qd = central_difference(butterworth(angle, self.period, ACCELERATION_HZ), self.period)
        return qd, central_difference(qd, self.period)

    @cached_property
    def rigid(self) -> Floats:
        """Columns (N, terms) of inertia, Coriolis torques and error of the gravity model, filtered as the target.

        In the vertical plane, where the hand does not turn: of two links, with a coupling of two phases. Otherwise the
        joint moves alone.
        """
        qd, qdd = self.derivatives(self.q)
        if self.forearm is None:
            return self.judged(np.column_stack([qdd, np.sin(self.q), np.cos(self.q)]))
        forearm_qd, forearm_qdd = self.derivatives(self.forearm)
        cosine, sine = np.cos(self.q - self.forearm), np.sin(self.q - self.forearm)
        both, across = qdd + forearm_qdd, forearm_qd**2 - qd**2
        return self.judged(np.column_stack([
            qdd, forearm_qdd, cosine * both + sine * across, sine * both - cosine * across,
            np.sin(self.q), np.cos(self.q), np.sin(self.forearm), np.cos(self.forearm),
        ]))  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """A law of friction: distance over which dry friction reverses, rad, and Stribeck velocity, rad/s, or ``None``."""

    presliding: float
    stribeck: float | None

    def columns(self, record: Record, *, rigid: bool = True) -> Floats:
        """Return the regressor (N, terms), filtered as the target."""
        dry = bristles(butterworth(record.q, record.period, VELOCITY_HZ), self.presliding)
        columns = [dry, record.qd]
        if self.stribeck is not None:
            columns.append(dry * np.exp(-((record.qd / self.stribeck) ** 2)))
        friction = record.judged(np.column_stack(columns))
        return np.hstack([friction, record.rigid]) if rigid else friction


def tilts(x: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return the tilts of upper arm and forearm, rad, with the wrist moved by ``x`` and ``z`` from the start, m."""
    links = (UPPER_ARM_M, FOREARM_M)
    (upper, own), (fore, offset) = ((np.hypot(*link), np.arctan2(*link)) for link in links)
    for (ahead, above), tilt in zip(links, START_RAD, strict=True):
        x = x + ahead * np.cos(tilt) + above * np.sin(tilt)
        z = z - ahead * np.sin(tilt) + above * np.cos(tilt)
    distance, direction = np.hypot(x, z), np.arctan2(x, z)
    at_shoulder = np.arccos((upper**2 + distance**2 - fore**2) / (2 * upper * distance))
    at_wrist = np.arccos((fore**2 + distance**2 - upper**2) / (2 * fore * distance))
    return direction - at_shoulder - own, direction + at_wrist - offset


def forearm_tilt(t: Floats, q: Floats, frequency_hz: float) -> Floats:
    """Return the tilt of the forearm (N,) along the programmed eight, delayed as the recorded joint 2."""
    clock = np.arange(0.0, t[-1], 1e-3)
    eased = np.clip(clock / EASE_S, 0.0, 1.0)
    ease = eased**3 * (eased * (6 * eased - 15) + 10)
    rate = 2 * np.pi * frequency_hz
    x = np.cumsum(AMPLITUDE_M * rate * np.cos(rate * clock) * ease) * 1e-3
    z = np.cumsum(2 * AMPLITUDE_M * rate * np.cos(2 * rate * clock) * ease) * 1e-3
    upper, fore = tilts(x, z)
    delays = np.arange(0.0, LATEST_S, 0.01)
    misses = [float(np.mean((np.interp(t - delay, clock, upper) - q) ** 2)) for delay in delays]
    followed: Floats = np.interp(t - delays[int(np.argmin(misses))], clock, fore)
    return followed


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
    rigid: bool
    coefficients: Floats
    zeros: Floats

    def torque(self, record: Record) -> Floats:
        """Return the predicted target (N,) but for its zero."""
        return self.choice.columns(record, rigid=self.rigid) @ self.coefficients


def fit(choice: Choice, records: Sequence[Record], *, rigid: bool = True) -> Fit:
    """Return the least-squares model of recordings that have a zero each."""
    zeros = np.repeat(np.eye(len(records)), [record.q.size for record in records], axis=0)
    columns = np.vstack([choice.columns(record, rigid=rigid) for record in records])
    target = np.concatenate([record.judged(record.target) for record in records])
    found = np.linalg.lstsq(np.hstack([columns, zeros]), target, rcond=None)[0]
    terms = columns.shape[1]
    return Fit(choice, rigid, found[:terms], found[terms:])


def chosen(records: Sequence[Record]) -> Choice:
    """Return the law of friction that predicts each of two recordings best from the other, but for its zero."""

    def error(choice: Choice) -> float:
        pairs = ((records[0], records[1]), (records[1], records[0]))
        return sum(float(np.var(b.judged(b.target) - fit(choice, [a]).torque(b))) for a, b in pairs)

    return min((Choice(*values) for values in product(PRESLIDING_RAD, (None, *STRIBECK_RAD_S))), key=error)


def rms(error: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(error**2)))


@compiled(kept=True)
def followed(error: Floats, start: float, share: float) -> Floats:
    """Return the zero (N,) before each sample, learnt from the errors before it, as the published networks learn."""
    zero = np.full(error.size, start)
    for k in range(1, error.size):
        zero[k] = zero[k - 1] + share * (error[k - 1] - zero[k - 1])
    return zero


def errors(model: Fit, record: Record) -> tuple[float, float, float, float]:
    """Return RMS errors, N m: zero of the other speeds, of the first tenth, of the whole recording, and followed."""
    remainder = record.judged(record.target) - model.torque(record)
    first, start = round(FIRST * remainder.size), float(model.zeros.mean())
    return (
        rms(remainder - start),
        rms(remainder[first:] - remainder[:first].mean()),
        rms(remainder - remainder.mean()),
        rms(remainder - followed(remainder, start, record.period / FOLLOWED_S)),
    )


def read(file: Path, frequency_hz: float | None) -> Record:
    """Read a recording of one joint; its columns are time, angle, velocity, acceleration, target, predictions.

    ``frequency_hz``: of the eight in the vertical plane; ``None``: another motion.
    """
    try:
        t, q, qd, _, target = np.genfromtxt(file, delimiter=",", skip_header=1, usecols=range(5)).T
    except (OSError, ValueError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    if not np.isfinite(q + qd + target).all():
        raise DataError(f"{file}: expected finite numbers")
    period = float(np.diff(q) @ qd[1:] / (qd[1:] @ qd[1:]))
    forearm = None if frequency_hz is None else forearm_tilt(t, q, frequency_hz)
    return Record(q, butterworth(qd, period, VELOCITY_HZ), target, float(t[-1] - t[0]) / (t.size - 1), period, forearm)


def published(file: Path) -> dict[tuple[str, str, str], float]:
    """Return the published RMS errors, N m, by case, speed and model."""
    rows = np.genfromtxt(file, delimiter=",", names=True, dtype=None, encoding="utf-8")
    return {(str(row["Case"]), str(row["Speed"]), str(row["Model"])): float(row["RMS"]) for row in rows}


def row(title: str, values: Iterable[float], ours: Iterable[float]) -> list[str]:
    """Return a row of the table."""
    return [title, *(f"{value:.3f}" for value in (*values, *ours))]


def report(folder: Path | None) -> str:
    """Return the table of the exam. Raises ConfigError if there are no recordings."""
    if folder is None or not is_file(folder / FOLDER / PUBLISHED):
        place = "no folder given" if folder is None else f"{folder / FOLDER / PUBLISHED} is missing"
        raise ConfigError(f"{place}: {WHERE}")
    figures = published(folder / FOLDER / PUBLISHED)
    files = {key: folder / FOLDER / "Franka Robot" / f"{'_'.join(key)}.csv" for key in product(CASES, SPEEDS)}
    present = {
        (case, speed): read(file, FREQUENCY_HZ[speed] if case == PLANAR_CASE else None)
        for (case, speed), file in files.items()
        if is_file(file)
    }
    rows: list[list[str]] = []
    laws: list[str] = []
    ours: list[tuple[float, ...]] = []
    theirs: list[list[float]] = []
    for case in CASES:
        records = {speed: present[case, speed] for speed in SPEEDS if (case, speed) in present}
        if len(records) < len(SPEEDS):
            continue
        for speed, record in records.items():
            others = [other for name, other in records.items() if name != speed]
            model = fit(chosen(others), others)
            simple = fit(Choice(PRESLIDING_RAD[0], None), others, rigid=False)
            ours.append((errors(simple, record)[2], *errors(model, record)))
            theirs.append([figures[case, speed, name] for name in MODELS])
            rows.append(row(f"{case} {speed}", theirs[-1], ours[-1]))
            bell = model.choice.stribeck
            laws.append(
                f"{case} {speed}: reversal within {1e3 * model.choice.presliding:g} mrad, "
                + ("no Stribeck term" if bell is None else f"Stribeck velocity {bell:g} rad/s")
            )
    if not rows:
        raise ConfigError(f"{folder / FOLDER}: no case has its three speeds: {WHERE}")
    every = [[figures[case, speed, name] for name in MODELS] for case, speed in files]
    rows.append(row("median of these", np.median(theirs, axis=0), np.median(ours, axis=0)))
    rows.append([*row("median of 12", np.median(every, axis=0), ()), *[""] * 5])
    zeros = ("zero of the others", "zero of the first tenth", "its own zero", "zero followed")
    headings = ("RMS, N m", *MODELS, "friction alone, its own zero", *(f"model, {zero}" for zero in zeros))
    count = f"{len(rows) - 2} of {len(files)} recordings are here with all three speeds."
    return "\n\n".join([count, table(headings, rows), "Friction chosen on the other speeds:\n" + "\n".join(laws)])
