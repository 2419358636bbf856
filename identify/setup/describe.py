"""Findings of a set-up check in words, with the lines of configuration that correct them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect
from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Hypothesis, misfit
from armident.identify.setup.moves import scaled
from armident.identify.setup.plausible import LEAST_ODDS, plausible_factor, ratios
from armident.identify.setup.prior import WIRING, Mistake
from armident.identify.setup.result import SetupFinding
from armident.identify.setup.scales import LEAST_TORQUE
from armident.identify.setup.search import EACH_OWN, RANKED_ROWS, Step

SCALES = ("position_unit", "torque_unit", "side", "gear_ratio", "torque_scale", "torque_scales", "position_scale")
"""Families that scale signals."""

KINDS = {"torque_scale": "torque_unit", "torque_scales": "torque_unit", "position_scale": "position_unit"}
"""Kind of the finding where it is not the family."""

CLOCK_WORDS = {1e-3: "ms", 1e-6: "us", 1e-9: "ns", 1e3: "ks"}


@dataclass(frozen=True, eq=False)
class Described:
    """A finding in words, the ``places`` of its mistakes in the step, and the entries of ``effects`` that correct it.

    ``values``: other fields of the configuration that correct it.
    """

    finding: SetupFinding
    places: frozenset[int]
    entries: tuple[Effect, ...] = ()
    values: dict[str, object] = field(default_factory=dict)


def described(step: Step, robot: RobotConfig, bench: Bench) -> list[Described]:
    """Return the findings of a step with `merged_scales`. ``bench``: signals, for the figures of the messages."""
    found: list[Described] = []
    for first, last in _groups(step):
        family = step.families[first]
        if family in WIRING and not step.mistakes[first].raw:
            made = _wiring(step, first, last, robot)
        elif family in WIRING:
            made = [_raw_exchange(step, first, robot)]
        elif family == "time_shift":
            made = [_late(step, robot, bench)] if "time_shift" not in step.families[last:] else []
        elif family in SCALES and not _of_a_drive(step, first, bench):
            made = [_scale(step, first, robot, bench)]
        else:
            continue
        places = frozenset(range(first, last))
        if family == "time_shift":
            places = frozenset(k for k, f in enumerate(step.families) if f == "time_shift")
        found += [Described(finding, places, tuple(entries)) for finding, entries in made]
    for family in [f for f in step.families if f.startswith("gravity")][-1:]:
        if family != "gravity_missing" or not step.h.gravity.any():
            places = frozenset(k for k, f in enumerate(step.families) if f.startswith("gravity"))
            gravity = tuple(float(round(g, 4)) for g in step.h.gravity)
            found.append(Described(_gravity(family, step, robot), places, values={"gravity": gravity}))
    if "time_unit" in step.families:
        places = frozenset(k for k, f in enumerate(step.families) if f == "time_unit")
        found.append(Described(_clock(step, robot, bench), places))
    return found


def corrected_robot(parts: Sequence[Described], robot: RobotConfig) -> RobotConfig | None:
    """Return the configuration with the corrections of findings that it can express; ``None`` without any."""
    update: dict[str, object] = {}
    for part in parts:
        update |= part.values
    entries = [entry for part in parts for entry in part.entries]
    if entries:
        update["effects"] = (*robot.effects, *entries)
    return robot.model_copy(update=update) if update else None


def merged_scales(step: Step, bench: Bench) -> Step:
    """Make one mistake of all scales of torques where every torque is in a unit of its own drive."""
    single = step.families.count("torque_scale")
    if "torque_scales" not in step.families and single < 2:
        return step
    n = bench.n
    scales = [
        k
        for k, m in enumerate(step.mistakes)
        if m.family in SCALES and np.array_equal(m.position, np.eye(n)) and _diagonal(m.torque)
    ]
    whole = np.eye(n)
    for k in scales:
        whole = step.mistakes[k].torque @ whole
    logs, common = np.log(np.abs(np.diag(whole))), plausible_factor(bench, step.h)
    if common == 1.0 and np.max(np.abs(logs - np.median(logs))) < np.log(LEAST_TORQUE):
        return step
    merged = Mistake("torque_scales", EACH_OWN, np.eye(n), whole * common, np.zeros(n))
    kept = [merged if k == scales[-1] else m for k, m in enumerate(step.mistakes) if k not in scales[:-1]]
    return replace(step, mistakes=tuple(kept))


def _groups(step: Step) -> Iterator[tuple[int, int]]:
    """First mistake and the one after the last of each group: consecutive mistakes of the wiring make one."""
    first = 0
    while first < len(step.families):
        last = first + 1
        while last < len(step.families) and _mergeable(step, first) and _mergeable(step, last):
            last += 1
        yield first, last
        first = last


def _of_a_drive(step: Step, k: int, bench: Bench) -> bool:
    """True for torque constants that differ moderately: effects of the drives (`drive_gain_error`).

    Of a unit of every drive, those count that the motion determines.
    """
    logs = np.log(np.abs(np.diag(step.mistakes[k].torque)))
    if step.families[k] == "torque_scale":
        return bool(np.all(np.abs(logs) < np.log(LEAST_TORQUE)))
    if step.families[k] != "torque_scales" or plausible_factor(bench, step.start) != 1.0:
        return False
    logs = logs[_determined(step.h, bench)]
    return bool(np.ptp(logs) < np.log(LEAST_TORQUE)) if logs.size else True


def _mergeable(step: Step, k: int) -> bool:
    return step.families[k] in WIRING and not step.mistakes[k].raw


def _wiring(step: Step, first: int, last: int, robot: RobotConfig) -> list[tuple[SetupFinding, list[Effect]]]:
    """Signs and orders of some mistakes together, in as few words as possible."""
    n, names = robot.n, [joint.name for joint in robot.joints]
    position, torque = np.eye(n), np.eye(n)
    for m in step.mistakes[first:last]:
        position, torque = m.position @ position, m.torque @ torque
    orders = [np.abs(m).argmax(axis=1) for m in (position, torque)]
    turned = [np.sign(m[np.arange(n), order]) < 0 for m, order in zip((position, torque), orders, strict=True)]
    if np.array_equal(orders[0], orders[1]):
        groups: list[tuple[NDArray[np.int64], tuple[str, ...]]] = [(orders[0], ("position", "torque"))]
    else:
        groups = [(orders[0], ("position",)), (orders[1], ("torque",))]
    found = [
        order_finding(order, signals, names) for order, signals in groups if not np.array_equal(order, np.arange(n))
    ]
    for mask, signals in (
        (turned[0] & turned[1], ("position", "torque")),
        (turned[0] & ~turned[1], ("position",)),
        (~turned[0] & turned[1], ("torque",)),
    ):
        if mask.any():
            found.append(sign_finding([names[j] for j in np.flatnonzero(mask)], signals))
    return found


def order_finding(
    order: NDArray[np.int64], signals: Sequence[str], names: Sequence[str]
) -> tuple[SetupFinding, list[Effect]]:
    """Recorded column ``order[j]`` belongs to joint j."""
    moved = [j for j in range(len(names)) if order[j] != j]
    entries = [_entry("joint_order", names[a], signals, names[b]) for a, b in transpositions(order)]
    plural = " and ".join(f"{signal}s" for signal in signals)
    if len(moved) == 2:
        message = f"the {plural} of {names[moved[0]]} and {names[moved[1]]} are exchanged"
    else:
        columns = [names[int(np.flatnonzero(order == k)[0])] for k in range(len(names))]
        message = f"the {plural} are recorded in the order {', '.join(columns)}"
    joints = tuple(names[j] for j in moved)
    return SetupFinding("joint_order", joints, 1.0, message, effects_line(entries), True), entries


def transpositions(order: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return exchanges that, one after the other, bring recorded column ``order[j]`` to joint j."""
    current = list(range(len(order)))
    pairs = []
    for j, wanted in enumerate(order):
        if current[j] != wanted:
            k = current.index(int(wanted))
            current[j], current[k] = current[k], current[j]
            pairs.append((j, k))
    return pairs


