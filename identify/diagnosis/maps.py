"""Basis of the dependence of a residual on each variable: one effect of free shape for every variable."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armident.identify.diagnosis.study import Study
from armident.identify.effects.effect import Effect, Linear, Place
from armident.identify.robot.motion import Motion

Array = NDArray[np.float64]

Kind = Literal[
    "velocity", "position", "position and direction", "motor angle", "load", "load and direction", "torque",
    "acceleration", "time", "time and direction", "velocity of another joint", "torque of another joint",
    "frequency", "motion", "transients",
]  # fmt: skip
"""Variables; those with a direction have the opposite sign in the negative direction. The last three are no maps: a
frequency independent of the motion, unexplained power at the frequencies of the motion, and transients."""

SIDE = (0.0, 0.05, 0.15, 0.35, 0.65, 1.0)
"""Speeds of the knots of either direction, over the top speed: close at low speeds, where friction is curved."""

COARSE, FINE, FEW = 8, 24, 6
"""Knots over the range of a variable: of a wide shape, of a local one, and of one under many."""

TURN = 6
"""Harmonics of a map over an angle."""

TURNS = 4
"""Maps over an angle: the first has harmonics 1 to `TURN`, the next ones continue."""


@dataclass(frozen=True, eq=False)
class Map:
    """Free shape over one variable, at one joint.

    Parameters
    ----------
    joint
        Number of the joint of the residual.
    kind
        Kind of the variable.
    other
        Joint or motor to which the variable belongs, if it is another one.
    knots
        Knots of the hat functions, increasing; for an angle the wave numbers; for the time the time constant.
    low, high
        Range of the data.
    """

    joint: int
    kind: Kind
    other: int | None
    knots: tuple[float, ...]
    low: float = 0.0
    high: float = 1.0

    @property
    def key(self) -> str:
        """Unique name among the maps of a study."""
        return f"{self.kind} {self.other} {self.joint} {self.knots[0]} {len(self.knots)}"

    @property
    def directed(self) -> bool:
        """True if the shape changes sign with the direction of motion."""
        return self.kind.endswith("and direction")

    def variable(self, motion: Motion) -> Array:
        """Values of the variable, (N,)."""
        at = self.joint if self.other is None else self.other
        match self.kind:
            case "velocity" | "velocity of another joint":
                return motion.qd[:, at]
            case "position" | "position and direction":
                return motion.q[:, at]
            case "motor angle":
                return motion.motor[:, at]
            case "load" | "load and direction":
                return motion.transmitted[:, at]
            case "torque" | "torque of another joint":
                return motion.torque[:, at]
            case "acceleration":
                return motion.qdd[:, at]
            case _:
                return motion.t

    def shape(self, x: Array, side: Array) -> Array:
        """Basis functions (N, k).

        Parameters
        ----------
        x
            Values of the variable, (N,).
        side
            Smoothed sign of the velocity, (N,).
        """
        if self.kind == "velocity":
            speed = hats(np.abs(x), self.knots)
            return np.concatenate([speed * (0.5 + 0.5 * side)[:, None], speed * (0.5 - 0.5 * side)[:, None]], axis=1)
        if self.kind == "motor angle":
            angles = x[:, None] * np.array(self.knots)
            return np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
        if self.kind in ("time", "time and direction"):
            # A slope and an exponential: they extrapolate beyond the recording.
            basis = np.stack([x / self.high, -np.expm1(-x / self.knots[0])], axis=1)
        else:
            basis = hats(x, self.knots)
        return basis * side[:, None] if self.directed else basis

    def effect(self) -> Effect:
        """The map as an effect like those of the catalogue."""

        def columns(motion: Motion, place: Place) -> Array:
            return self.shape(self.variable(motion), motion.sign[:, place.joint])

        width = self.shape(np.zeros(1), np.zeros(1)).shape[1]
        return Effect(
            name=self.key,
            title=self.kind,
            says=self.kind,
            reference="Brunot 2017, section 7.3.2",
            linear=tuple(Linear(f"b{k}", ("", "")) for k in range(width)),
            columns=columns,
            needs="",
            predicts=True,
        )


def hats(x: Array, knots: Sequence[float] | Array) -> Array:
    """Piecewise linear functions (N, k), one at each knot, constant beyond the outermost.

    Parameters
    ----------
    x
        Values, (N,).
    knots
        Increasing knots, (k,).
    """
    at = np.asarray(knots, dtype=np.float64)
    left = np.clip(np.searchsorted(at, x, side="right") - 1, 0, at.size - 2)
    share = np.clip((x - at[left]) / (at[left + 1] - at[left]), 0.0, 1.0)
    out, rows = np.zeros((x.size, at.size)), np.arange(x.size)
    out[rows, left] = 1.0 - share
    out[rows, left + 1] = share
    return out


def maps(study: Study, motions: Sequence[Motion]) -> Iterator[Map]:
    """All maps of a study.

    Parameters
    ----------
    study
        Data with the robot.
    motions
        The training stretches at simulated signals.
    """
    ratios = study.robot.transmission_matrix
    for j in range(study.robot.n):
        top = max(float(np.abs(m.qd[:, j]).max()) for m in motions)
        yield Map(j, "velocity", None, tuple(top * share for share in SIDE), -top, top)
        yield from _hat_maps(j, "position", None, motions, COARSE, FINE)
        yield from _hat_maps(j, "position and direction", None, motions, COARSE)
        for motor in np.flatnonzero(ratios[:, j]):
            yield from _angle_maps(study, j, int(motor), motions)
        yield from _hat_maps(j, "load", None, motions, COARSE)
        yield from _hat_maps(j, "load and direction", None, motions, FEW)
        yield from _hat_maps(j, "torque", None, motions, COARSE)
        yield from _hat_maps(j, "acceleration", None, motions, COARSE)
        yield Map(j, "time", None, (0.2 * study.duration,), 0.0, study.duration)
        yield Map(j, "time and direction", None, (0.2 * study.duration,), 0.0, study.duration)
        for other in range(study.robot.n):
            if other != j:
                yield from _hat_maps(j, "velocity of another joint", other, motions, FEW)
                yield from _hat_maps(j, "torque of another joint", other, motions, FEW)


def _hat_maps(joint: int, kind: Kind, other: int | None, motions: Sequence[Motion], *counts: int) -> Iterator[Map]:
    """Knots at equal distances between the outermost values, so that every shape has the same resolution everywhere."""
    draft = Map(joint, kind, other, (0.0,))
    values = np.concatenate([draft.variable(m) for m in motions])
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return
    for count in counts:
        yield Map(joint, kind, other, tuple(np.linspace(low, high, count)), low, high)


def _angle_maps(study: Study, joint: int, motor: int, motions: Sequence[Motion]) -> Iterator[Map]:
    """Harmonics of a motor angle; for a prismatic axis, whose pitch may be unknown, wave numbers of its travel."""
    draft = Map(joint, "motor angle", motor, (1.0,))
    values = np.concatenate([draft.variable(m) for m in motions])
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return
    prismatic = study.robot.joints[joint].type == "prismatic"
    # Wave numbers under four half waves of the travel are in the maps over the position already.
    unit, first = (np.pi / (high - low), 4) if prismatic else (1.0, 1)
    for block in range(TURNS):
        waves = tuple(unit * (first + TURN * block + k) for k in range(TURN))
        yield Map(joint, "motor angle", motor, waves, low, high)
