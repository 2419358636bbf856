"""Findings of a set-up check in words, with the lines of configuration that correct them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect
from armident.identify.setup.result import SetupFinding
from armident.identify.setup.search import Step

Array = NDArray[np.float64]

WIRING = ("position_sign", "torque_sign", "exchange", "assignment", "order")
"""Families that only permute signals or change their signs."""

RECORDED_AGAIN = "armident import FILE --motor-side"

CLOCK_WORDS = {1e-3: "ms", 1e-6: "us", 1e-9: "ns", 1e3: "ks"}


@dataclass(frozen=True)
class Described:
    """Findings of a search, and what a configuration can express of their corrections.

    Parameters
    ----------
    findings
        The findings.
    robot
        Configuration with the corrections; ``None`` if there are none that it can express.
    """

    findings: tuple[SetupFinding, ...]
    robot: RobotConfig | None


def described(step: Step, robot: RobotConfig) -> Described:
    """Return the findings of a search.

    Parameters
    ----------
    step
        Its result.
    robot
        The configuration.
    """
    findings: list[SetupFinding] = []
    entries: list[Effect] = []
    update: dict[str, object] = {}
    for finding, made in (*_wiring(step, robot), *_scales(step, robot), *_late(step, robot)):
        findings.append(finding)
        entries += made
    share = dict(zip(step.families, step.probability, strict=True))
    for family in ("gravity_missing", "gravity_direction"):
        if family in step.families:
            findings.append(_gravity(family, step, robot, share[family]))
            update["gravity"] = tuple(float(round(g, 4)) for g in step.h.gravity)
    if "time_unit" in step.families:
        findings.append(_clock(step, robot, share["time_unit"]))
    if entries:
        update["effects"] = (*robot.effects, *entries)
    return Described(tuple(findings), robot.model_copy(update=update) if update else None)


def _wiring(step: Step, robot: RobotConfig) -> Iterator[tuple[SetupFinding, list[Effect]]]:
    """Signs and orders: of all such mistakes together, in as few words as possible."""
    n, names = robot.n, [joint.name for joint in robot.joints]
    position, torque, share = np.eye(n), np.eye(n), 1.0
    for family, (of_position, of_torque, raw), p, words in zip(
        step.families, step.made, step.probability, step.words, strict=True
    ):
        if family not in WIRING:
            continue
        if raw:
            yield _raw_exchange(of_position, of_torque, p, words, robot)
            continue
        share = min(share, p)
        position, torque = of_position @ position, of_torque @ torque
    orders = [np.abs(m).argmax(axis=1) for m in (position, torque)]
    signs = [np.sign(m[np.arange(n), order]) for m, order in zip((position, torque), orders, strict=True)]
    if np.array_equal(orders[0], orders[1]):
        groups = [(orders[0], ("position", "torque"))]
    else:
        groups = [(orders[0], ("position",)), (orders[1], ("torque",))]
    for order, signals in groups:
        if not np.array_equal(order, np.arange(n)):
            yield _order(order, signals, share, names)
    turned = [signs[0] < 0, signs[1] < 0]
    for mask, signals in (
        (turned[0] & turned[1], ("position", "torque")),
        (turned[0] & ~turned[1], ("position",)),
        (~turned[0] & turned[1], ("torque",)),
    ):
        if mask.any():
            yield _sign([names[j] for j in np.flatnonzero(mask)], signals, share, step)


def _order(
    order: NDArray[np.int64], signals: Sequence[str], share: float, names: Sequence[str]
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
    return SetupFinding("joint_order", joints, share, message, _lines(entries), True), entries


def transpositions(order: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return exchanges that, one after the other, bring recorded column ``order[j]`` to joint j.

    Parameters
    ----------
    order
        Recorded column of each joint, (n,).
    """
    current = list(range(len(order)))
    pairs = []
    for j, wanted in enumerate(order):
        if current[j] != wanted:
            k = current.index(int(wanted))
            current[j], current[k] = current[k], current[j]
            pairs.append((j, k))
    return pairs


def _raw_exchange(
    position: Array, torque: Array, share: float, words: str, robot: RobotConfig
) -> tuple[SetupFinding, list[Effect]]:
    ratios = robot.transmission_matrix
    at_motors = {"position": ratios @ position @ np.linalg.inv(ratios)}
    at_motors["torque"] = np.linalg.inv(ratios.T) @ torque @ ratios.T
    signals = [name for name, m in at_motors.items() if not np.allclose(m, np.eye(robot.n))]
    pair = np.flatnonzero(np.abs(np.diag(at_motors[signals[0]])) < 1e-9)
    names = [robot.joints[j].name for j in pair]
    stanza = Effect(effect="joint_order", joint=names[0], other=names[1], parameters={s: 1.0 for s in signals})
    message = f"{words}: swapped node numbers or plugs of two drives"
    return SetupFinding("joint_order", tuple(names), share, message, _lines([stanza]), True), [stanza]


def _sign(
    joints: Sequence[str], signals: Sequence[str], share: float, step: Step
) -> tuple[SetupFinding, list[Effect]]:
    entries = [_entry("sign_error", name, signals) for name in joints]
    verb = "have" if len(joints) > 1 or len(signals) > 1 else "has"
    message = f"{' and '.join(signals)} of {', '.join(joints)} {verb} the wrong sign"
    if len(signals) == 2:
        message += ": the joint turns opposite to its configured direction"
    kind = "torque_sign" if tuple(signals) == ("torque",) else "position_sign"
    return SetupFinding(kind, tuple(joints), share, message, _lines(entries), True), entries