def _raw_exchange(step: Step, k: int, robot: RobotConfig) -> tuple[SetupFinding, list[Effect]]:
    position, torque = step.mistakes[k].position, step.mistakes[k].torque
    ratios = robot.transmission_matrix
    at_motors = {
        "position": ratios @ position @ np.linalg.inv(ratios),
        "torque": np.linalg.inv(ratios.T) @ torque @ ratios.T,
    }
    signals = [name for name, m in at_motors.items() if not np.allclose(m, np.eye(robot.n))]
    pair = np.flatnonzero(np.abs(np.diag(at_motors[signals[0]])) < 1e-9)
    names = [robot.joints[j].name for j in pair]
    entry = Effect(effect="joint_order", joint=names[0], other=names[1], parameters={s: 1.0 for s in signals})
    message = f"{step.mistakes[k].words}: swapped node numbers or plugs of two drives"
    return SetupFinding("joint_order", tuple(names), 1.0, message, effects_line([entry]), True), [entry]


def sign_finding(joints: Sequence[str], signals: Sequence[str]) -> tuple[SetupFinding, list[Effect]]:
    """Signals (``position``, ``torque``) of some joints have the wrong sign."""
    entries = [_entry("sign_error", name, signals) for name in joints]
    verb = "have" if len(joints) > 1 or len(signals) > 1 else "has"
    message = f"{' and '.join(signals)} of {', '.join(joints)} {verb} the wrong sign"
    if len(signals) == 2:
        message += ": the joint turns opposite to its configured direction"
    kind = "torque_sign" if tuple(signals) == ("torque",) else "position_sign"
    return SetupFinding(kind, tuple(joints), 1.0, message, effects_line(entries), True), entries


