"""Cases of the suite of random arms: two recordings of one arm, its configuration, and the truth."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from tests.evaluation.plants.draft import Draft, configuration, draw_draft, noisy, simulated
from tests.evaluation.plants.effects import NAMED, OUTSIDE, HiddenEffect, Place, Shapes
from tests.evaluation.plants.halves import HALVES, Half, Ranges
from tests.evaluation.plants.mistakes import MISTAKES, SetUp
from tests.evaluation.plants.motions import Motion
from tests.evaluation.plants.plant import Diverged, Plant, Run, simulate
from tests.evaluation.plants.slots import SMOOTHING
from tests.evaluation.plants.truth import ACCEPTED, Family, block
from tests.evaluation.plants.visibility import rigid_residual

Floats = NDArray[np.float64]
Recording = dict[str, Floats]
"""Arrays of a recording by name: ``t``, ``q1``, ``tau1``, ``qr1`` ..."""

ATTEMPTS = 12
"""Arms drawn for a case until one is stable and shows the effect."""
LEAST_SEEN = 1.02
"""Visibility with which a drawn arm is kept."""
CALIBRATIONS = 4
"""Simulations in which the strength approaches the visibility aimed at."""
CLOSE = 0.15
"""Relative deviation of the excess residual at which the strength is left as it is."""


@dataclass(frozen=True)
class Truth:
    """The hidden part of a case.

    Parameters
    ----------
    family, kind
        Family, and kind of the hidden effect or mistake.
    accepted
        Names of findings that are right.
    joints
        Names of the joints at which a finding is right; empty for the whole arm.
    strength
        Strength; 1 is typical; ``None`` for mistakes and healthy arms.
    visibility
        Residual of the rigid model with the effect over that without, same seeds; 1 for healthy arms.
    residual, healthy_residual
        Residuals of the rigid model by joint, with and without the effect, N m or N.
    noise
        Standard deviation of the torque noise by joint, N m or N.
    controller, motion, rate_hz
        Family of controller and motion, and sampling rate.
    detail
        Figures of the mistake.
    """

    name: str
    family: Family
    kind: str
    accepted: tuple[str, ...]
    joints: tuple[str, ...]
    strength: float | None
    visibility: float
    residual: tuple[float, ...]
    healthy_residual: tuple[float, ...]
    noise: tuple[float, ...]
    controller: str
    motion: str
    rate_hz: float
    detail: str = ""


@dataclass(frozen=True, eq=False)
class RandomCase:
    """A case: the robot as configured, two recordings, and the truth.

    ``robot``: robot as the user has configured it. ``recordings``: to learn from, and to judge by. ``twin``: the same
    arm without the hidden effect, same seeds; ``None`` where it was not asked for.
    """

    robot: RobotConfig
    recordings: tuple[Recording, Recording]
    truth: Truth
    twin: "RandomCase | None" = None

    def truth_document(self) -> dict[str, Any]:
        """Truth as a document for JSON."""
        return asdict(self.truth)


@dataclass(frozen=True, eq=False)
class _Hidden:
    """Hidden effect or mistake of a case, with plant, configuration and joints; see `Truth`."""

    family: Family
    kind: str
    plant: Plant
    robot: RobotConfig
    joints: tuple[str, ...] = ()
    strength: float | None = None
    visibility: float | None = 1.0
    residual: Floats | None = None
    healthy: Floats | None = None
    recorded: Callable[[Run], Run] = field(default=lambda run: run)
    detail: str = ""


def kind_of(half: Half, index: int) -> tuple[Family, str]:
    """Family and kind of a case: blocks with the shares of the suite, each in an order of its own.

    ``index``: number of the case, from 0.
    """
    kinds = block()
    number, place = divmod(index, len(kinds))
    order = np.random.default_rng([HALVES[half].entropy, 1, number]).permutation(len(kinds))
    return kinds[int(order[place])]


def make_case(half: Half, index: int, *, with_twin: bool = False) -> RandomCase:
    """Draw and simulate a case; the same numbers give the same case.

    ``half``: half of the suite; ``index``: number of the case, from 0; ``with_twin``: simulate the healthy twin of a
    case with an effect of the catalogue too. Raises Diverged if no drawn arm has a stable loop.
    """
    return _drawn(half, index, with_twin)[2]


def answering(half: Half, index: int) -> Callable[[Floats, int], Recording]:
    """Return the arm of a case as a function of references at its step of control (K, n), and the number of its noise.

    Rows of a recording differ from those of its case by motion and noise alone.
    """
    draft, hidden, _ = _drawn(half, index, False)

    def play(position: Floats, number: int) -> Recording:
        motion = Motion(position, np.gradient(position, draft.plant.step, axis=0))
        run = noisy(draft, 1 + number, simulate(hidden.plant, motion, (*draft.seed, 11 + number)))
        return _arrays(hidden.recorded(run), draft.with_reference)

    return play


@lru_cache(maxsize=1)
def _drawn(half: Half, index: int, with_twin: bool) -> tuple[Draft, _Hidden, RandomCase]:
    family, kind = kind_of(half, index)
    ranges = HALVES[half]
    name = f"{half}_{index:04d}"
    best: tuple[Draft, _Hidden, RandomCase] | None = None
    for attempt in range(ATTEMPTS):
        try:
            draft, hidden = _attempt(name, family, kind, ranges, (ranges.entropy, 2, index, attempt))
            if hidden is None:
                continue
            case = _case(name, draft, hidden)
            if with_twin and family == "effect":
                case = replace(case, twin=_twin(name, draft))
        except Diverged:
            continue
        if best is None or case.truth.visibility > best[2].truth.visibility:
            best = draft, hidden, case
        if family not in ("effect", "outside") or best[2].truth.visibility >= LEAST_SEEN:
            break
    if best is None:
        raise Diverged(f"random arm {name}: no stable loop in {ATTEMPTS} attempts")
    return best


def _attempt(
    name: str, family: Family, kind: str, ranges: Ranges, seed: tuple[int, ...]
) -> tuple[Draft, _Hidden | None]:
    draft = draw_draft(np.random.default_rng([*seed, 0]), ranges, seed)
    robot = configuration(draft.plant.arm, name)
    if kind in MISTAKES:
        mistake = MISTAKES[kind](np.random.default_rng([*seed, 1]), draft.plant.arm)
        return draft, None if mistake is None else _mistaken(kind, draft, robot, mistake)
    if kind == "missing_rotor":
        return draft, _missing_rotor(draft, robot, np.random.default_rng([*seed, 1]))
    effect = {**NAMED, **OUTSIDE}.get(kind)
    if effect is None:
        return draft, _Hidden(family, kind, draft.plant, robot)
    return draft, _affected(family, kind, draft, robot, effect, ranges)


def _residual(draft: Draft, robot: RobotConfig, run: Run) -> Floats:
    return rigid_residual(robot, run.q, run.qd, run.qdd, run.torque, draft.plant.laws[:, SMOOTHING])


def _affected(
    family: Family, kind: str, draft: Draft, robot: RobotConfig, effect: HiddenEffect, ranges: Ranges
) -> _Hidden:
    rng = np.random.default_rng([*draft.seed, 2])
    n = draft.plant.arm.n
    joint = int(rng.integers(n - 1 if effect.pair else n))
    aim = float(np.exp(rng.uniform(*np.log(ranges.visibility))))
    at = Place(joint, draft.motions[0], draft.peak)
    places = list(range(n)) if effect.arm else [joint, joint + 1] if effect.pair else [joint]

    def changed(strength: float) -> Plant:
        return effect.apply(draft.plant, at, strength, Shapes([*draft.seed, 4], ranges.wider))

    healthy = _residual(draft, robot, noisy(draft, 0, draft.healthy))

    def visibility(strength: float) -> tuple[float, Floats]:
        residual = _residual(draft, robot, simulated(draft, changed(strength), 0))
        return float((residual / healthy)[places].max()), residual

    strength, seen, residual = _calibrated(visibility, aim, effect.strengths)
    joints = () if effect.arm else tuple(robot.joints[j].name for j in places)
    return _Hidden(family, kind, changed(strength), robot, joints, strength, seen, residual, healthy)


def _calibrated(
    visibility: Callable[[float], tuple[float, Floats]], aim: float, limits: tuple[float, float]
) -> tuple[float, float, Floats]:
    """Strength whose visibility is near the one aimed at, its visibility and its residuals.

    The variance of the residual that a weak effect adds grows with the square of its strength. Strengths at which the
    loop is not stable are left out.
    """
    strength, low, high = float(np.clip(1.0, *limits)), *limits
    tried: list[tuple[float, float, float, Floats]] = []
    for _ in range(CALIBRATIONS):
        try:
            seen, residual = visibility(strength)
        except Diverged:
            high = strength / 1.5
            strength = float(np.clip(strength / 3.0, low, high))
            continue
        wanted = max(aim**2 - 1.0, 1e-3)
        has = max(seen**2 - 1.0, 1e-4)
        tried.append((abs(np.log(has / wanted)), strength, seen, residual))
        if abs(np.sqrt(has / wanted) - 1.0) < CLOSE:
            break
        following = float(np.clip(strength * np.clip(np.sqrt(wanted / has), 0.1, 6.0), low, high))
        if abs(following / strength - 1.0) < 0.02:
            break
        strength = following
    if not tried:
        raise Diverged("random arm: the effect makes the loop unstable at any strength")
    _, strength, seen, residual = min(tried, key=lambda one: one[0])
    return strength, seen, residual


def _missing_rotor(draft: Draft, robot: RobotConfig, rng: np.random.Generator) -> _Hidden:
    joint = int(rng.integers(draft.plant.arm.n))
    run = noisy(draft, 0, draft.healthy)
    joints = tuple(j.model_copy(update={"rotor_inertia": k != joint}) for k, j in enumerate(robot.joints))
    configured = robot.model_copy(update={"joints": joints})
    residual, healthy = _residual(draft, configured, run), _residual(draft, robot, run)
    seen = float(residual[joint] / healthy[joint])
    name = robot.joints[joint].name
    return _Hidden("effect", "missing_rotor", draft.plant, configured, (name,), None, seen, residual, healthy)


def _mistaken(kind: str, draft: Draft, robot: RobotConfig, mistake: SetUp) -> _Hidden:
    return _Hidden(
        "setup",
        kind,
        mistake.plant(draft.plant, draft.peak),
        robot,
        tuple(robot.joints[j].name for j in mistake.joints),
        visibility=None,
        healthy=_residual(draft, robot, noisy(draft, 0, draft.healthy)),
        recorded=mistake.recorded,
        detail=mistake.detail,
    )


def _case(name: str, draft: Draft, hidden: _Hidden) -> RandomCase:
    first, second = (hidden.recorded(simulated(draft, hidden.plant, part)) for part in range(2))
    residual = _residual(draft, hidden.robot, first) if hidden.residual is None else hidden.residual
    healthy = residual if hidden.healthy is None else hidden.healthy
    seen = hidden.visibility
    if seen is None:
        # Units differ: the residual counts relative to the torque of the joint.
        size = np.sqrt((first.torque**2).mean(axis=0)) / np.sqrt((draft.healthy.torque**2).mean(axis=0))
        seen = float((residual / size / healthy).max())
    truth = Truth(
        name, hidden.family, hidden.kind, ACCEPTED[hidden.kind], hidden.joints, hidden.strength, seen,
        tuple(residual.tolist()), tuple(healthy.tolist()), tuple(draft.noise.tolist()), draft.controller, draft.motion,
        draft.rate, hidden.detail,
    )  # fmt: skip
    return RandomCase(
        hidden.robot, (_arrays(first, draft.with_reference), _arrays(second, draft.with_reference)), truth
    )


def _twin(name: str, draft: Draft) -> RandomCase | None:
    """Healthy twin; ``None`` in the rare case that only the hidden effect makes the loop stable."""
    healthy = _Hidden("healthy", "healthy", draft.plant, configuration(draft.plant.arm, name))
    try:
        return _case(name, draft, healthy)
    except Diverged:
        return None


def _arrays(run: Run, with_reference: bool) -> Recording:
    out = {"t": run.t}
    columns = [("q", run.reading), ("tau", run.torque)] + ([("qr", run.reference)] if with_reference else [])
    for name, values in columns:
        out |= {f"{name}{j + 1}": np.ascontiguousarray(values[:, j]) for j in range(values.shape[1])}
    return out
