"""EMPS by the protocol of nonlinearbenchmark.org: the position simulated from the force alone, pulses held out.

The recorded force moves the model from rest; the measured position is never fed back. Effects are chosen by leaving out
one of the four cycles of the training recording, parameters are fitted to all of it. The recording with pulses is
simulated once, with the finished model. Dry friction is set-valued at standstill and implicit, so that a joint that
sticks stays at rest; viscous friction is the mean of both ends of a sample. The drive holds a force for one sample.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.optimize import least_squares

from armident.compiled import compiled
from armident.configs import ConfigError, load_robot
from armident.identify.signals.bandpass import butterworth, central_difference
from tests.reproduction.recordings import EMPS_FILE, EMPS_PERIOD, measured_emps
from tests.tools.markdown import table

Floats = NDArray[np.float64]

PULSES_FILE = "DATA_EMPS_PULSES.mat"
WHERE = (
    "get DATA_EMPS.mat and DATA_EMPS_PULSES.mat from nonlinearbenchmark.org, put them into FOLDER/emps and repeat "
    "with --data FOLDER"
)
KP, KV, LIMIT_V = 160.18, 243.45, 10.0
"""Gains of position loop, 1/s, and velocity loop, V s/m, and limit of the drive's signal, as published."""
NETWORKS_MM, ASYMMETRIC_MM, CLOSED_LOOP_PCT = "74 to 220", "3.76", "8.94"
"""Published: networks and a fit with asymmetric friction, open loop; error of the closed-loop force."""
CYCLES = 4
STEP = 1e-3
"""Relative step of the derivatives: the error is not smooth in the parameters, because the axis stops and starts."""
CLEAR = 2.0
"""Standard errors by which an effect has to improve the left-out cycles."""
SMOOTHING_HZ = 30.0
"""Cutoff of the velocity at which a left-out cycle starts."""

PARAMETERS = (
    "mass", "viscous_up", "viscous_down", "coulomb_up", "coulomb_down", "curvature_up", "curvature_down", "stribeck",
    "stribeck_speed", "over_position", "over_position_squared", "spring", "drift", "load", "presliding",
)  # fmt: skip
"""SI; friction of positive velocity is ``up``. ``over_position``, ``drift``, ``load``: relative change of friction per
metre from the middle, per second from the start, and dry friction per newton of force."""
FRICTION = (*PARAMETERS[1:8], "load")
"""Parameters in proportion to the level of friction."""
PUBLISHED = {
    "mass": 95.1540, "viscous_up": 166.7061, "viscous_down": 240.4236, "coulomb_up": 20.1440, "coulomb_down": 20.6277,
}  # fmt: skip
"""IDIM-LS with asymmetric friction (Janot, Gautier, Brunot 2019)."""
EFFECTS: dict[str, dict[str, float]] = {
    "nonlinear viscous friction": {"curvature_up": 50.0, "curvature_down": 50.0},
    "Stribeck friction": {"stribeck": 0.5, "stribeck_speed": 0.01},
    "position-dependent friction": {"over_position": 0.05, "over_position_squared": 0.5},
    "joint spring": {"spring": 1.0},
    "friction drift": {"drift": 1e-4},
    "load-dependent friction": {"load": 1e-3},
    "presliding": {"presliding": 1e-5},
}
"""Candidates from the catalogue of effects, and the values from which their parameters are fitted."""
MIDDLE = 0.125
"""Middle of the stroke, m."""


@dataclass(frozen=True)
class Axis:
    """One recording (N,): position and reference m, force and the pulses in it N; ``qd``: velocity m/s."""

    q: Floats
    qd: Floats
    q_ref: Floats
    force: Floats
    pulses: Floats

    def part(self, rows: slice) -> "Axis":
        """Return a stretch of the recording."""
        return Axis(self.q[rows], self.qd[rows], self.q_ref[rows], self.force[rows], self.pulses[rows])