def _scale(step: Step, k: int, robot: RobotConfig, bench: Bench) -> tuple[SetupFinding, list[Effect]]:
    """A unit, a side or a gear ratio."""
    family, position, torque = step.families[k], step.mistakes[k].position, step.mistakes[k].torque
    changed = sum(np.abs(m - np.eye(robot.n)).max(axis=1) for m in (position, torque)) > 1e-12
    joints = [int(j) for j in np.flatnonzero(changed)]
    names = tuple(robot.joints[j].name for j in joints)
    entries = [*linear_map(position, "position", robot), *linear_map(torque, "torque", robot)]
    remedy, message = effects_line(entries), step.mistakes[k].words
    j = joints[0]
    if family == "gear_ratio":
        configured, true = robot.transmission_matrix[j, j], robot.transmission_matrix[j, j] / position[j, j]
        message = f"the gear ratio of {names[0]} is {true:.4g} by its motion and torque, not {configured:.4g}"
        remedy = f"transmission: row of {names[0]}: {true:.4g} in place of {configured:.4g}; or {remedy}"
    elif family == "torque_scale":
        message = f"the torque of {names[0]} is {torque[j, j]:.3g} times the recorded one by those of the other joints"
        remedy = f"joints: {names[0]}: drive: gain: {torque[j, j]:.3g} times the present one; or {remedy}"
    elif family == "position_scale":
        message = f"the position of {names[0]} is {position[j, j]:.3g} times the recorded one by the arm's geometry"
        resolution = f"counts_per_unit: {1 / position[j, j]:.3g} times the present one"
        remedy = f"joints: {names[0]}: drive: {resolution}; or {remedy}"
    elif family == "torque_scales":
        told = _determined(step.h, bench)
        joints = told if len(told) > 1 else joints
        names = tuple(robot.joints[i].name for i in joints)
        factors = ", ".join(f"{robot.joints[i].name} {torque[i, i] / torque[joints[0], joints[0]]:.2g}" for i in joints)
        message += f" (per mille, or currents): by the links that they share, true over recorded is about as {factors}"
        others = [robot.joints[i].name for i in np.flatnonzero(bench.moving) if i not in joints]
        message += "; the motion does not determine the common factor"
        message += f", nor that of {', '.join(others)}" if others else ""
        remedy = "joints: drive: gain or rated of each drive by its data sheet"
    elif len(joints) > 1:
        position, _, load = ratios(bench, as_configured(robot))
        message += f": the largest positions are on average {position:.3g} of their limits, "
        message += f"the largest torques {load:.3g}"
        if family == "side":
            remedy = f"armident import FILE --motor-side where positions and torques are the motors'; or {remedy}"
    return SetupFinding(KINDS.get(family, family), names, 1.0, message, remedy, True), entries


def _determined(h: Hypothesis, bench: Bench) -> list[int]:
    """Joints whose torque has a scale that the links shared with other joints determine by a factor of two."""
    n, best = bench.n, misfit(bench, h).value

    def rise(j: int, factor: float) -> float:
        return misfit(bench, replace(h, torque=scaled(n, j, factor) @ h.torque)).value - best

    least = 2.0 * LEAST_ODDS / RANKED_ROWS
    moving = [int(j) for j in np.flatnonzero(bench.moving)]
    return [j for j in moving if min(rise(j, 0.5), rise(j, 2.0)) > least]


