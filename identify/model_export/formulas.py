"""Torques of effects as formulas of one instant, in the notation that Python and C share.

An effect's columns are evaluated with symbols that record each operation, as elements of numpy's object arrays. A
formula is accepted if it has the effect's values along a random motion. Bristles and slow changes are states that relax
(`Memory`). Elasticity and backlash are the motion of a link in its gear (`Gear`), which the generated code computes.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import CodeType
from typing import Any

import numpy as np
from numba.core.errors import NumbaError

from armident.identify.effects.link import GravityDirection, across
from armident.identify.effects.parameter_change import ParameterChange
from armident.identify.effects.recording_corrections import of_recording
from armident.identify.effects.terms import Term, effect_terms
from armident.identify.effects.transmission import Backlash, Gear, JointElasticity
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Floats
from armident.identify.robot.motion import Motion

SAMPLES = 24
"""Instants of the random motion at which a formula is compared with its effect."""

PERIOD = 0.01
"""Sampling period of that motion, s: it passes bends of tables and the displacements of bristles."""

AGREEMENT = 1e-10
"""Largest difference between formula and effect, relative to the largest torque of the effect: rounding."""


class NotAFormula(Exception):
    """The torque of an effect depends on more than the present instant."""


@dataclass(frozen=True, eq=False)
class Formula:
    """Formula in the common notation of Python and C. ``rank``: binding strength: 0 sum, 1 product, 2 atom."""

    text: str
    rank: int = 2

    __array_ufunc__ = None
    """Numbers of numpy leave the operation to this class."""

    def __add__(self, other: "Formula | float") -> "Formula":
        """Return the sum; a zero is left out."""
        return self if _is(other, 0.0) else Formula(f"{self.text} + {_of(other).inside(0)}", 0)

    def __radd__(self, other: float) -> "Formula":
        """Return the sum."""
        return self if _is(other, 0.0) else Formula(f"{_of(other).text} + {self.inside(0)}", 0)

    def __sub__(self, other: "Formula | float") -> "Formula":
        """Return the difference."""
        return self if _is(other, 0.0) else Formula(f"{self.text} - {_of(other).inside(1)}", 0)

    def __rsub__(self, other: float) -> "Formula":
        """Return the difference."""
        return -self if _is(other, 0.0) else Formula(f"{_of(other).text} - {self.inside(1)}", 0)

    def __mul__(self, other: "Formula | float") -> "Formula | float":
        """Return the product; one and zero are simplified."""
        if _is(other, 0.0):
            return 0.0
        return self if _is(other, 1.0) else Formula(f"{self.inside(1)} * {_of(other).inside(1)}", 1)

    def __rmul__(self, other: float) -> "Formula | float":
        """Return the product."""
        if _is(other, 0.0):
            return 0.0
        return self if _is(other, 1.0) else Formula(f"{_of(other).inside(1)} * {self.inside(1)}", 1)

    def __truediv__(self, other: "Formula | float") -> "Formula":
        """Return the quotient."""
        return self if _is(other, 1.0) else Formula(f"{self.inside(1)} / {_of(other).inside(2)}", 1)

    def __pow__(self, power: float) -> "Formula":
        """Return the power."""
        return Formula(f"pow({self.text}, {_of(power).text})")

    def __neg__(self) -> "Formula":
        """Return the negative."""
        return Formula(f"-{self.inside(2)}", 1)

    def __abs__(self) -> "Formula":
        """Return the magnitude."""
        return self._call("fabs")

    def inside(self, rank: int) -> str:
        """Return the text, in brackets unless it binds at least as strongly as ``rank``."""
        return self.text if self.rank >= rank else f"({self.text})"

    def hats(self, knots: Floats) -> "list[Formula]":
        """Return the piecewise linear functions at increasing knots, constant beyond the outermost.

        ``hat(x, left, top, right)`` rises from 0 at ``left`` to 1 at ``top``, and stays 1 where an end is ``top``.
        """
        ends = [knots[0], *knots, knots[-1]]
        return [
            Formula(f"hat({self.text}, {', '.join(_of(float(x)).text for x in ends[k : k + 3])})")
            for k in range(knots.size)
        ]

    def bristle(self, displacement: float) -> "Formula":
        """Return Dahl's friction over its level at this position."""
        return Formula(f"bristle({self.text}, {_of(displacement).text})")

    # Functions that numpy looks up as methods of the elements of an array of objects.
    def sin(self) -> "Formula":
        """Return the sine."""
        return self._call("sin")

    def cos(self) -> "Formula":
        """Return the cosine."""
        return self._call("cos")

    def tanh(self) -> "Formula":
        """Return the hyperbolic tangent."""
        return self._call("tanh")

    def arctan(self) -> "Formula":
        """Return the arctangent."""
        return self._call("atan")

    def arcsinh(self) -> "Formula":
        """Return the inverse hyperbolic sine."""
        return self._call("asinh")

    def exp(self) -> "Formula":
        """Return the exponential."""
        return self._call("exp")

    def expm1(self) -> "Formula":
        """Return the exponential less one."""
        return self._call("expm1")

    def log(self) -> "Formula":
        """Return the natural logarithm."""
        return self._call("log")

    def sqrt(self) -> "Formula":
        """Return the square root."""
        return self._call("sqrt")

    def _call(self, function: str) -> "Formula":
        return Formula(f"{function}({self.text})")


