"""Motions that an investigation considers: all families at the doubtful joints, within the limits of the arm."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armident.arrays import Array
from armident.configs import ConfigError, RobotConfig, Trajectory
from armident.daq.recording import Recording
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.documents.diagnosis import Explanation
from armident.identify.documents.investigation import MotionChoice
from armident.identify.effects.terms import arm_model
from armident.identify.excitation.collision import CollisionModel
from armident.identify.excitation.design import PERIOD, Design, design_trajectory, excesses
from armident.identify.excitation.point_to_point import (
    predicted_torque,
    sample_trajectory,
    slow_share,
    torque_deviation,
)
from armident.identify.identification.from_recording import experiments_of
from armident.identify.investigation.motions import FAMILIES, MARGIN, Reach, reach_of
from armident.identify.investigation.question import Question, question
from armident.identify.investigation.rivals import rivals_of, uncertain

EXCITATION = "fast_excitation"
"""Name of the motion of all joints that is designed for the parameters of the model."""
EXCITATION_S, EVALUATIONS = 8.0, 150
"""Length of that motion, s, and number of candidates of its design."""
OVERHEAD_S = 20.0
"""Time of one more round beside its motion, s: approach, begin and end of a recording, and a diagnosis while the arm
waits. With less, motions that tell little win because they are short."""
JOINTS = 2
"""Joints at which motions are compared: the most doubtful ones."""
LISTED = 8
"""Motions of a round that the document lists."""
LEAST_GAIN = 0.05
"""Expected fall of the entropy, nats, below which a motion tells nothing: a tenth of that of two equal explanations."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """The next motion with the others that were considered; ``choice``: ``None`` if no motion can tell.

    ``trajectory``: the motion to play; ``answer``: the recording of a motion of the past.
    """

    question: str
    considered: tuple[MotionChoice, ...]
    choice: MotionChoice | None = None
    trajectory: Trajectory | None = None
    answer: Recording | None = None


def first_motion(robot: RobotConfig, collision: CollisionModel) -> Chosen:
    """Return the motion of an arm of which there is no recording: an excitation at the speeds of first contact."""
    still = np.zeros(robot.n)
    made = excitation_of(robot, reach_of(robot, home_of(robot), still, still), None, collision)
    return _alone(f"what is the model of {robot.name}?", *made)


def confirming_motion(state: ModelState, collision: CollisionModel, done: Sequence[MotionChoice]) -> Chosen:
    """Return the motion that confirms that nothing is missing: an excitation of all joints, if it is not done yet."""
    theta, asked = state.fit.theta, "does a second motion show anything that is missing?"
    choice, trajectory = excitation_of(state.robot, reach_of_recordings(state), theta, collision)
    if trajectory is not None:
        reason = excluded(state.robot, trajectory, theta, collision, state.fit.covariance)
        choice, trajectory = choice.model_copy(update={"excluded": reason}), None if reason else trajectory
    return Chosen(asked, (choice,)) if _key(choice) in map(_key, done) else _alone(asked, choice, trajectory)


def _alone(asked: str, choice: MotionChoice, trajectory: Trajectory | None) -> Chosen:
    """Return the only motion that was considered."""
    return Chosen(asked, (choice,), None if trajectory is None else choice, trajectory)


def next_motion(
    state: ModelState,
    explanations: Sequence[Explanation],
    collision: CollisionModel,
    done: Sequence[MotionChoice],
    left_s: float,
) -> Chosen:
    """Return the motion that tells the explanations apart most per second of robot time, among those not done yet."""
    reach, past = reach_of_recordings(state), {_key(one) for one in done}
    open_questions, asked = _questions(state, explanations)
    made: list[tuple[float, MotionChoice, Trajectory]] = []
    for one, posed in open_questions:
        for choice, trajectory in _of_joint(state, reach, one.joint):
            if _key(choice) not in past:
                made.append(_rated(posed, choice, trajectory))
    choice, excitation = excitation_of(state.robot, reach, state.fit.theta, collision)
    if excitation is not None and _key(choice) not in past:
        rated = [_rated(posed, choice, excitation) for _, posed in open_questions]
        made.append(max(rated, key=lambda each: each[0]) if rated else (0.0, choice, excitation))
    made.sort(key=lambda each: ((each[1].expected_gain or 0.0) < LEAST_GAIN, -each[0]))
    considered: list[MotionChoice] = []
    for _, choice, trajectory in made:
        reason = too_long(choice, left_s) or excluded(
            state.robot, trajectory, state.fit.theta, collision, state.fit.covariance
        )
        considered.append(choice.model_copy(update={"excluded": reason}))
        if reason is None:
            enough = not open_questions or (choice.expected_gain or 0.0) >= LEAST_GAIN
            rest = [other for _, other, _ in made[len(considered) : LISTED]]
            listed = (*considered, *rest)
            return Chosen(asked, listed, choice, trajectory) if enough else Chosen(asked, listed)
    return Chosen(asked, tuple(considered[:LISTED]))


def next_recording(
    state: ModelState, explanations: Sequence[Explanation], offered: Sequence[Recording], done: Sequence[MotionChoice]
) -> Chosen:
    """Return the recording of the past that tells the explanations apart most, among those not seen yet."""
    open_questions, asked = _questions(state, explanations)
    past = {one.words for one in done}
    made: list[tuple[MotionChoice, Recording]] = []
    for recording in offered:
        experiments, _ = experiments_of([recording], state.robot, name_files=True)
        duration = sum(e.dt * e.q.shape[0] for e in experiments)
        choice = MotionChoice(motion="recording", words=str(recording.path), duration_s=duration)
        if choice.words not in past:
            gains = [sum(posed.recorded_gain(e) for e in experiments) for _, posed in open_questions]
            made.append((choice.model_copy(update={"expected_gain": max(gains, default=None)}), recording))
    made.sort(key=lambda each: -(each[0].expected_gain or 0.0))
    considered = tuple(choice for choice, _ in made[:LISTED])
    return Chosen(asked, considered, made[0][0], None, made[0][1]) if made else Chosen(asked, considered)


def _questions(
    state: ModelState, explanations: Sequence[Explanation]
) -> tuple[list[tuple[Explanation, Question]], str]:
    """Return what is open at the most doubtful joints, and the question in words."""
    doubtful = uncertain(explanations)[:JOINTS]
    posed = [(one, question(state, rivals)) for one in doubtful if len(rivals := rivals_of(state, one)) > 1]
    words = "; ".join(f"{one.joint}: {_or([r.name for r in each.rivals])}?" for one, each in posed)
    return posed, words or "what do other recordings show?"


def too_long(choice: MotionChoice, left_s: float) -> str | None:
    """Return the reason if a motion takes longer than the time that is left, s."""
    if choice.duration_s <= left_s:
        return None
    return f"takes {choice.duration_s:.0f} s, and {left_s:.0f} s of motion are left; allow more with --minutes"


def excluded(
    robot: RobotConfig,
    trajectory: Trajectory,
    theta: Array | None,
    collision: CollisionModel,
    covariance: Array | None = None,
) -> str | None:
    """Return the limit that a motion violates, in words."""
    try:
        trajectory.check(robot, "motion")
    except ConfigError as error:
        return str(error)
    q, qd, qdd = sample_trajectory(trajectory, PERIOD)
    torque = std = None
    if theta is not None:
        model = arm_model(robot).anchored(theta)
        torque = predicted_torque(model, theta, q, qd, qdd, PERIOD)
        std = None if covariance is None else torque_deviation(model, covariance, q, qd, qdd, PERIOD)
    closest = collision.closest(q)
    design = Design(trajectory, np.inf, None, slow_share(robot, qd), torque, closest=closest, torque_std=std)
    found = excesses(robot, design, collision, MARGIN)
    return f"needs {'; '.join(found)}" if found else None


def _rated(posed: Question, choice: MotionChoice, trajectory: Trajectory) -> tuple[float, MotionChoice, Trajectory]:
    """Return the expected gain per second, and the motion with its expected gain."""
    gain = posed.gain(trajectory)
    return gain / (choice.duration_s + OVERHEAD_S), choice.model_copy(update={"expected_gain": gain}), trajectory


def _of_joint(state: ModelState, reach: Reach, name: str) -> Iterator[tuple[MotionChoice, Trajectory]]:
    """Yield every motion of a joint, in all sizes, and with each neighbour where two joints move."""
    joints = state.study.joints
    joint = joints.index(name)
    neighbours = [k for k in (joint - 1, joint + 1) if 0 <= k < len(joints)]
    for family in FAMILIES:
        for size in family.sizes:
            for other in neighbours if family.pairs else [None]:
                trajectory = family.trajectory(reach, joint, size, other)
                yield (
                    MotionChoice(
                        motion=family.name,
                        words=family.in_words(joints, joint, other),
                        joint=name,
                        other=None if other is None else joints[other],
                        size=size,
                        duration_s=trajectory.duration,
                    ),
                    trajectory,
                )


def excitation_of(
    robot: RobotConfig,
    reach: Reach,
    theta: Array | None,
    collision: CollisionModel,
    duration: float = EXCITATION_S,
    seed: int = 0,
) -> tuple[MotionChoice, Trajectory | None]:
    """Return an exciting trajectory within the reach; ``None`` with the reason if no trajectory keeps the limits."""
    joints = []
    # No posture further than a quarter of the time: several moves fit at the speeds of first contact.
    near = 0.25 * duration * reach.velocity
    low, high = np.maximum(reach.low, reach.home - near), np.minimum(reach.high, reach.home + near)
    for j, joint in enumerate(robot.joints):
        slower = {
            "position": (float(low[j]), float(high[j])),
            "velocity": float(reach.velocity[j]),
            "acceleration": float(reach.acceleration[j]),
        }
        joints.append(joint.model_copy(update={"limits": joint.limits.model_copy(update=slower)}))
    slow = robot.model_copy(update={"joints": tuple(joints)})
    words = "all joints at once along an exciting trajectory"
    choice = MotionChoice(motion=EXCITATION, words=words, duration_s=duration)
    try:
        design = design_trajectory(
            slow, duration, seed, evaluations=EVALUATIONS, theta=theta, collision=collision, margin=MARGIN
        )
    except ConfigError as error:
        return choice.model_copy(update={"excluded": str(error)}), None
    return choice.model_copy(update={"duration_s": design.trajectory.duration}), design.trajectory


def reach_of_recordings(state: ModelState) -> Reach:
    """Return the limits of motions by the recordings so far."""
    every = [s.measured for s in (*state.study.train, *state.study.held)]
    speeds = np.max([np.abs(s.qd).max(axis=0) for s in every], axis=0)
    # Noise of a position differentiated twice has peaks that the arm does not have.
    accelerations = np.max([np.quantile(np.abs(s.qdd), 0.99, axis=0) for s in every], axis=0)
    # The arm was seen where the first recording begins, so that it can be there.
    first = state.study.sources[0][0].q[0]
    return reach_of(state.robot, np.round(first, 4), speeds, accelerations)


def home_of(robot: RobotConfig) -> Array:
    """Return the posture (n,) at which motions begin: zero, or the nearest one within the limits."""
    bounds = np.array([joint.limits.position for joint in robot.joints])
    return np.clip(np.zeros(robot.n), bounds[:, 0], bounds[:, 1])


def _key(choice: MotionChoice) -> tuple[object, ...]:
    return choice.motion, choice.joint, choice.other, choice.size


def _or(names: Sequence[str]) -> str:
    words = [name.replace("_", " ") for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"
