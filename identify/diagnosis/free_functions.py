"""Free functions of the variables on which a residual may depend, and the dependence with its curve."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.identify.diagnosis.study import Study
from armident.identify.diagnosis.variables import VARIABLES, Kind
from armident.identify.effects.free_shapes import hats
from armident.identify.robot.motion import Motion

SIDE = (0.0, 0.05, 0.15, 0.35, 0.65, 1.0)
"""Speeds of the knots of either direction, over the top speed: close at low speeds, where friction is curved."""

COARSE, FINE, FEW = 8, 24, 6
"""Knots over the range of a variable: of a wide shape, of a local one, and of one under many. Linear interpolation of
one wave over the range errs by (2 pi h)^2 / 8: 10, 1 and 20 % of its amplitude, 1, 0.01 and 4 % of its power."""

HARMONICS = 6
"""Harmonics of one set of functions of an angle."""

SETS = 4
"""Sets of functions of an angle: the first has harmonics 1 to `HARMONICS`, the next ones continue."""

POINTS = 121
"""Points of a curve."""


@dataclass(frozen=True)
class FreeFunction:
    """Basis functions of one variable from ``low`` to ``high``, for a joint's residual (thesis 7.3.2).

    ``other``: joint or motor of the variable, if another. ``knots``: of hats; wave numbers of angles; time constant, s.
    """

    joint: int
    kind: Kind
    other: int | None
    knots: tuple[float, ...]
    low: float
    high: float

    @property
    def directed(self) -> bool:
        """True if the shape changes sign with the direction of motion."""
        return self.kind.endswith("and direction")

    @property
    def key(self) -> tuple[object, ...]:
        """Key that sets of several joints with the same functions share."""
        at = self.joint if self.other is None else self.other
        if self.kind.startswith("time"):
            at = -1
        side = self.joint if self.directed else None
        return self.kind.removesuffix(" of another joint"), at, side, self.knots

    def variable(self, motion: Motion) -> Array:
        """Values of the variable, (N,). ``motion``: motion of the arm, N samples."""
        signal: Array = getattr(motion, VARIABLES[self.kind].signal)
        return signal if signal.ndim == 1 else signal[:, self.joint if self.other is None else self.other]

    def basis(self, x: Array, side: Array) -> Array:
        """Basis functions (N, k) of values ``x`` (N,) and the smoothed sign ``side`` (N,) of the joint's velocity."""
        if self.kind == "velocity":
            speed = hats(np.abs(x), self.knots)
            return np.concatenate([speed * (0.5 + 0.5 * side)[:, None], speed * (0.5 - 0.5 * side)[:, None]], axis=1)
        if self.kind == "motor angle":
            angles = x[:, None] * np.array(self.knots)
            return np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
        if self.kind.startswith("time"):
            # A slope and an exponential: they extrapolate beyond the recording.
            functions = np.stack([x / self.high, -np.expm1(-x / self.knots[0])], axis=1)
        else:
            functions = hats(x, self.knots)
        return functions * side[:, None] if self.directed else functions

    def columns(self, motion: Motion) -> Array:
        """Basis functions along a motion, without its lead, (N, k). ``motion``: motion of the arm."""
        return self.basis(self.variable(motion), motion.sign[:, self.joint])[motion.lead :]

    def on_grid(self) -> tuple[Array, Array, list[Array]]:
        """Points of the curve (G,), the basis there (G, k), and the parts of it that are smooth each, (G', k)."""
        x = np.linspace(self.low, self.high, POINTS)
        if self.kind == "velocity":
            basis = self.basis(x, np.sign(x))
            # The kink of dry friction at standstill is no roughness.
            return x, basis, [basis[x <= 0], basis[x >= 0]]
        basis = self.basis(x, np.ones_like(x))
        return x, basis, [basis]


def free_functions(study: Study, motions: Sequence[Motion], joint: int) -> Iterator[FreeFunction]:
    """All sets of functions for the residual of one joint, from the training stretches at simulated signals."""
    top = max(float(np.abs(m.qd[:, joint]).max()) for m in motions)
    if top > 0:
        yield FreeFunction(joint, "velocity", None, tuple(top * share for share in SIDE), -top, top)
    yield from _of_hats(joint, "position", None, motions, COARSE, FINE)
    yield from _of_hats(joint, "position and direction", None, motions, COARSE)
    kind: Kind
    for kind in ("time", "time and direction"):
        yield FreeFunction(joint, kind, None, (0.2 * study.duration,), 0.0, study.duration)
    yield from _of_hats(joint, "torque", None, motions, COARSE)
    yield from _of_hats(joint, "acceleration", None, motions, COARSE)
    yield from _of_hats(joint, "load", None, motions, COARSE)
    yield from _of_hats(joint, "load and direction", None, motions, FEW)
    for motor in np.flatnonzero(study.robot.transmission_matrix[:, joint]):
        yield from _of_angle(study, joint, int(motor), motions)
    for other in range(study.robot.n):
        if other != joint:
            for kind in ("velocity of another joint", "torque of another joint", "position of another joint"):
                yield from _of_hats(joint, kind, other, motions, FEW)


def _of_hats(
    joint: int, kind: Kind, other: int | None, motions: Sequence[Motion], *counts: int
) -> Iterator[FreeFunction]:
    """Knots at equal distances between the outermost values, so that every shape has the same resolution everywhere."""
    draft = FreeFunction(joint, kind, other, (0.0,), 0.0, 1.0)
    values = [draft.variable(m) for m in motions]
    low, high = min(float(x.min()) for x in values), max(float(x.max()) for x in values)
    if not high > low:
        return
    for count in counts:
        yield FreeFunction(joint, kind, other, tuple(np.linspace(low, high, count)), low, high)


def _of_angle(study: Study, joint: int, motor: int, motions: Sequence[Motion]) -> Iterator[FreeFunction]:
    """Harmonics of a motor angle; for a prismatic axis, whose pitch may be unknown, wave numbers of its travel."""
    angles = [m.motor[:, motor] for m in motions]
    low, high = min(float(x.min()) for x in angles), max(float(x.max()) for x in angles)
    if not high > low:
        return
    # Wave numbers under four half waves of the travel are in the functions of the position already.
    unit, first = 1.0, 1
    if study.robot.joints[joint].type == "prismatic":
        unit, first = np.pi / (high - low), 4
    else:
        low, high = 0.0, 2 * np.pi
    for block in range(SETS):
        waves = tuple(unit * (first + HARMONICS * block + k) for k in range(HARMONICS))
        yield FreeFunction(joint, "motor angle", motor, waves, low, high)


def in_band(study: Study, motion: Motion, functions: Sequence[FreeFunction]) -> dict[tuple[object, ...], Array]:
    """Basis functions (M, k) of every key along a motion at the working rate, in the band of the comparison."""
    unique = {f.key: f for f in functions}
    made = [f.columns(motion) for f in unique.values()]
    ends = np.cumsum([columns.shape[1] for columns in made])[:-1]
    # One call of the filter: it is hardly slower for many columns than for one.
    return dict(zip(unique, np.split(study.decimation(np.concatenate(made, axis=1)), ends, axis=1), strict=True))
