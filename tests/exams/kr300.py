"""Inverse dynamics of a KUKA KR 300 R2500 ultra SE: torques of the last of twelve recordings from its positions.

Robot identification benchmark (Weigand, Götz, Ulmen, Ruskowski 2022): motor torques in N m and positions in degrees,
sampled at 250 Hz, filtered by its authors at 4 Hz and kept at 10 Hz. Each recording has three motions, each twice, from
and to the same pose. A public program ships it in pieces of 606 samples, each without its first position and its last
torque. Regressors are computed at 100 Hz and filtered as the torques: friction changes its sign within a sample.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from armident.configs import ConfigError, DataError, load_robot
from armident.configs.yaml_loader import is_file
from armident.identify.effects.friction import dahl
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.bandpass import butterworth
from tests.tools.markdown import table

Floats = NDArray[np.float64]

REPOSITORY = "github.com/yifang0-0/Physics-Guided-Recurrent-State-Space-Neural-Networks"
FILE = Path("data/IndustRobo/forward_identification_without_raw_data_shifted.mat")
WHERE = f"git clone https://{REPOSITORY}, and repeat with --data CLONE"
ROBOT = Path(__file__).with_suffix(".yaml")
RATIOS = np.array([212.76, 203.52, 192.75, 156.0, 156.0, 102.17])
"""Gear ratios, by the same program."""

PERIOD, FINER, FILTER_HZ = 0.1, 10, 4.0
PIECE, PIECES = 606, 6
"""Samples of a motion, and motions of a recording."""
REPEAT = 1818.12
"""Samples from a motion to its repetition: 45 453 samples at 250 Hz."""
ENDS = (60, 5)
"""Samples left out at both ends of a recording, where it was filtered together with its neighbours. The first motion
also begins within them, from a torque at rest that depends on how the arm had stopped before."""
SPEEDS = (0.003, 0.03)
"""Limits of standstill, slow and fast motion of an axis, rad/s."""
AT_START_RAD, STILL = 3e-4, 1e-4
"""Distance from the first pose and speed, rad/s, below which an arm rests in it."""


def over_speed(_: Floats, qd: Floats, __: Floats) -> list[Floats]:
    """Return columns of friction that is curved over the speed: Eyring's law at four speeds, rad/s, and a square."""
    return [*(np.arcsinh(qd / v) for v in (0.01, 0.03, 0.1, 0.3)), qd * np.abs(qd)]


def presliding(q: Floats, _: Floats, __: Floats) -> list[Floats]:
    """Return dry friction that builds up over ten displacements, rad, and stays at standstill."""
    return [dahl(q, displacement) for displacement in np.geomspace(1e-6, 3e-2, 10)]


def stribeck(q: Floats, qd: Floats, _: Floats) -> list[Floats]:
    """Return friction that falls with the speed: four displacements, rad, at four speeds, rad/s."""
    falling = [np.exp(-np.abs(qd) / v) for v in (3e-4, 3e-3, 3e-2, 3e-1)]
    return [dahl(q, displacement) * share for displacement in (1e-5, 1e-4, 1e-3, 1e-2) for share in falling]


def drift(_: Floats, qd: Floats, t: Floats) -> list[Floats]:
    """Return viscous friction that changes linearly with the time of the recordings."""
    return [qd * np.abs(qd) * t, np.arcsinh(qd / 0.03) * t]


LAWS: dict[str, Callable[[Floats, Floats, Floats], list[Floats]]] = {
    "friction curved over the speed": over_speed,
    "presliding": presliding,
    "Stribeck friction": stribeck,
    "friction drift": drift,
}


