"""Mistakes that the signals alone show: standstill, joints at rest, clipped torques, a rate too slow for the motion."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.daq.recording.faults.jumps import JumpCriteria, jumps
from armident.daq.recording.faults.updates import held, resolution
from armident.identify.setup.plausible import NO_LIMIT
from armident.identify.setup.result import SetupFinding
from armident.identify.signals.bandwidth import velocity_spectra
from armident.identify.signals.experiments import Experiment

STILL_SHARE = 1e-3
"""Share of its position range below which a joint counts as not moving."""

HELD_SHARE = 0.01
"""Motion over that of the joint that moves most, in shares of ranges, below which a joint is held.

A held joint gives way to the torques of the others by less than a percent of their motion.
"""

STILL_RATIO = 0.7
"""Power of the differences over twice that of the positions above which they are noise (von Neumann 1941): 1 if white.

A sine with five samples per period has 0.69.
"""

LEAST_RUN = 5
"""Samples in a row at the extreme value that count as clipped: noise of one count keeps a value for fewer."""

RUN_RATIO = 3.0
"""Longest run at the extreme over the longest run at any other value while the joint moves."""

LEAST_VALUES = 25
"""Least number of different values of a clipped torque: rounding by half a step then moves its level by 4 % at most."""

CLIPPED_SHARE = 2e-3
"""Least share of clipped samples for a finding."""

CLIPPED_UNUSABLE = 0.05
"""Share of clipped samples from which on results are unusable."""

SHOWN = 4
"""Events that a message lists."""

TURN_PARTS = 200
"""Parts of a recording whose displacements tell the direction: a motion of 10 s at 1 Hz has ten parts each way."""

ONE_WAY_SHARE = 0.01
"""Share of a joint's travel against its main direction below which it turns one way only, as that of a held joint."""

REST_REMEDY = "record a motion of all joints: armident trajectory designs one"

CLIPPED_REMEDY = "record a gentler motion, or with a wider range of the torque signal"

POWER_SHARE = 0.95
"""Share of the velocity's power below the frequency of a motion."""

SIGNIFICANT = 10.0
"""Power over the floor of the encoder noise above which a frequency counts as motion."""

LEAST_SAMPLES = 10.0
"""Samples per period of the motion that accelerations need (Ljung 1999, System Identification, section 13.7)."""

SAMPLES_UNUSABLE = 5.0
"""Samples per period below which central differences lose a fifth of the acceleration."""

REACHES_ZERO = 0.01
"""Least torque over the largest one below which it reaches zero: the noise of usual torque signals."""

SLIP_REMEDY = "find out why the encoder lost counts (coupling, index, power), home the joint and record again"


SMALLEST_TORQUE = 0.005
"""Torque (rms) over its limit that every joint of a moving arm exceeds: a quarter of the least peak of `plausible`."""


def small_torque_findings(experiments: Sequence[Experiment], robot: RobotConfig) -> list[SetupFinding]:
    """Return a finding if the torques of all joints are far too small to move and hold an arm with these limits."""
    limits = np.array([joint.limits.torque for joint in robot.joints])
    if not (limits < NO_LIMIT).all() or not any(robot.gravity):
        return []
    rms = np.sqrt(np.mean(np.concatenate([e.tau for e in experiments]) ** 2, axis=0))
    if np.any(rms >= SMALLEST_TORQUE * limits):
        return []
    shares = ", ".join(f"{100 * share:.2g}" for share in rms / limits)
    message = (
        f"the torques are {shares} % of their limits (rms by joint), too little to carry this arm against gravity: "
        "external torques, currents, or a residual of the controller?"
    )
    names = tuple(joint.name for joint in robot.joints)
    remedy = "record the torques of the motors, or give drive.gain for currents"
    return [SetupFinding("torque_too_small", names, 1.0, message, remedy, True)]