def _is(value: "Formula | float", number: float) -> bool:
    return not isinstance(value, Formula) and float(value) == number


def _of(value: "Formula | float") -> Formula:
    """Return a number as a formula with all its digits; a negative one is in brackets."""
    if isinstance(value, Formula):
        return value
    text = repr(float(value))
    return Formula(text if value >= 0 else f"({text})")


def hat(x: float, left: float, top: float, right: float) -> float:
    """Return the function of `Formula.hats`, as the generated code has it. ``x``: variable."""
    if x < top:
        return 1.0 if left == top else max(0.0, (x - left) / (top - left))
    return 1.0 if right == top else max(0.0, (right - x) / (right - top))


FUNCTIONS: dict[str, Callable[..., float]] = {
    **{name: getattr(math, name) for name in ("sin", "cos", "tanh", "atan", "asinh", "exp", "expm1", "log", "sqrt")},
    "pow": math.pow,
    "fabs": math.fabs,
    "hat": hat,
}
"""Functions of formulas by name; all but ``hat`` are in Python's ``math`` and in C's ``math.h``."""


def evaluate(text: str, signals: Mapping[str, Any]) -> float:
    """Return the value of a formula. ``signals``: values of its symbols by name and joint."""
    # The text is made of numbers, symbols and names of `FUNCTIONS` by the class above.
    value: float = eval(_code(text), {"__builtins__": {}, **FUNCTIONS}, dict(signals))
    return value


@cache
def _code(text: str) -> CodeType:
    return compile(text, "formula", "eval")


class _Instant(Motion):
    """Motion whose one sample consists of symbols."""

    @cached_property
    def torque(self) -> Any:
        """Torques that the model predicts without effects."""
        return _symbols("torque", self.n)

    @cached_property
    def transmitted(self) -> Any:
        """Torques of the links."""
        return _symbols("load", self.n)

    @cached_property
    def sign(self) -> Any:
        """Smoothed signs of the velocities."""
        return _symbols("sign", self.n)

    @cached_property
    def t(self) -> Any:
        """Time since the beginning."""
        return np.array([Formula("time")], dtype=object)

    @property
    def whole_time(self) -> float:
        """Duration of the recordings of the identification, s."""
        return self.duration

    def _unknown(self, *_: Any, **__: Any) -> Any:
        raise NotAFormula

    top_speed = span = standard = links = property(_unknown)
    rate = slopes = response = _unknown