@dataclass(frozen=True)
class Record:
    """One recording: positions rad and motor torques N m (N, 6), ``nan`` where a sample was removed; its number."""

    position: Floats
    torque: Floats
    number: int
    ends: tuple[int, int] = ENDS

    @cached_property
    def motion(self) -> tuple[Floats, Floats, Floats]:
        """Positions, velocities and accelerations at the finer rate; removed positions lie between moments of rest."""
        k = np.arange(len(self.position), dtype=np.float64)
        known = np.isfinite(self.position[:, 0])
        spline = make_interp_spline(k[known], self.position[known], 7)
        instants = np.maximum(np.arange((k.size - 1) * FINER + 1) / FINER, k[known][0])
        return spline(instants), spline.derivative()(instants) / PERIOD, spline.derivative(2)(instants) / PERIOD**2

    @cached_property
    def rows(self) -> NDArray[np.bool_]:
        """Mask (N,) of the samples that are fitted and judged."""
        rows: NDArray[np.bool_] = np.isfinite(self.torque[:, 0])
        rows[: self.ends[0]] = rows[len(rows) - self.ends[1] :] = False
        return rows

    @cached_property
    def measured(self) -> Floats:
        """Judged torques (M, 6), N m at the motors."""
        return self.torque[self.rows]

    @cached_property
    def speed(self) -> Floats:
        """Speeds at the judged samples (M, 6), rad/s."""
        return np.abs(self.motion[1][::FINER][self.rows])

    def judged(self, signals: Floats) -> Floats:
        """Return signals of the finer rate after the filter of the torques, at the judged samples."""
        return butterworth(signals, PERIOD / FINER, FILTER_HZ, 4, 300)[::FINER][self.rows]

    @cached_property
    def rigid(self) -> Floats:
        """Regressor (M, 6, b) of the rigid arm with viscous and Coulomb friction, at the motors."""
        regressor = ArmModel.from_config(load_robot(ROBOT)).base_regressor(*self.motion)
        return np.stack([self.judged(regressor[:, j]) / RATIOS[j] for j in range(RATIOS.size)], axis=1)

    @cached_property
    def friction(self) -> dict[str, Floats]:
        """Columns (M, 6, terms) of each law of friction, of every axis its own."""
        q, qd, _ = self.motion
        t = self.number + np.linspace(0.0, 1.0, len(q))
        axes = [(np.ascontiguousarray(q[:, j]), qd[:, j]) for j in range(RATIOS.size)]
        return {
            name: np.stack([self.judged(np.column_stack(law(*axis, t))) for axis in axes], axis=1)
            for name, law in LAWS.items()
        }

    def columns(self, laws: Sequence[str], axis: int) -> Floats:
        """Return the regressor (M, parameters) of the torque of one axis."""
        own = np.hstack([self.rigid[:, axis, :0], *(self.friction[law][:, axis] for law in laws)])
        others = [own if j == axis else np.zeros_like(own) for j in range(RATIOS.size)]
        return np.hstack([self.rigid[:, axis], *others])

    def predicted(self, laws: Sequence[str], theta: Floats) -> Floats:
        """Return the torques (M, 6) of a model, N m."""
        return np.column_stack([self.columns(laws, axis) @ theta for axis in range(RATIOS.size)])

    @property
    def linear(self) -> Floats:
        """Positions, velocities and accelerations at the judged samples (M, 18)."""
        return np.hstack([signal[::FINER][self.rows] for signal in self.motion])

    def repeated(self) -> list[float]:
        """Return the difference of each motion's torques from its repetition, over sqrt(2), percent of the torques."""
        k, found = np.flatnonzero(self.rows), []
        spline = make_interp_spline(k, self.measured, 3)
        for motion in range(PIECES // 2):
            instants = k[(k // PIECE == motion) & (k + REPEAT <= k[-1])]
            first, second = spline(instants), spline(instants + REPEAT)
            found.append(percent(first - second, first) / np.sqrt(2))
        return found


def percent(error: Floats, signal: Floats) -> float:
    """Return the norm of an error over that of the signal, percent."""
    return float(100 * np.linalg.norm(error) / np.linalg.norm(signal))


def fitted(records: Iterable[Record], laws: Sequence[str]) -> Floats:
    """Return the parameters of weighted least squares; an axis weighs as one over its residual's variance."""
    axes, products = range(RATIOS.size), []
    for axis in axes:
        pairs = [(record.columns(laws, axis), record.measured[:, axis]) for record in records]
        products.append((
            sum(x.T @ x for x, _ in pairs), sum(x.T @ y for x, y in pairs),
            sum(float(y @ y) for _, y in pairs), sum(y.size for _, y in pairs),
        ))  # fmt: skip
    variances = np.array([squares / count for _, _, squares, count in products])
    theta = np.zeros(0)
    for _ in range(4):
        matrix = sum(products[j][0] / variances[j] for j in axes)
        right = sum(products[j][1] / variances[j] for j in axes)
        scale = np.sqrt(np.diagonal(matrix))
        # The velocities of the laws overlap: of equal fits the smallest is taken.
        theta = np.linalg.lstsq(matrix / np.outer(scale, scale), right / scale, rcond=1e-11)[0] / scale
        variances = np.array([
            (squares - 2 * theta @ xy + theta @ xx @ theta) / count for xx, xy, squares, count in products
        ])  # fmt: skip
    return theta


def figures(record: Record, predicted: Floats) -> list[str]:
    """Return errors of the torques, percent: all, each axis, fast, slow, and at standstill; mean NRMSE of the axes."""
    error, torque = record.measured - predicted, record.measured
    axes = " ".join(f"{percent(error[:, j], torque[:, j]):.1f}" for j in range(RATIOS.size))
    kind = np.digitize(record.speed, SPEEDS)
    parts = [f"{percent(error[kind == k], torque[kind == k]):.1f}" for k in (2, 1, 0)]
    share = percent(error[kind == 0], error) ** 2 / 100
    nrmse = np.mean(np.sqrt(np.mean(error**2, axis=0)) / torque.std(axis=0))
    return [f"{percent(error, torque):.1f}", axes, *parts, f"{share:.0f}", f"{nrmse:.3f}"]


def load(clone: Path | None) -> list[Record]:
    """Read the recordings, eleven for training and the last for the test. Raises ConfigError, with the place."""
    if clone is None:
        raise ConfigError(f"the recordings are in {REPOSITORY}: {WHERE}")
    if not is_file(path := clone / FILE):
        raise ConfigError(f"{path} is missing: {WHERE}")
    try:
        read = loadmat(path)
        u, y = (np.hstack([read[f"{name}_{part}"] for part in ("train", "val", "test")]).T for name in "uy")
        u, y = (signal.reshape(-1, PIECES, PIECE - 1, RATIOS.size) for signal in (u, np.deg2rad(y)))
    # loadmat answers a file of MATLAB 7.3 with NotImplementedError
    except (KeyError, ValueError, NotImplementedError, OSError, MatReadError) as error:
        raise DataError(f"{path} is not that file ({error}): {WHERE}") from error
    hole = np.full((len(u), PIECES, 1, RATIOS.size), np.nan)
    position, torque = (np.concatenate(parts, axis=2).reshape(len(u), -1, 6) for parts in ((hole, y), (u, hole)))
    return [Record(*signals, number) for number, signals in enumerate(zip(position, torque, strict=True))]


def at_rest(records: Sequence[Record]) -> str:
    """Return the range of 98 % of the torques of axes 2 and 3 while the arm rests in its first pose."""
    torques = []
    for record in records:
        q, qd, _ = (np.abs(signal[::FINER][record.rows]).max(axis=1) for signal in record.motion)
        torques.append(record.measured[(q < AT_START_RAD) & (qd < STILL)])
    resting = np.concatenate(torques)[:, 1:3]
    ranges = [f"{low:.1f} to {high:.1f} N m" for low, high in np.quantile(resting, (0.01, 0.99), axis=0).T]
    return f"at rest in one pose ({len(resting)} samples): axes 2 and 3 {ranges[0]} and {ranges[1]}"


def report(clone: Path | None) -> str:
    """Return the tables of the exam. Raises ConfigError if the recordings are missing."""
    *training, test = load(clone)
    x, y = (np.concatenate([getattr(record, name) for record in training]) for name in ("linear", "measured"))
    baseline = test.linear @ np.linalg.lstsq(x, y, rcond=None)[0]
    theta, laws, last = np.zeros(0), list[str](), training[-1]
    rows = [["linear in q, qd and qdd, as the benchmark's baseline", "", *figures(test, baseline)]]
    for name in ("rigid arm, viscous and Coulomb friction", *LAWS):
        laws += [name] if name in LAWS else []
        left_out = percent(last.measured - last.predicted(laws, fitted(training[:-1], laws)), last.measured)
        theta = fitted(training, laws)
        rows.append([f"+ {name}" if laws else name, f"{left_out:.1f}", *figures(test, test.predicted(laws, theta))])
    heads = (
        "model, torque error in %", "training, left out", "test", "axes 1 to 6", "fast", "slow", "standstill",
        "standstill, share of squared error", "mean NRMSE",
    )  # fmt: skip
    repeated = ", ".join(f"{value:.1f}" for value in test.repeated())
    whole = replace(test, ends=(0, 0))
    error = percent(whole.measured - whole.predicted(laws, theta), whole.measured)
    return "\n\n".join([
        table(heads, rows), f"the last model with both ends of the test recording: {error:.1f} %",
        f"repetition of the three motions: {repeated} %", at_rest([*training, test]),
    ])  # fmt: skip
