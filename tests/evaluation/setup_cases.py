"""Recordings with a known set-up, of random arms of the development half and of two usual arms.

An arm is healthy, has an effect, one or two mistakes of the set-up, or a fault that no class of the check covers. The
truth is the correction that the recording needs: the identity where nothing, or nothing that has a name, is wrong.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from armident.configs import RobotConfig, load_robot
from armident.identify.setup.fit import Hypothesis
from armident.identify.signals.experiments import Experiment
from tests.evaluation.plants.arm import Arm
from tests.evaluation.plants.draft import Draft, configuration, draw_draft, noisy, simulated
from tests.evaluation.plants.effects import NAMED, OUTSIDE, Place, Shapes
from tests.evaluation.plants.halves import DEVELOPMENT
from tests.evaluation.plants.mistakes import MISTAKES, SetUp, scaled
from tests.evaluation.plants.plant import Diverged, Plant, Run
from tests.fixtures import setups

Floats = NDArray[np.float64]
Generator = np.random.Generator

ATTEMPTS = 12
"""Arms drawn for a number until one is stable."""
STREAM = 7
"""Word of the seeds that keeps these arms apart from those of the suite."""
USUAL = ("tx40", "kuka_lwr4")
"""Robots that are recorded with random links beside the random arms."""
EVERY_USUAL = 8
"""One of so many arms is a usual one."""
KGF_M = 9.80665


@dataclass(frozen=True, eq=False)
class SetupCase:
    """A recording, the robot as configured, and the truth. ``family``: healthy, effect, outside, single, double, other.

    ``truth``: correction of recording and configuration. ``arm``: number of the arm, by which cases are split.
    """

    arm: int
    family: str
    kind: str
    robot: RobotConfig
    experiments: tuple[Experiment, ...]
    truth: Hypothesis


def _one_factor(quantity: str, value: Callable[[Generator], float]) -> Callable[[Generator, Arm], SetUp]:
    def draw(rng: Generator, arm: Arm) -> SetUp:
        j, factor = int(rng.integers(arm.n)), np.ones(arm.n)
        factor[j] = value(rng)
        values: dict[str, Any] = {quantity: factor}
        return SetUp((j,), recorded=lambda run: scaled(run, **values))

    return draw


def _sign_set(rng: Generator, arm: Arm) -> SetUp:
    """Torques of any set of joints with the wrong sign."""
    turned = np.where(rng.random(arm.n) < 0.5, -1.0, 1.0)
    turned[rng.integers(arm.n)] = -1.0
    return SetUp((), recorded=lambda run: scaled(run, torque=turned))


def _percent(rng: Generator, arm: Arm) -> SetUp:
    factor = 100.0 / (arm.scale * rng.uniform(1.5, 4.0, arm.n))
    return SetUp((), recorded=lambda run: scaled(run, torque=factor))


ONE: dict[str, Callable[[Generator, Arm], SetUp | None]] = {
    **{kind: draw for kind, draw in MISTAKES.items() if kind != "clipped"},
    "kgf_m": _one_factor("torque", lambda rng: 1.0 / KGF_M),
    "kgf_cm": _one_factor("torque", lambda rng: 100.0 / KGF_M),
    "degrees_of_one": _one_factor("position", lambda rng: 180.0 / np.pi),
    "torque_of_one": _one_factor("torque", lambda rng: float(np.exp(rng.uniform(-3.0, 3.0)))),
    "sign_set": _sign_set,
    "percent": _percent,
}
"""Mistakes that a class of the check covers."""

PAIRED = (
    "position_sign", "torque_sign", "both_signs", "joint_order", "torque_order", "degrees", "torque_unit", "kgf_m",
    "gear_ratio", "motor_side_torque", "degrees_of_one", "sign_set", "another_gravity",
)  # fmt: skip
"""Mistakes of which two are made at once."""

Change = Callable[[Generator, Run, Run], Run]
"""Change of a recording; the second one is of another motion of the arm."""


def _torque_of(j: int, run: Run, values: Floats) -> Run:
    torque = run.torque.copy()
    torque[:, j] = values
    return replace(run, torque=torque)


def _absolute(rng: Generator, run: Run, other: Run) -> Run:
    return replace(run, torque=np.abs(run.torque))


def _absolute_of_one(rng: Generator, run: Run, other: Run) -> Run:
    j = int(rng.integers(run.q.shape[1]))
    return _torque_of(j, run, np.abs(run.torque[:, j]))


def _torque_of_another_recording(rng: Generator, run: Run, other: Run) -> Run:
    j = int(rng.integers(run.q.shape[1]))
    return _torque_of(j, run, other.torque[: run.t.size, j])


def _torques_of_another_recording(rng: Generator, run: Run, other: Run) -> Run:
    return replace(run, torque=other.torque[: run.t.size])


def _walk(rng: Generator, run: Run, other: Run) -> Run:
    j = int(rng.integers(run.q.shape[1]))
    walk = np.cumsum(rng.normal(size=run.t.size))
    return _torque_of(j, run, walk / walk.std() * run.torque[:, j].std())


def _frozen(rng: Generator, run: Run, other: Run) -> Run:
    j, reading = int(rng.integers(run.q.shape[1])), run.reading.copy()
    begin = int(run.t.size * rng.uniform(0.2, 0.7))
    reading[begin:, j] = reading[begin, j]
    return replace(run, reading=reading)


def _slow_torque(rng: Generator, run: Run, other: Run) -> Run:
    j = int(rng.integers(run.q.shape[1]))
    low = signal.butter(1, 0.3, fs=1.0 / (run.t[1] - run.t[0]), output="sos")
    return _torque_of(j, run, signal.sosfilt(low, run.torque[:, j]))


def _mixed_torques(rng: Generator, run: Run, other: Run) -> Run:
    i, j = rng.permutation(run.q.shape[1])[:2]
    ratio = run.torque[:, i].std() / run.torque[:, j].std()
    return _torque_of(i, run, run.torque[:, i] + rng.uniform(0.6, 1.5) * ratio * run.torque[:, j])


def _coupled_positions(rng: Generator, run: Run, other: Run) -> Run:
    i, j = rng.permutation(run.q.shape[1])[:2]
    reading = run.reading.copy()
    reading[:, i] += rng.choice([-1.0, 1.0]) * reading[:, j]
    return replace(run, reading=reading)


def _squared(rng: Generator, run: Run, other: Run) -> Run:
    return replace(run, torque=run.torque * np.abs(run.torque) / run.torque.std(axis=0))


def _noisy(rng: Generator, run: Run, other: Run) -> Run:
    return replace(run, torque=run.torque + 0.7 * run.torque.std(axis=0) * rng.normal(size=run.torque.shape))


def _growing_gain(rng: Generator, run: Run, other: Run) -> Run:
    j = int(rng.integers(run.q.shape[1]))
    return _torque_of(j, run, run.torque[:, j] * np.linspace(0.4, 1.6, run.t.size))


OTHER: dict[str, Change] = {
    "absolute": _absolute,
    "absolute_of_one": _absolute_of_one,
    "torque_of_another_recording": _torque_of_another_recording,
    "torques_of_another_recording": _torques_of_another_recording,
    "walk": _walk,
    "frozen": _frozen,
    "slow_torque": _slow_torque,
    "mixed_torques": _mixed_torques,
    "coupled_positions": _coupled_positions,
    "squared": _squared,
    "noisy": _noisy,
    "growing_gain": _growing_gain,
}
"""Faults of a recording that no class of the check covers."""

ARMS = ("home", "geometry")
"""Faults of the configuration that no class of the check covers."""

FAMILIES = {"healthy": 2, "effect": 3, "outside": 1, "single": 5, "double": 3, "other": 5}
"""Cases of each family in a round of one arm."""


def cases(arm: int, count: int) -> Iterator[SetupCase]:
    """Cases of one arm. ``arm``: number of the arm, from 0; ``count``: how many."""
    rng = np.random.default_rng([DEVELOPMENT.entropy, STREAM, 99, arm])
    usual = USUAL[arm // EVERY_USUAL % len(USUAL)] if arm % EVERY_USUAL == EVERY_USUAL - 1 else None
    draft = None if usual else _draft(arm)
    order = [family for family, share in FAMILIES.items() for _ in range(share)]
    order = [order[k] for k in rng.permutation(len(order))]
    made = 0
    for family in order:
        case = _case(rng, arm, family, draft, usual)
        if case is not None:
            yield case
            made += 1
        if made == count:
            return


def _draft(arm: int) -> Draft:
    for attempt in range(ATTEMPTS):
        seed = (DEVELOPMENT.entropy, STREAM, arm, attempt)
        try:
            return draw_draft(np.random.default_rng([*seed, 0]), DEVELOPMENT, seed)
        except Diverged:
            continue
    raise Diverged(f"arm {arm}: no stable loop in {ATTEMPTS} attempts")


def _case(rng: Generator, arm: int, family: str, draft: Draft | None, usual: str | None) -> SetupCase | None:
    # Random links replace the initial parameters of a usual robot, and its couplings have none.
    robot = (
        configuration(draft.plant.arm, f"calibration_{arm}")
        if draft
        else load_robot(usual or "").model_copy(update={"couplings": (), "initial_parameters": {}})
    )
    n, gravity = robot.n, np.array(robot.gravity)
    runs = (noisy(draft, 0, draft.healthy),) if draft else _usual_runs(robot, arm)
    shape = draft.plant.arm if draft else _shape(robot, runs[0])
    kind, truth = family, Hypothesis(np.eye(n), np.eye(n), gravity, np.zeros(n))
    run = runs[0]
    if family in ("effect", "outside"):
        if draft is None:
            return None
        table = NAMED if family == "effect" else OUTSIDE
        kind = str(rng.choice(list(table)))
        plant = _affected(rng, draft, kind, arm)
        if plant is None:
            return None
        try:
            run = simulated(draft, plant, 0)
        except Diverged:
            return None
        truth = replace(truth, gravity=plant.arm.gravity)
    elif family in ("single", "double"):
        kinds = [str(rng.choice(list(ONE)))] if family == "single" else [str(k) for k in rng.choice(PAIRED, 2, False)]
        kind = "+".join(kinds)
        for each in kinds:
            mistake = ONE[each](rng, shape)
            if mistake is None or (draft is None and mistake.plant is not SetUp(()).plant):
                return None
            if draft is not None:
                plant = mistake.plant(draft.plant, draft.peak)
                if plant is not draft.plant:
                    if run is not runs[0]:
                        return None
                    try:
                        run = simulated(draft, plant, 0)
                    except Diverged:
                        return None
                    truth = replace(truth, gravity=plant.arm.gravity * (not plant.without_gravity), shift=plant.delay)
            run, truth = mistake.recorded(run), _with(truth, mistake, n)
    elif family == "other":
        kind = str(rng.choice([*OTHER, *ARMS, *ARMS]))
        if kind in ARMS:
            robot = _another_arm(rng, robot, kind)
        else:
            second = runs[1] if draft is None else simulated(draft, draft.plant, 1)
            length = min(run.t.size, second.t.size)
            run = OTHER[kind](rng, _cut(run, length), second)
    reference = run.reference if draft is not None and draft.with_reference and family != "other" else None
    dt = float(run.t[1] - run.t[0])
    experiment = Experiment(np.ascontiguousarray(run.reading), np.ascontiguousarray(run.torque), reference, dt)
    return SetupCase(arm, family, kind, robot, (experiment,), truth)


def _affected(rng: Generator, draft: Draft, kind: str, arm: int) -> Plant | None:
    effect, n = {**NAMED, **OUTSIDE}[kind], draft.plant.arm.n
    joint = int(rng.integers(n - 1 if effect.pair else n))
    strength = float(np.clip(np.exp(rng.uniform(np.log(0.3), np.log(3.0))), *effect.strengths))
    shapes = Shapes([DEVELOPMENT.entropy, STREAM, arm, 4], DEVELOPMENT.wider)
    return effect.apply(draft.plant, Place(joint, draft.motions[0], draft.peak), strength, shapes)


def _with(truth: Hypothesis, mistake: SetUp, n: int) -> Hypothesis:
    """Truth with the correction of what a mistake does to unit vectors."""
    eye = np.eye(n)
    probe = mistake.recorded(Run(np.array([0.0, 1.0]), eye, eye, eye, eye, eye, eye))
    return replace(
        truth,
        position=truth.position @ np.linalg.inv(probe.reading.T),
        torque=truth.torque @ np.linalg.inv(probe.torque.T),
        clock=truth.clock / float(probe.t[1]),
    )


def _another_arm(rng: Generator, robot: RobotConfig, kind: str) -> RobotConfig:
    """Configuration with a wrong home position, or a wrong length or angle, of one joint."""
    joints, j = list(robot.joints), int(rng.integers(1, robot.n)) if robot.n > 1 else 0
    mdh = joints[j].mdh
    assert mdh is not None
    if kind == "home":
        shift = float(rng.choice([-1.0, 1.0]) * rng.choice([rng.uniform(0.1, 0.8), np.pi / 2]))
        name = "theta" if joints[j].type == "revolute" else "r"
        changed = {name: float(getattr(mdh, name)) + shift}
    else:
        name = str(rng.choice(["alpha", "d", "r"]))
        value = float(getattr(mdh, name))
        changed = {name: -value if name == "alpha" and value else value + float(rng.choice([-1, 1])) * 0.25}
    joints[j] = joints[j].model_copy(update={"mdh": mdh.model_copy(update=changed)})
    return robot.model_copy(update={"joints": tuple(joints)})


def _usual_runs(robot: RobotConfig, seed: int) -> tuple[Run, ...]:
    made = []
    for e in setups.record(robot, seed, dt=4e-3, duration=10.0):
        t = np.asarray(e.dt * np.arange(e.q.shape[0]), np.float64)
        made.append(Run(t, e.q, 0.0 * e.q, 0.0 * e.q, e.q, e.tau, e.q))
    return tuple(made)


def _shape(robot: RobotConfig, run: Run) -> Arm:
    """Return the facts of an arm, from a recording of it, that the mistakes need."""
    n, none = robot.n, np.zeros(0)
    prismatic = np.array([joint.type == "prismatic" for joint in robot.joints], np.int64)
    ratio = np.abs(np.diag(robot.transmission_matrix))
    return Arm(
        np.zeros((n, 4)), prismatic, np.ones(n), none, none, np.array(robot.gravity), ratio, none, none, none, none,
        run.torque.std(axis=0), none,
    )  # fmt: skip


def _cut(run: Run, length: int) -> Run:
    return Run(*(getattr(run, name)[:length] for name in ("t", "q", "qd", "qdd", "reading", "torque", "reference")))