@compiled(kept=True)
def moved(
    parameters: Floats, force: Floats, reference: Floats, loop: Floats, q0: float, qd0: float, dt: float
) -> tuple[Floats, Floats]:
    """Return position and force (N,) of the axis.

    ``loop``: gains, force per volt and limit in volts; the force is then added behind the drive. Empty: open loop.
    """
    m, up, down, dry_up, dry_down, bend_up, bend_down, bell, bell_v, px, pxx, spring, drift, load, bristle = parameters
    n = force.size
    position, total = np.empty(n), force.copy()
    x, v, z = q0, qd0, 0.0
    for k in range(n):
        position[k] = x
        if loop.size:
            speed = (x - position[k - 2]) / (2.0 * dt) if k > 1 else v
            signal = loop[1] * (loop[0] * (reference[k] - x) - speed)
            total[k] += loop[2] * min(max(signal, -loop[3]), loop[3])
        y = x - MIDDLE
        level = (1.0 + px * y + pxx * y * y) * (1.0 + drift * k * dt)
        dry = load * abs(total[k])
        if bell != 0.0:
            dry += bell * np.exp(-((v / bell_v) ** 2))
        speed = abs(v)
        share = 0.5 * level * dt / m
        half_up, half_down = share * (up + bend_up * speed), share * (down + bend_down * speed)
        free = v - (half_up if v > 0.0 else half_down) * v + dt / m * (total[k] - spring * y)
        if bristle > 0.0:
            free -= dt / m * level * (dry + (dry_up if z > 0.0 else dry_down)) * z
            after = free / (1.0 + (half_up if free > 0.0 else half_down))
            z = (z + dt * after / bristle) / (1.0 + dt * abs(after) / bristle)
        else:
            forward = (free - dt / m * level * (dry_up + dry)) / (1.0 + half_up)
            back = (free + dt / m * level * (dry_down + dry)) / (1.0 + half_down)
            after = forward if forward > 0.0 else back if back < 0.0 else 0.0
        x += 0.5 * dt * (v + after)
        v = after
    return position, total


def simulated(values: Mapping[str, float], axis: Axis) -> Floats:
    """Return the position (N,) that the recorded force gives the model, from the measured state at the start."""
    parameters = np.array([values.get(name, 0.0) for name in PARAMETERS])
    return moved(parameters, axis.force, axis.q_ref, np.zeros(0), axis.q[0], axis.qd[0], EMPS_PERIOD)[0]


def errors_mm(values: Mapping[str, float], axes: Sequence[Axis]) -> Floats:
    """Return the errors of the simulated positions, mm, one recording after another."""
    return 1e3 * np.concatenate([simulated(values, axis) - axis.q for axis in axes])


def rmse_mm(values: Mapping[str, float], axis: Axis) -> float:
    """Return the root mean square error of the simulated position, mm."""
    return float(np.sqrt(np.mean(errors_mm(values, [axis]) ** 2)))


def fitted(start: Mapping[str, float], axes: Sequence[Axis]) -> dict[str, float]:
    """Return the parameters with the least sum of squared position errors, from values other than zero."""
    names, scale = list(start), np.array(list(start.values()))

    def residuals(x: Floats) -> Floats:
        return errors_mm(dict(zip(names, x * scale, strict=True)), axes)

    found = least_squares(
        residuals, np.ones(scale.size), method="lm", ftol=1e-6, xtol=1e-6, diff_step=np.full(scale.size, STEP)
    )
    return dict(zip(names, map(float, found.x * scale), strict=True))


def left_out(start: Mapping[str, float], cycles: Sequence[Axis]) -> Floats:
    """Return the mean squared error, mm2, of every cycle with the parameters of the others."""
    found = []
    for k, cycle in enumerate(cycles):
        values = fitted(start, [*cycles[:k], *cycles[k + 1 :]])
        found.append(np.mean(errors_mm(values, [cycle]) ** 2))
    return np.array(found)


def chosen(cycles: Sequence[Axis]) -> tuple[dict[str, float], list[list[str]]]:
    """Return the values from which the chosen model is fitted, and the rows of the candidates.

    Forward selection: of the candidates with a clear gain on the left-out cycles, the one with the largest is taken.
    """
    start, rest = dict(PUBLISHED), dict(EFFECTS)
    before = left_out(start, cycles)
    rows = [["asymmetric friction", f"{np.sqrt(before.mean()):.3f}", "", ""]]
    while rest:
        after = {name: left_out({**start, **values}, cycles) for name, values in rest.items()}
        gains = {name: before - errors for name, errors in after.items()}
        deviations = {name: float(gain.std(ddof=1)) / np.sqrt(gain.size) for name, gain in gains.items()}
        clear = [name for name, gain in gains.items() if gain.mean() > CLEAR * deviations[name]]
        best = max(clear, key=lambda name: float(gains[name].mean()), default=None)
        for name, errors in after.items():
            change = f"{gains[name].mean():.3f} ± {deviations[name]:.3f}"
            rows.append([f"+ {name}", f"{np.sqrt(errors.mean()):.3f}", change, "taken" if name == best else ""])
        if best is None:
            break
        start |= rest.pop(best)
        before = after[best]
    return start, rows