def absolute_findings(
    experiments: Sequence[Experiment], robot: RobotConfig, moving: NDArray[np.bool_]
) -> list[SetupFinding]:
    """Return a finding if the torques of all moving joints are never negative: their sign is lost, or coded otherwise.

    Gravity may keep one joint above zero, but not all of an arm.
    """
    lowest = np.min([e.tau.min(axis=0) for e in experiments], axis=0)[moving]
    highest = np.max([e.tau.max(axis=0) for e in experiments], axis=0)[moving]
    reached = np.any(lowest <= REACHES_ZERO * highest) and np.all(highest > 0.0)
    if np.any(lowest < 0.0) or not reached or (moving.sum() == 1 and moving.size > 1):
        return []
    names = tuple(joint.name for joint in robot.joints)
    message = "the torques are never negative: absolute values, or a sign that is a bit of its own"
    remedy = "record torques with their sign: check data type and mapping of the torque"
    return [SetupFinding("torque_without_sign", names, 1.0, message, remedy, True)]


def step_findings(experiments: Sequence[Experiment], robot: RobotConfig) -> list[SetupFinding]:
    """Return the steps of a position that last: no motion makes them, and nothing tells the right position."""
    findings = []
    criteria = JumpCriteria()
    for j, joint in enumerate(robot.joints):
        unit, limits = "rad" if joint.type == "revolute" else "m", joint.limits
        found = [
            (e.start + row * e.dt, size)
            for e in experiments
            for row, size in jumps(
                e.q[:, j], e.dt, np.zeros(len(e.q) - 1, np.bool_), limits.velocity, limits.acceleration, criteria
            ).steps
        ]
        if found:
            each = ", ".join(f"{size:+.4g} {unit} at {t:.3f} s" for t, size in found[:SHOWN])
            more = f", and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
            message = f"the position of {joint.name} steps for good, faster than any motion: {each}{more}"
            findings.append(SetupFinding("position_step", (joint.name,), 1.0, message, SLIP_REMEDY, True))
    return findings


def held_findings(experiments: Sequence[Experiment], robot: RobotConfig) -> list[SetupFinding]:
    """Return the signals that change every k-th sample only, with their true rate and mean delay."""
    longest = max(experiments, key=lambda e: e.q.shape[0])
    findings = []
    for quantity, values in (("torque", longest.tau), ("position", longest.q)):
        periods: dict[int, list[str]] = {}
        for j, joint in enumerate(robot.joints):
            if found := held(values[:, j]):
                periods.setdefault(found, []).append(joint.name)
        for rows, names in periods.items():
            rate = 1.0 / longest.dt
            message = (
                f"the {quantity} of {', '.join(names)} changes every {rows} samples only ({rate / rows:.4g} Hz, "
                f"recorded at {rate:.4g} Hz): it is {500 * (rows - 1) * longest.dt:.3g} ms old on average"
            )
            remedy = f"record the {quantity} at the rate at which the drive measures it"
            findings.append(SetupFinding(f"{quantity}_held", tuple(names), 1.0, message, remedy, False))
    return findings


def moving_joints(experiments: Sequence[Experiment], robot: RobotConfig) -> NDArray[np.bool_]:
    """Return the mask (n,) of the joints that move. ``experiments``: SI, joint side."""
    usual = np.array([2 * np.pi if joint.type == "revolute" else 1.0 for joint in robot.joints])
    limits = np.array([j.limits.position[1] - j.limits.position[0] for j in robot.joints])
    whole = np.where(limits < NO_LIMIT, np.minimum(limits, usual), usual)
    share = np.max([np.ptp(e.q, axis=0) for e in experiments], axis=0) / whole
    wanted = share
    if all(e.q_ref is not None for e in experiments):
        wanted = np.max([np.ptp(e.q_ref, axis=0) for e in experiments if e.q_ref is not None], axis=0) / whole
    power = np.sum([np.var(e.q, axis=0) for e in experiments], axis=0)
    of_steps = np.sum([np.mean(np.diff(e.q, axis=0) ** 2, axis=0) for e in experiments], axis=0)
    moves = (share >= STILL_SHARE) & (wanted >= STILL_SHARE) & (share >= HELD_SHARE * min(share.max(), 1.0))
    moving: NDArray[np.bool_] = moves & (of_steps < 2 * STILL_RATIO * power)
    return moving


