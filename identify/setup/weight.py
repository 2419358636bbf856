"""Weight that the torques give the arm, against the masses of its URDF or the lightest arms of its reach."""

import numpy as np
from numpy.typing import NDArray

from armident.configs import RobotConfig
from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Hypothesis, fit
from armident.identify.setup.result import SetupFinding

Array = NDArray[np.float64]

LIGHTEST = 1.4
"""First moment of the stretched arm about its shoulder over the cube of its reach, kg/m^2, that arms exceed.

A lightest one, of 4.4 kg over 0.98 m (Kinova Jaco 2), has 1.5 with its mass at a third of its reach. The reach is
counted to the last joint only, which is to the advantage of every arm.
"""

MASS_FACTOR = 3.0
"""Factor between the weight and the masses of a URDF beyond which they contradict each other.

A tool as heavy as the arm itself doubles the torque at the shoulder; torque constants of servo drives lie farther off.
"""

HEAVY = 0.2
"""Gravity's torque (rms) over that of the heaviest joint from which a joint is compared: tools change the wrist."""

LEAST_RANGE = 0.5
"""Motion of the shoulder, rad, that tells its gravity from dry friction: gravity then changes by a tenth or more."""

CARRIED = 1e-3
"""Gravity's torque over that of the heaviest joint below which the axis of a joint is vertical."""

REMEDY = "give drive.gain, N m per unit of the signal; are the torques motor currents, or shares of a rated torque?"


def weight_findings(bench: Bench, h: Hypothesis, robot: RobotConfig) -> list[SetupFinding]:
    """Return a finding if the torques of gravity fit neither the masses of the URDF nor any arm of this reach."""
    if not any(robot.gravity):
        return []
    found = fit(bench, h, free=False)
    felt = _of_gravity(bench, h, found.theta)
    carrying = np.flatnonzero((felt > CARRIED * felt.max()) & bench.moving)
    if not carrying.size or np.ptp(bench.recorded[0][:, carrying[0]]) < LEAST_RANGE:
        return []
    shoulder = int(carrying[0])
    names = tuple(robot.joints[j].name for j in carrying)
    if robot.first_moments:
        standard = np.array([robot.first_moments.get(name, 0.0) for name in bench.model.names])
        expected = _of_gravity(bench, h, bench.model.base.regroup @ standard)
        heavy = carrying[expected[carrying] > HEAVY * expected[carrying].max()]
        if heavy.size:
            ratio = float(np.exp(np.median(np.log(felt[heavy] / expected[heavy]))))
            if 1.0 / MASS_FACTOR <= ratio <= MASS_FACTOR:
                return []
            message = f"the torques of gravity are {ratio:.2g} times those that the masses of the URDF need"
            return [SetupFinding("unusual_weight", names, 1.0, message, f"{REMEDY} Or correct the masses", False)]
    if any(joint.type != "revolute" for joint in robot.joints[shoulder:]):
        return []
    reach = sum(float(np.hypot(joint.mdh.d, joint.mdh.r)) for joint in robot.joints[shoulder + 1 :])
    places = bench.columns.named
    pairs = ([places[name] for name in (f"mx{j}", f"my{j}") if name in places] for j in carrying + 1)
    moment = sum(float(np.linalg.norm(found.theta[pair])) for pair in pairs)
    if moment >= LIGHTEST * reach**3:
        return []
    message = (
        f"the torques give the arm a first moment of {moment:.2g} kg m about {robot.joints[shoulder].name}; arms of "
        f"its reach of {reach:.2f} m have {LIGHTEST * reach**3:.2g} kg m and more"
    )
    return [SetupFinding("unusual_weight", names, 1.0, message, REMEDY, False)]


def _of_gravity(bench: Bench, h: Hypothesis, base: Array) -> Array:
    """Torque of gravity at each joint, rms, (n,), N m or N, with values of the base parameters (b,)."""
    q = bench.rows(h.position).q
    with_it, without = (
        bench.model.with_gravity(g).rigid_regressor(q, 0.0 * q, 0.0 * q) @ base for g in (h.gravity, 0.0 * h.gravity)
    )
    return np.asarray(np.sqrt(np.mean((with_it - without) ** 2, axis=0)))
