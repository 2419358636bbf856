"""Cases of the suite of random arms: two recordings of one arm, its configuration, and the truth."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.virtual_robot.random_arms.arm import Arm, Generator, random_arm
from armident.virtual_robot.random_arms.controllers import KINDS, finest_needed, random_controller
from armident.virtual_robot.random_arms.effects import NAMED, OUTSIDE, HiddenEffect, Place
from armident.virtual_robot.random_arms.halves import HALVES, Half, Ranges
from armident.virtual_robot.random_arms.mistakes import MISTAKES, SetUp
from armident.virtual_robot.random_arms.motions import Motion, random_motion
from armident.virtual_robot.random_arms.plant import Diverged, Plant, Run, healthy_plant, simulate
from armident.virtual_robot.random_arms.truth import ACCEPTED, Family, block
from armident.virtual_robot.random_arms.visibility import rigid_residual

Floats = NDArray[np.float64]

CONTROL_HZ = 4000.0
"""Lowest rate of control and integration, Hz."""
REFERENCE = 0.75
"""Probability that the reference positions are recorded."""
ATTEMPTS = 12
"""Arms, joints or controllers drawn for a case until one is stable and shows the effect."""
CALIBRATIONS = 4
"""Simulations in which the strength approaches the visibility aimed at."""
CLOSE = 0.15
"""Relative deviation of the excess residual at which the strength is left as it is."""
SHARE_COLOURED = 0.5
"""Probability that the torque noise is coloured."""


@dataclass(frozen=True)
class Truth:
    """What is hidden in a case.

    Parameters
    ----------
    name
        Name of the case.
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
        Figures of the law or mistake.
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

    Parameters
    ----------
    robot
        Robot as the user has configured it.
    recordings
        To learn from, and to judge by: arrays by name (``t``, ``q1``, ``tau1``, ``qr1`` ...).
    truth
        The truth.
    """

    robot: RobotConfig
    recordings: tuple[dict[str, Floats], dict[str, Floats]]
    truth: Truth

    def truth_document(self) -> dict[str, Any]:
        """Truth as a document for JSON."""
        return asdict(self.truth)


@dataclass(frozen=True, eq=False)
class _Draft:
    """A healthy arm with its motions, noise and first recording."""

    seed: tuple[int, ...]
    plant: Plant
    motions: tuple[Motion, Motion]
    healthy: Run
    noise: Floats
    coloured: Floats
    controller: str
    motion: str
    with_reference: bool


def kind_of(half: Half, index: int) -> tuple[Family, str]:
    """Family and kind of a case: blocks with the shares of the suite, each in an order of its own.

    Parameters
    ----------
    half
        Half of the suite.
    index
        Number of the case, from 0.
    """
    kinds = block()
    number, place = divmod(index, len(kinds))
    order = np.random.default_rng([HALVES[half].entropy, 1, number]).permutation(len(kinds))
    return kinds[order[place]]


def make_case(half: Half, index: int) -> RandomCase:
    """Draw and simulate a case; the same numbers give the same case.

    Parameters
    ----------
    half
        Half of the suite.
    index
        Number of the case, from 0.
    """
    family, kind = kind_of(half, index)
    ranges = HALVES[half]
    name = f"{'dev' if half == 'development' else 'reserve'}_{index:04d}"
    best: RandomCase | None = None
    for attempt in range(ATTEMPTS):
        seed = (ranges.entropy, 2, index, attempt)
        try:
            case = _attempt(name, family, kind, ranges, seed)
        except Diverged:
            continue
        if case is None:
            continue
        if best is None or case.truth.visibility > best.truth.visibility:
            best = case
        if family not in ("effect", "outside") or best.truth.visibility >= 1.02:
            break
    if best is None:
        raise Diverged(f"random arm {name}: no stable loop in {ATTEMPTS} attempts")
    return best


def _attempt(name: str, family: Family, kind: str, ranges: Ranges, seed: tuple[int, ...]) -> RandomCase | None:
    rng = np.random.default_rng([*seed, 0])
    draft = _draft(rng, ranges, seed)
    robot = configuration(draft.plant.arm, name)
    if kind in MISTAKES:
        mistake = MISTAKES[kind](np.random.default_rng([*seed, 1]), draft.plant.arm)
        return None if mistake is None else _with_mistake(name, kind, draft, robot, mistake)
    if kind == "missing_rotor":
        return _with_missing_rotor(name, draft, robot, np.random.default_rng([*seed, 1]))
    effect = {**NAMED, **OUTSIDE}.get(kind)
    if effect is None:
        return _finish(name, family, kind, draft, robot, draft.plant, (), None, 1.0)
    return _with_effect(name, family, kind, draft, robot, effect, ranges)


def _draft(rng: Generator, ranges: Ranges, seed: tuple[int, ...]) -> _Draft:
    arm = random_arm(rng, ranges)
    rate = float(rng.choice(ranges.rates))
    every = max(int(np.ceil(CONTROL_HZ / rate)), 1)
    step = 1.0 / (rate * every)
    kind = KINDS[rng.integers(len(KINDS))]
    control = random_controller(rng, arm, kind, ranges, step)
    arm = replace(arm, resolution=np.minimum(arm.resolution, finest_needed(arm, control)))
    motion = ("fourier", "point_to_point")[rng.integers(2)]
    duration = rng.uniform(*ranges.duration)
    motions = tuple(random_motion(rng, arm, motion, duration, step) for _ in range(2))  # type: ignore[arg-type]
    plant = healthy_plant(arm, control, step, every)
    healthy = simulate(plant, motions[0], np.array([*seed, 10]))
    noise = np.exp(rng.uniform(*np.log(ranges.noise), arm.n)) * healthy.torque.std(axis=0)
    times = np.exp(rng.uniform(*np.log(ranges.noise_time), arm.n))
    poles = np.where(rng.random(arm.n) < SHARE_COLOURED, np.exp(-1.0 / (rate * times)), 0.0)
    reference = bool(rng.random() < REFERENCE)
    return _Draft(seed, plant, (motions[0], motions[1]), healthy, noise, poles, kind, motion, reference)


def _noise(draft: _Draft, part: int, samples: int) -> Floats:
    """Torque noise: white, or of first order with the same variance; shape (M, n)."""
    from scipy.signal import lfilter

    rng = np.random.default_rng([*draft.seed, 3, part])
    out = np.empty((samples, draft.noise.size))
    for j, pole in enumerate(draft.coloured):
        drive = rng.normal(size=samples + 400)
        out[:, j] = draft.noise[j] * np.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], drive)[400:]
    return out


def _noisy(draft: _Draft, part: int, run: Run) -> Run:
    return replace(run, torque=run.torque + _noise(draft, part, len(run.t)))


def _simulated(draft: _Draft, plant: Plant, part: int) -> Run:
    return _noisy(draft, part, simulate(plant, draft.motions[part], np.array([*draft.seed, 10 + part])))


def _residual(robot: RobotConfig, run: Run) -> Floats:
    return rigid_residual(robot, run.q, run.qd, run.qdd, run.torque)


def _with_effect(
    name: str, family: Family, kind: str, draft: _Draft, robot: RobotConfig, effect: HiddenEffect, ranges: Ranges
) -> RandomCase:
    rng = np.random.default_rng([*draft.seed, 2])
    n = draft.plant.arm.n
    joint = int(rng.integers(n - 1 if effect.pair else n))
    aim = float(np.exp(rng.uniform(*np.log(ranges.visibility))))
    at = Place(joint, draft.motions[0], np.abs(draft.healthy.torque).max(axis=0))
    shape = [*draft.seed, 4]
    places = list(range(n)) if effect.arm else [joint, joint + 1] if effect.pair else [joint]

    def changed(strength: float) -> Plant:
        return effect.apply(draft.plant, at, strength, np.random.default_rng(shape))

    healthy = _residual(robot, _noisy(draft, 0, draft.healthy))

    def visibility(strength: float) -> tuple[float, Floats]:
        residual = _residual(robot, _simulated(draft, changed(strength), 0))
        return float((residual / healthy)[places].max()), residual

    strength, seen, residual = _calibrated(visibility, aim, effect.strengths)
    joints = () if effect.arm else tuple(robot.joints[j].name for j in places)
    return _finish(
        name, family, kind, draft, robot, changed(strength), joints, strength, seen, residual=residual, healthy=healthy
    )  # fmt: skip


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


def _with_missing_rotor(name: str, draft: _Draft, robot: RobotConfig, rng: Generator) -> RandomCase:
    joint = int(rng.integers(draft.plant.arm.n))
    run = _noisy(draft, 0, draft.healthy)
    joints = tuple(j.model_copy(update={"rotor_inertia": k != joint}) for k, j in enumerate(robot.joints))
    configured = robot.model_copy(update={"joints": joints})
    residual, healthy = _residual(configured, run), _residual(robot, run)
    seen = float(residual[joint] / healthy[joint])
    return _finish(
        name, "effect", "missing_rotor", draft, configured, draft.plant, (robot.joints[joint].name,), None, seen,
        residual=residual, healthy=healthy,
    )  # fmt: skip


def _with_mistake(name: str, kind: str, draft: _Draft, robot: RobotConfig, mistake: SetUp) -> RandomCase:
    plant = mistake.plant(draft.plant, np.abs(draft.healthy.torque).max(axis=0))
    joints = tuple(robot.joints[j].name for j in mistake.joints)
    healthy = _residual(robot, _noisy(draft, 0, draft.healthy))
    return _finish(
        name, "setup", kind, draft, robot, plant, joints, None, None, mistake.recorded, healthy, detail=mistake.detail
    )


def _finish(
    name: str,
    family: Family,
    kind: str,
    draft: _Draft,
    robot: RobotConfig,
    plant: Plant,
    joints: tuple[str, ...],
    strength: float | None,
    seen: float | None,
    recorded: Callable[[Run], Run] = lambda run: run,
    healthy: Floats | None = None,
    residual: Floats | None = None,
    detail: str = "",
) -> RandomCase:
    first, second = (recorded(_simulated(draft, plant, part)) for part in range(2))
    if residual is None:
        residual = _residual(robot, first)
    if healthy is None:
        healthy = residual
    if seen is None:
        # Units differ: the residual counts relative to the torque of the joint.
        size = np.sqrt((first.torque**2).mean(axis=0)) / np.sqrt((draft.healthy.torque**2).mean(axis=0))
        seen = float((residual / size / healthy).max())
    truth = Truth(
        name, family, kind, ACCEPTED[kind], joints, strength, seen, tuple(residual.tolist()), tuple(healthy.tolist()),
        tuple(draft.noise.tolist()), draft.controller, draft.motion, round(1.0 / (plant.step * plant.every), 6), detail,
    )  # fmt: skip
    arrays = tuple(_arrays(run, draft.with_reference) for run in (first, second))
    return RandomCase(robot, (arrays[0], arrays[1]), truth)


def _arrays(run: Run, with_reference: bool) -> dict[str, Floats]:
    out = {"t": run.t}
    columns = [("q", run.reading), ("tau", run.torque)] + ([("qr", run.reference)] if with_reference else [])
    for name, values in columns:
        out |= {f"{name}{j + 1}": np.ascontiguousarray(values[:, j]) for j in range(values.shape[1])}
    return out


def configuration(arm: Arm, name: str) -> RobotConfig:
    """Robot configuration of a healthy arm.

    Parameters
    ----------
    arm
        The arm.
    name
        Name of the robot.
    """
    joints = []
    for j in range(arm.n):
        alpha, d, theta, r = (float(x) for x in arm.mdh[j])
        limits = {
            "position": [-0.8, 0.8] if arm.prismatic[j] else [-3.1, 3.1],
            "velocity": 2.0 * float(arm.speed[j]),
            "acceleration": 100.0,
            "torque": 12.0 * float(arm.scale[j]),
        }
        joints.append(
            {
                "name": f"axis_{j + 1}",
                "type": "prismatic" if arm.prismatic[j] else "revolute",
                "mdh": {"alpha": alpha, "d": d, "theta": theta, "r": r},
                "limits": limits,
                "drive": {"signal": "torque"},
                "rotor_inertia": True,
            }
        )
    return RobotConfig.model_validate(
        {
            "schema": "armident/robot/1",
            "name": f"arm_{name}",
            "gravity": [0.0, 0.0, -9.81],
            "joints": joints,
            "transmission": np.diag(arm.ratio).tolist(),
        }
    )