def linear_map(matrix: Array, signal: str, robot: RobotConfig) -> list[Effect]:
    """Entries of `signal_scale` for a matrix (n, n): factors of an upper, a diagonal and a lower triangular matrix."""
    n, names = robot.n, [joint.name for joint in robot.joints]
    _, lower, upper = linalg.lu(matrix) if not _diagonal(matrix) else (None, np.eye(n), matrix)
    pivots = np.diag(upper)
    upper = upper / pivots[:, None]

    def entry(i: int, k: int, factor: float) -> Effect:
        other = None if k == i else names[k]
        return Effect(effect="signal_scale", joint=names[i], other=other, parameters={signal: _rounded(factor)})

    made = [entry(i, k, upper[i, k]) for i in range(n) for k in range(i + 1, n) if abs(upper[i, k]) > 1e-12]
    made += [entry(i, i, pivots[i]) for i in range(n) if abs(pivots[i] - 1.0) > 1e-12]
    made += [entry(i, k, lower[i, k]) for i in reversed(range(n)) for k in range(i) if abs(lower[i, k]) > 1e-12]
    return made


def _diagonal(matrix: Array) -> bool:
    return bool(np.allclose(matrix, np.diag(np.diag(matrix))))


def _late(step: Step, robot: RobotConfig, bench: Bench) -> tuple[SetupFinding, list[Effect]]:
    # One drive may be late by a time of its own.
    shift = float(np.median(step.h.shift[bench.moving]))
    delay = float(f"{shift:.3g}")
    names = tuple(joint.name for joint in robot.joints)
    entries = [Effect(effect="time_delay", joint=name, parameters={"delay": delay}) for name in names]
    direction = "late" if shift > 0 else "early"
    message = f"all torques are {1000 * abs(shift):.3g} ms {direction} against the positions"
    if np.isfinite(step.shift_std):
        message += f" (standard deviation {1000 * step.shift_std:.2g} ms)"
    share = math.erf(abs(shift) / step.shift_std / math.sqrt(2.0)) if step.shift_measured else 1.0
    return SetupFinding("time_shift", names, share, message, effects_line(entries), step.shift_decisive), entries


def _gravity(family: str, step: Step, robot: RobotConfig) -> SetupFinding:
    names = tuple(joint.name for joint in robot.joints)
    if family == "gravity_missing":
        message = "the torques contain no gravity: the controller has subtracted its model of it"
        return SetupFinding(family, names, 1.0, message, "gravity: [0.0, 0.0, 0.0]", True)
    own, found = np.array(robot.gravity), step.h.gravity
    vector = ", ".join(f"{g:.3f}" for g in found)
    if not own.any():
        message = f"gravity acts along [{vector}] m/s^2, and the configuration has none"
    else:
        cosine = float(own @ found / np.linalg.norm(own) / np.linalg.norm(found))
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        message = f"gravity acts along [{vector}] m/s^2, {angle:.1f} degrees from the configured direction"
    return SetupFinding(family, names, 1.0, message, f"gravity: [{vector}]", True)


def _clock(step: Step, robot: RobotConfig, bench: Bench) -> SetupFinding:
    names = tuple(joint.name for joint in robot.joints)
    unit = CLOCK_WORDS.get(step.h.clock, f"{step.h.clock:g} s")
    rate = 1.0 / (bench.period * step.h.clock)
    message = (
        f"the time column is in {unit}, not in s: at {1 / bench.period:.4g} Hz the largest velocities are on average "
        f"{100 * ratios(bench, as_configured(robot))[1]:.2g} % of their limits"
    )
    return SetupFinding("time_unit", names, 1.0, message, f"armident import FILE --rate {rate:.6g}", True)


def as_configured(robot: RobotConfig) -> Hypothesis:
    """The hypothesis that nothing is wrong."""
    return Hypothesis(np.eye(robot.n), np.eye(robot.n), np.array(robot.gravity), np.zeros(robot.n))


def _entry(effect: str, joint: str, signals: Sequence[str], other: str | None = None) -> Effect:
    return Effect(effect=effect, joint=joint, other=other, parameters={s: 1.0 for s in signals} | {"joint_side": 1.0})


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def effects_line(entries: Sequence[Effect]) -> str:
    """Entries of a configuration's ``effects`` in flow style, on one line."""
    each = []
    for e in entries:
        other = "" if e.other is None else f", other: {e.other}"
        values = ", ".join(f"{name}: {value:.6g}" for name, value in e.parameters.items())
        each.append(f"{{effect: {e.effect}, joint: {e.joint}{other}, parameters: {{{values}}}}}")
    return f"effects: [{', '.join(each)}]"