def _scales(step: Step, robot: RobotConfig) -> Iterator[tuple[SetupFinding, list[Effect]]]:
    """Units, sides and gear ratios, one finding each."""
    for family, (position, torque, _), share, words in zip(
        step.families, step.made, step.probability, step.words, strict=True
    ):
        if family in ("position_unit", "torque_unit", "side", "gear_ratio", "torque_scale", "position_scale"):
            yield _scale(family, position, torque, share, words, robot)


def _scale(
    family: str, position: Array, torque: Array, share: float, words: str, robot: RobotConfig
) -> tuple[SetupFinding, list[Effect]]:
    eye = np.eye(robot.n)
    diagonal = all(np.allclose(m, np.diag(np.diag(m))) for m in (position, torque))
    changed = np.abs(position - eye).max(axis=1) + np.abs(torque - eye).max(axis=1) > 1e-12
    joints = [j for j in range(robot.n) if changed[j]]
    names = tuple(robot.joints[j].name for j in joints)
    entries = []
    for j in joints if diagonal else []:
        values = {"position": float(position[j, j]), "torque": float(torque[j, j])}
        given = {signal: _rounded(v) for signal, v in values.items() if abs(v - 1.0) > 1e-12}
        entries.append(Effect(effect="signal_scale", joint=robot.joints[j].name, parameters=given))
    kind = {"torque_scale": "torque_unit", "position_scale": "position_unit"}.get(family, family)
    remedy = _lines(entries) if entries else RECORDED_AGAIN
    message = words
    if family == "gear_ratio":
        j = joints[0]
        configured = robot.transmission_matrix[j, j]
        true = configured / position[j, j]
        message = f"the gear ratio of {names[0]} is {true:.4g} by its motion, not {configured:.4g} as configured"
        remedy = f"transmission: row of {names[0]}: {true:.4g} in place of {configured:.4g}; or {remedy}"
    elif family == "torque_scale":
        factor = torque[joints[0], joints[0]]
        message = f"the torque of {names[0]} is {factor:.3g} times the recorded one, by the torques of the other joints"
        remedy = f"joints: {names[0]}: drive: gain: {factor:.3g} times the present one; or {remedy}"
    elif family == "position_scale":
        factor = position[joints[0], joints[0]]
        message = f"the position of {names[0]} is {factor:.3g} times the recorded one, by the geometry of the arm"
        remedy = f"joints: {names[0]}: drive: counts_per_unit: {1 / factor:.3g} times the present one; or {remedy}"
    return SetupFinding(kind, names, share, message, remedy, True), entries


def _late(step: Step, robot: RobotConfig) -> Iterator[tuple[SetupFinding, list[Effect]]]:
    if "time_shift" not in step.families:
        return
    share = step.probability[step.families.index("time_shift")]
    shift = float(step.h.shift[np.argmax(np.abs(step.h.shift))])
    delay = float(f"{shift:.3g}")
    names = tuple(joint.name for joint in robot.joints)
    entries = [Effect(effect="time_delay", joint=name, parameters={"delay": delay}) for name in names]
    direction = "late" if shift > 0 else "early"
    message = f"all torques are {1000 * abs(shift):.3g} ms {direction} against the positions"
    yield SetupFinding("time_shift", names, share, message, _lines(entries), True), entries


def _gravity(family: str, step: Step, robot: RobotConfig, share: float) -> SetupFinding:
    names = tuple(joint.name for joint in robot.joints)
    if family == "gravity_missing":
        message = "the torques contain no gravity: the controller has subtracted its model of it"
        return SetupFinding(family, names, share, message, "gravity: [0.0, 0.0, 0.0]", True)
    own, found = np.array(robot.gravity), step.h.gravity
    vector = ", ".join(f"{g:.3f}" for g in found)
    if not own.any():
        message = f"gravity acts along [{vector}] m/s^2, and the configuration has none"
    else:
        cosine = float(own @ found / np.linalg.norm(own) / np.linalg.norm(found))
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        message = f"gravity acts along [{vector}] m/s^2, {angle:.1f} degrees from the configured direction"
    return SetupFinding(family, names, share, message, f"gravity: [{vector}]", True)


def _clock(step: Step, robot: RobotConfig, share: float) -> SetupFinding:
    names = tuple(joint.name for joint in robot.joints)
    unit = CLOCK_WORDS.get(step.h.clock, f"{step.h.clock:g} s")
    message = f"the time column is in {unit}, not in s: velocities and accelerations are far from the configured limits"
    return SetupFinding("time_unit", names, share, message, "armident import FILE --rate RATE, with the rate in Hz", True)


def _entry(effect: str, joint: str, signals: Sequence[str], other: str | None = None) -> Effect:
    return Effect(effect=effect, joint=joint, other=other, parameters={s: 1.0 for s in signals} | {"joint_side": 1.0})


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _lines(entries: Sequence[Effect]) -> str:
    """Entries of a configuration's ``effects`` in flow style, on one line."""
    each = []
    for e in entries:
        other = "" if e.other is None else f", other: {e.other}"
        values = ", ".join(f"{name}: {value:.6g}" for name, value in e.parameters.items())
        each.append(f"{{effect: {e.effect}, joint: {e.joint}{other}, parameters: {{{values}}}}}")
    return f"effects: [{', '.join(each)}]"