def closed_loop_error_pct(values: Mapping[str, float], axis: Axis) -> float:
    """Return the relative error of the force of the closed loop, percent, from sample 50 on as published."""
    parameters = np.array([values.get(name, 0.0) for name in PARAMETERS])
    loop = np.array([KP, KV, load_robot("emps").joints[0].drive.gain, LIMIT_V])
    force = moved(parameters, axis.pulses, axis.q_ref, loop, axis.q[0], axis.qd[0], EMPS_PERIOD)[1]
    return float(100 * np.linalg.norm((force - axis.force)[49:]) / np.linalg.norm(axis.force[49:]))


def level_on(values: Mapping[str, float], axis: Axis) -> dict[str, float]:
    """Return the model with its friction multiplied by the one factor that suits a recording best."""

    def at(level: float) -> dict[str, float]:
        return {name: value * (level if name in FRICTION else 1.0) for name, value in values.items()}

    def errors(x: Floats) -> Floats:
        return errors_mm(at(float(x[0])), [axis])

    found = least_squares(errors, [1.0], diff_step=np.array([1e-3]))
    return at(float(found.x[0]))


def load(folder: Path, name: str) -> Axis:
    """Read a recording. Raises ConfigError, with the place to get it, if it is absent."""
    recorded = measured_emps(folder, name)
    if recorded is None:
        raise ConfigError(f"{folder / 'emps' / name} is missing: {WHERE}")
    experiment = recorded.experiment
    assert experiment.q_ref is not None
    volts = loadmat(folder / "emps" / name, variable_names=("pulses_N",)).get("pulses_N", np.zeros(len(experiment.q)))
    pulses = recorded.robot.joints[0].drive.gain * np.asarray(volts, dtype=np.float64).ravel()
    qd = central_difference(butterworth(experiment.q, EMPS_PERIOD, SMOOTHING_HZ, 4, 12), EMPS_PERIOD)
    qd[0] = 0.0
    return Axis(experiment.q[:, 0], qd[:, 0], experiment.q_ref[:, 0], experiment.tau[:, 0], pulses)


def report(folder: Path) -> str:
    """Return the tables of the exam. Raises ConfigError if a recording is missing."""
    training, held = load(folder, EMPS_FILE), load(folder, PULSES_FILE)
    ends = np.linspace(0, training.q.size, CYCLES + 1).astype(int)
    cycles = [training.part(slice(a, b)) for a, b in pairwise(ends)]
    start, candidates = chosen(cycles)
    plain, model = fitted(PUBLISHED, [training]), fitted(start, [training])
    level = level_on(model, held)
    factor = level["viscous_up"] / model["viscous_up"]
    rows = [
        ["networks, published", "", NETWORKS_MM, ""],
        ["asymmetric friction, published", "", ASYMMETRIC_MM, ""],
        ["symmetric friction, published", "", "", CLOSED_LOOP_PCT],
    ]
    for title, values in (
        ("published parameters of IDIM-LS, asymmetric friction", PUBLISHED),
        ("asymmetric friction, output error", plain),
        ("chosen on left-out cycles, output error", model),
        (f"no result: the same with {factor:.3f} times the friction, fitted to PULSES", level),
    ):
        rows.append([
            title, f"{rmse_mm(values, training):.2f}", f"{rmse_mm(values, held):.2f}",
            f"{closed_loop_error_pct(values, held):.2f}",
        ])  # fmt: skip
    return "\n\n".join([
        table(("friction", "left-out cycles, mm", "gain, mm2", ""), candidates),
        "chosen: " + ", ".join(f"{name} {value:.5g}" for name, value in model.items()),
        table(("from the force alone", "training, mm", "PULSES, held out, mm", "closed-loop force, PULSES, %"), rows),
    ])  # fmt: skip