def _symbols(name: str, n: int) -> Any:
    """Return one row of symbols ``name[j]``, (1, n)."""
    return np.array([[Formula(f"{name}[{j}]") for j in range(n)]], dtype=object)


@dataclass(frozen=True)
class Memory:
    """State of an effect, zero at the beginning: it approaches ``target`` at ``rate`` (1/s), formulas of ``dq``."""

    rate: str
    target: str


_MEMORIES: tuple[tuple[str, str, str, str], ...] = (
    (r"bristle\(q\[(\d+)\], ([^()]+)\)", "memory[{k}]", "fabs(dq[{0}]) / {1}", "(dq[{0}] > 0.0) - (dq[{0}] < 0.0)"),
    (r"expm1\(-time / ([^()]+)\)", "(-memory[{k}])", "1.0 / {0}", "1.0"),
    (
        r"expm1\(\(-([^()]+)\) \* dt \* pow\(dq\[(\d+)\], 2\.0\)\)",
        "(-memory[{k}])",
        "{0} * dq[{1}] * dq[{1}]",
        "1.0",
    ),
)
"""Patterns of states in formulas (bristle, progress with time, progress with work), their symbol, rate and target."""


def _with_memory(text: str, memory: list[Memory]) -> str:
    """Return a formula with its states as ``memory[k]``; new ones are appended to ``memory``."""
    for pattern, symbol, rate, target in _MEMORIES:

        def state(found: re.Match[str], symbol: str = symbol, rate: str = rate, target: str = target) -> str:
            each = Memory(rate.format(*found.groups()), target.format(*found.groups()))
            if each not in memory:
                memory.append(each)
            return symbol.format(k=memory.index(each))

        text = re.sub(pattern, state, text)
    return text


@dataclass(frozen=True, eq=False)
class InstantModel:
    """Dynamics of one instant: standard parameters (p,), gravity (3,) in the base frame, and effects as formulas.

    ``torques``: formulas by number of the effect and joint, N m or N. Symbols: ``q``, ``dq``, ``ddq``; ``sign``, the
    smoothed sign of the velocity; ``load``, torque of the links; ``torque``, that of links, rotors, couplings and
    friction; ``memory``, the states. ``gears``: elasticity and backlash by number of the effect. ``held``: numbers of
    the effects that the model contains.
    """

    theta: Floats
    gravity: Floats
    torques: dict[int, dict[int, str]]
    held: frozenset[int]
    memory: tuple[Memory, ...]
    gears: dict[int, Gear]


def instant_model(arm: ArmModel, theta: Floats, duration: float) -> InstantModel:
    """Return the dynamics of an arm at one instant, with its effects that have formulas.

    ``duration``: that of the recordings of the identification, s.
    """
    theta, gravity = theta.copy(), arm.chain.gravity.copy()
    torques: dict[int, dict[int, str]] = {}
    held: set[int] = set()
    memory: list[Memory] = []
    gears: dict[int, Gear] = {}
    known = replace(arm, anchor=theta.copy())
    still = np.zeros((1, arm.n))
    anywhere = known.motion(still, still, still, dt=PERIOD)
    first = len(arm.names) - arm.e
    for number, term in _numbered_terms(arm):
        values = theta[first : first + len(term.names)].copy()
        first += len(term.names)
        if isinstance(term.effect, ParameterChange):
            names = term.effect.parameters(term.place, arm.n)
            for k, value in zip(term.kept, values, strict=True):
                theta[arm.names.index(names[k])] += value
        elif isinstance(term.effect, GravityDirection):
            size = float(np.linalg.norm(arm.chain.gravity))
            tilts = [k for k in term.kept if k < len(GravityDirection.linear)]
            gravity += size * (values[: len(tilts)] @ across(arm.chain.gravity)[tilts]) if size else 0.0
            if len(tilts) < len(term.kept):
                turned = _symbols("q", 1)[0, 0]
                functions = (turned.cos(), turned.sin())
                rest = zip(term.kept[len(tilts) :], values[len(tilts) :], strict=True)
                torque = sum(float(value) * functions[k - len(GravityDirection.linear)] for k, value in rest)
                torques[number] = {0: _of(torque).text}
        elif isinstance(term.effect, JointElasticity | Backlash):
            shapes = {**term.effect.defaults, **term.shapes}
            gear = term.effect.gear(anywhere, term.place, shapes, float(values[0]))
            if gear.least <= 0.0:  # no inertia is left to the link
                continue
            gears[number] = gear
        else:
            found = _formulas(known, term, values, duration, memory)
            if found is None:
                continue
            torques[number] = found
        held.add(number)
    return InstantModel(theta, gravity, torques, frozenset(held), tuple(memory), gears)