def rest_findings(moving: NDArray[np.bool_], robot: RobotConfig) -> list[SetupFinding]:
    """Return a finding if nothing moves, or if single joints are at rest."""
    names = tuple(joint.name for joint in robot.joints)
    if not moving.any():
        message = "no joint moves in these recordings, so that they determine no parameter"
        return [SetupFinding("standstill", names, 1.0, message, REST_REMEDY, True)]
    still = tuple(name for name, moves in zip(names, moving, strict=True) if not moves)
    if not still:
        return []
    verb = "does" if len(still) == 1 else "do"
    message = f"{', '.join(still)} {verb} not move: the recordings do not determine their inertia and friction"
    return [SetupFinding("joint_at_rest", still, 1.0, message, REST_REMEDY, False)]


def one_way_findings(
    experiments: Sequence[Experiment], robot: RobotConfig, moving: NDArray[np.bool_]
) -> list[SetupFinding]:
    """Return a finding for the moving joints that turn in one direction only."""
    # Steps that the noise of the encoder does not turn round.
    steps = np.concatenate([np.diff(e.q[:: max(1, e.q.shape[0] // TURN_PARTS)], axis=0) for e in experiments])
    up, down = np.maximum(steps, 0.0).sum(axis=0), np.maximum(-steps, 0.0).sum(axis=0)
    chosen = np.flatnonzero(moving & (np.minimum(up, down) < ONE_WAY_SHARE * (up + down)))
    if not chosen.size:
        return []
    names = tuple(robot.joints[j].name for j in chosen)
    message = (
        f"{', '.join(names)} {'turns' if chosen.size == 1 else 'turn'} in one direction only: dry friction cannot be "
        "told from an offset of the torque"
    )
    return [SetupFinding("one_direction", names, 1.0, message, "record a motion in both directions", False)]


def clipped_findings(
    experiments: Sequence[Experiment], robot: RobotConfig, moving: NDArray[np.bool_]
) -> list[SetupFinding]:
    """Return the torques that stay at an extreme value, or never change."""
    findings = []
    to_motors = np.linalg.inv(robot.transmission_matrix)
    at_motors = [e.tau @ to_motors for e in experiments]
    for j in np.flatnonzero(moving):
        name = robot.joints[j].name
        for torques in ([e.tau[:, j] for e in experiments], [tau[:, j] for tau in at_motors]):
            if max(float(np.ptp(tau)) for tau in torques) == 0.0:
                message = f"the torque of {name} never changes although the joint moves: its drive does not report it"
                remedy = "check the mapping of the torque in session and drive"
                findings.append(SetupFinding("torque_clipped", (name,), 1.0, message, remedy, True))
                break
            share, level = _clipped(torques, [e.q[:, j] for e in experiments])
            if share >= CLIPPED_SHARE and (level == 0.0 or in_fine_steps(torques)):
                unit = "N m" if robot.joints[j].type == "revolute" else "N"
                of = f"in {100 * share:.1f} % of the samples"
                message = f"the torque of {name} is clipped at {level:.4g} {unit} {of}"
                unusable, remedy = share >= CLIPPED_UNUSABLE, CLIPPED_REMEDY
                if level == 0.0:
                    message = f"the torque of {name} is 0 {of} although the joint moves"
                    remedy = "record a faster motion, or the torque in finer steps; check that it has both signs"
                findings.append(SetupFinding("torque_clipped", (name,), 1.0, message, remedy, unusable))
                break
    return findings


def in_fine_steps(torques: Sequence[Array]) -> bool:
    """Return False for torques (N,) of one joint with so few values that their peaks look clipped."""
    return np.unique(max(torques, key=len)).size >= LEAST_VALUES


def _clipped(torques: Sequence[Array], positions: Sequence[Array]) -> tuple[float, float]:
    """Share of the samples in long runs at the largest or the least torque, and that torque."""
    high, low = max(float(t.max()) for t in torques), min(float(t.min()) for t in torques)
    tolerance = 1e-9 * max(high - low, 1e-300)
    at, elsewhere, level, extreme = 0, 0, high, 0
    total = sum(t.size for t in torques)
    for tau, q in zip(torques, positions, strict=True):
        step = np.abs(np.gradient(q))
        still = np.concatenate([[0], np.cumsum(step <= 0.02 * step.max())])
        begins, ends = _runs(tau, tolerance)
        values, lengths = tau[begins], ends - begins
        outermost = (values >= high - tolerance) | (values <= low + tolerance)
        clipped = np.where(outermost & (lengths >= LEAST_RUN), lengths, 0)
        at += int(clipped.sum())
        if clipped.max(initial=0) > extreme:
            extreme, level = int(clipped.max()), float(values[np.argmax(clipped)])
        others = lengths[~outermost & (still[ends] == still[begins])]
        elsewhere = max(elsewhere, int(others.max(initial=0)))
    certain = extreme >= max(LEAST_RUN, RUN_RATIO * elsewhere)
    return (at / total if certain else 0.0), level


def _runs(x: Array, tolerance: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Runs of equal values: first samples and those after the last."""
    cuts = np.flatnonzero(np.abs(np.diff(x)) > tolerance) + 1
    begins, ends = np.concatenate([[0], cuts]), np.concatenate([cuts, [x.size]])
    long = ends - begins >= 2
    return begins[long], ends[long]


def rate_findings(experiments: Sequence[Experiment], robot: RobotConfig) -> list[SetupFinding]:
    """Return a finding if the motion has fewer than ten samples per period. ``experiments``: SI, joint side."""
    dt = experiments[0].dt
    highest = np.max([velocity_frequency(e.q, dt) for e in experiments], axis=0)
    slow = np.flatnonzero(highest * dt * LEAST_SAMPLES > 1.0)
    longest = max(experiments, key=lambda e: e.q.shape[0])
    coarse = {int(j): step for j in slow if (step := resolution(longest.q[:, j]))}
    findings = [_coarse(robot, coarse, longest.q)] if coarse else []
    slow = np.array([j for j in slow if int(j) not in coarse], dtype=np.int64)
    if not slow.size:
        return findings
    names = tuple(robot.joints[j].name for j in slow)
    most = float(highest[slow].max())
    message = (
        f"the sampling rate of {1 / dt:.4g} Hz is too slow for the motion of {', '.join(names)}: {POWER_SHARE:.0%} of "
        f"the velocity's power lies below {most:.3g} Hz, which needs {LEAST_SAMPLES * most:.3g} Hz"
    )
    unusable = most * dt * SAMPLES_UNUSABLE > 1.0
    return [
        *findings,
        SetupFinding("rate_too_slow", names, 1.0, message, "record faster, or a slower motion", unusable),
    ]


def _coarse(robot: RobotConfig, steps: dict[int, float], q: Array) -> SetupFinding:
    """Positions in steps (by joint) so coarse that their noise looks like a fast motion."""
    names = tuple(robot.joints[j].name for j in steps)
    each = [f"{step:.3g} {'rad' if robot.joints[j].type == 'revolute' else 'm'}" for j, step in steps.items()]
    fewest = min(float(np.ptp(q[:, j])) / step for j, step in steps.items())
    message = (
        f"the positions of {', '.join(names)} are recorded in steps of {', '.join(dict.fromkeys(each))}, {fewest:.0f} "
        "and more over the motion: their noise is larger than the motion from one sample to the next"
    )
    remedy = "write positions with more decimals, or in the counts of the encoder"
    return SetupFinding("position_resolution", names, 1.0, message, remedy, False)


def velocity_frequency(q: Array, dt: float) -> Array:
    """Return the frequency (n,), Hz, below which `POWER_SHARE` of each joint's velocity power lies."""
    frequency, power, position = velocity_spectra(q, dt)
    # A tenth of the spectrum is free of motion where the rate suffices; noise is white in the position.
    floor = np.quantile(position, 0.05, axis=0) / 0.0513
    cumulative = np.cumsum(np.where(position > SIGNIFICANT * floor, power, 0.0), axis=0)
    # A constant velocity is motion, too: its power lies at zero.
    cumulative += np.mean(np.diff(q, axis=0) / dt, axis=0) ** 2 / frequency[0]
    out = np.zeros(q.shape[1])
    for j in np.flatnonzero(cumulative[-1] > 0):
        out[j] = frequency[np.searchsorted(cumulative[:, j], POWER_SHARE * cumulative[-1, j])]
    return out
