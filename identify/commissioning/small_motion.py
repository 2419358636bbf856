"""Small motion of one joint, and what answered it: order, sign and unit of its position, order and sign of its torque.

No model is needed: the farthest position that was asked for lies to one side, and friction takes energy. Gravity gives
none along a closed motion.
"""

from collections.abc import Sequence

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.investigation.motions import MotionFamily, Path
from armident.identify.setup.describe import effects_line, linear_map, order_finding, sign_finding
from armident.identify.setup.result import SetupFinding
from armident.identify.setup.signals import HELD_SHARE
from armident.identify.signals.experiments import Experiment

ARRIVES = 0.8
"""Least share of the asked motion that a joint makes, and of which it makes the inverse at most: friction and a weak
controller take less, the smallest step of gears and encoders (a factor of 2 in use) more."""
UNITS = {"revolute": {"degrees": np.pi / 180.0, "turns": 2.0 * np.pi}, "prismatic": {"mm": 1e-3}}
"""Units that positions of joints are reported in by mistake, in rad or m."""
BLOCK_S = 0.05
"""Time over which signals are averaged for the work, s: noise that feeds back to the torque is faster."""
DISSIPATED = 0.05
"""Least work over the sum of its amounts that has a sign: gravity cancels as well as a motion closes, to a percent."""
OTHERS = 3.0
"""Factor by which the work of another joint's torque exceeds the own one, in shares of the limits, where torques are
exchanged: a joint at rest gives way to its own dry friction at most, which is of the size of the moving one's."""


class SmallMotion(MotionFamily):
    """One joint slowly to one side, half as far to the other one, and again twice as fast."""

    name = "small_motion"
    words = "{joint} slowly to both sides and back; the other joints rest"
    sizes = (0.1, 0.03)

    def draw(self, path: Path, joint: int, size: float, other: int) -> None:
        """Append two rounds; the far side is the one with more room."""
        home, reach = float(path.reach.home[joint]), path.reach
        span = size * float(reach.range[joint])
        if reach.high[joint] - home < home - reach.low[joint]:
            span = -span
        for speed in (0.5, 1.0):
            path.joint_to(joint, home + span, speed, 0.2)
            path.joint_to(joint, home - 0.5 * span, speed, 0.2)


def wrong_answer(robot: RobotConfig, joint: int, asked: Array, answer: Sequence[Experiment]) -> SetupFinding | None:
    """Return the mistake that a small motion (N,) of one joint shows; ``None`` if its own signals answered."""
    names = [each.name for each in robot.joints]
    q, tau = (np.concatenate([getattr(e, signal) for e in answer]) for signal in ("q", "tau"))
    wanted, made = _farthest(asked[:, None])[0], _farthest(q)
    moved = int(np.abs(made).argmax())
    if abs(made[moved]) < HELD_SHARE * abs(wanted):
        message = f"{names[joint]} was to move by {wanted:+.3g}, and no position changed by more than {made[moved]:.2g}"
        step = "release brakes, enable the drives and check the emergency stop, then continue"
        return SetupFinding("standstill", (names[joint],), 1.0, message, step, True, False)
    work, amount = _work(q[:, moved], tau, answer[0].dt)
    share = np.abs(work) / [each.limits.torque for each in robot.joints]
    worked = int(share.argmax())
    if share[worked] < OTHERS * share[joint]:
        worked = joint
    order = np.arange(robot.n)
    if moved != joint or worked != joint:
        other = moved if moved != joint else worked
        order[[joint, other]] = order[[other, joint]]
        signals = [name for name, place in (("position", moved), ("torque", worked)) if place == other]
        return order_finding(order, signals, names)[0]
    ratio = made[joint] / wanted
    if not ARRIVES < abs(ratio) < 1.0 / ARRIVES:
        return _wrong_unit(robot, joint, abs(float(ratio)))
    turned = work[joint] * np.sign(ratio) < 0.0 and abs(work[joint]) > DISSIPATED * amount[joint]
    signals = [name for name, wrong in (("position", ratio < 0.0), ("torque", turned)) if wrong]
    return sign_finding([names[joint]], signals)[0] if signals else None


def _farthest(q: Array) -> Array:
    """Displacements (n,) of positions (N, n) where they are farthest from the first one, rad or m."""
    away = q - q[0]
    return np.asarray(away[np.abs(away).argmax(axis=0), np.arange(q.shape[1])])


def _work(q: Array, tau: Array, dt: float) -> tuple[Array, Array]:
    """Work of torques (N, n) along the motion of one joint (N,), and the sum of its amounts, J, (n,) each."""
    size = max(1, round(BLOCK_S / dt))
    rows = len(q) // size
    position, torque = (x[: rows * size].reshape(rows, size, -1).mean(axis=1) for x in (q, tau))
    parts = 0.5 * (torque[1:] + torque[:-1]) * np.diff(position, axis=0)
    return parts.sum(axis=0), np.abs(parts).sum(axis=0)


def _wrong_unit(robot: RobotConfig, joint: int, ratio: float) -> SetupFinding:
    """Return the unit of the positions of all joints of a type, or the resolution of one."""
    own = robot.joints[joint]
    unit, factor = next(((u, f) for u, f in UNITS[own.type].items() if ARRIVES < ratio * f < 1.0 / ARRIVES), ("", 1.0))
    alike = [k for k, each in enumerate(robot.joints) if each.type == own.type] if unit else [joint]
    scale = np.eye(robot.n)
    scale[alike, alike] = factor if unit else 1.0 / ratio
    remedy, message = effects_line(linear_map(scale, "position", robot)), f"the positions are in {unit}"
    if not unit:
        message = f"{own.name} made {ratio:.3g} times the motion that it was asked for"
        remedy = f"joints: {own.name}: drive: counts_per_unit: {ratio:.3g} times the present one; or {remedy}"
    return SetupFinding("position_unit", tuple(robot.joints[k].name for k in alike), 1.0, message, remedy, True)