def _numbered_terms(arm: ArmModel) -> list[tuple[int, Term]]:
    """Return the terms with the numbers of their entries in the configuration."""
    numbers = [k for k, entry in enumerate(arm.robot.effects) if not of_recording(entry)]
    return list(zip(numbers, effect_terms(arm), strict=True))


def _formulas(
    arm: ArmModel, term: Term, values: Floats, duration: float, memory: list[Memory]
) -> dict[int, str] | None:
    """Return the torque of a term by joint, with new states in ``memory``; ``None`` if it has no formula."""
    q, dq, ddq = (_symbols(name, arm.n) for name in ("q", "dq", "ddq"))
    period: Any = np.array([Formula("dt")], dtype=object)
    motion = _Instant(arm, q, dq, ddq, dt=period, theta=arm.anchor, duration=duration)
    states = list(memory)
    try:
        with np.errstate(invalid="ignore"):
            columns = term.effect.columns(motion, term.place, {**term.effect.defaults, **term.shapes})
        row = columns[0][None, :] if columns.ndim == 2 else columns[0]
        joints = [term.place.joint] if columns.ndim == 2 else range(arm.n)
        found = {}
        for j, of_joint in zip(joints, row, strict=True):
            torque = sum(value * of_joint[k] for k, value in zip(term.kept, values, strict=True) if value != 0.0)
            if not _is(torque, 0.0):
                found[j] = _with_memory(_of(torque).text, states)
        right = _agrees(arm, term, values, found, states, duration)
    except (NotAFormula, NumbaError, TypeError, ValueError, AttributeError, IndexError, NameError):
        # Effects of other packages may do anything with symbols; what is no formula is named as left out.
        return None
    if right:
        memory[:] = states
    return found if right else None


def _agrees(
    arm: ArmModel, term: Term, values: Floats, formulas: Mapping[int, str], memory: Sequence[Memory], duration: float
) -> bool:
    """Return True if the formulas have the torques of the term along a random motion from rest."""
    rng = np.random.default_rng(0)
    dq, ddq = (rng.uniform(-scale, scale, (SAMPLES, arm.n)) for scale in (2.0, 8.0))
    dq[0] = 0.0
    q = rng.uniform(-1.5, 1.5, arm.n) + PERIOD * np.cumsum(dq, axis=0)
    motion = replace(arm.motion(q, dq, ddq, dt=PERIOD), duration=duration)
    expected = np.zeros((SAMPLES, arm.n))
    term.add_torque(motion, values, expected)
    signals = {"q": q, "dq": dq, "ddq": ddq, "sign": motion.sign}
    if term.depends_on_torque:
        signals |= {"torque": motion.torque, "load": motion.transmitted}
    found, state = np.zeros((SAMPLES, arm.n)), np.zeros(len(memory))
    for k in range(SAMPLES):
        row = {name: values[k].tolist() for name, values in signals.items()}
        for m, each in enumerate(memory if k else ()):
            state[m] -= (evaluate(each.target, row) - state[m]) * math.expm1(-PERIOD * evaluate(each.rate, row))
        for j, text in formulas.items():
            found[k, j] = evaluate(text, {**row, "memory": state})
    scale = max(float(np.abs(expected).max()), 1e-300)
    return bool(np.abs(found - expected).max() <= AGREEMENT * scale)
