"""Weight that the torques give the arm, against the masses of its URDF or the lightest arms of its reach."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Fit, Hypothesis, fit, regressors
from armident.identify.setup.limited_least_squares import RIDGE
from armident.identify.setup.plausible import LEAST_ODDS
from armident.identify.setup.prior import MISTAKE
from armident.identify.setup.result import SetupFinding
from armident.identify.setup.search import independent_rows

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

URDF_SHARE = 0.3
"""Share of gravity's torque at a joint from which the masses of a URDF contradict the recording: twice what the file of
a measured KUKA LWR4 misses at two of its joints, 13 %."""

LIGHT = 0.05
"""The same over that of the heaviest joint, of which lighter joints are taken: cables and friction decide there."""

SIGNIFICANT = 3.0
"""Standard deviations of an identified torque of gravity that it, and a contradiction, exceed."""

LEAST_FALL = 2.0
"""Least factor by which the other reading of a URDF's centres of mass reduces the error: its power falls by four."""

REMEDY = "give drive.gain, N m per unit of the signal; are the torques motor currents, or shares of a rated torque?"


def weight_findings(bench: Bench, h: Hypothesis, robot: RobotConfig) -> list[SetupFinding]:
    """Return a finding if the torques of gravity fit neither the masses of the URDF nor any arm of this reach."""
    if not any(robot.gravity):
        return []
    found = fit(bench, h, free=False)
    gravity = _gravity_regressor(bench, h)
    felt = _rms(gravity @ found.theta)
    carrying = np.flatnonzero((felt > CARRIED * felt.max()) & bench.moving)
    if not carrying.size or np.ptp(bench.recorded[0][:, carrying[0]]) < LEAST_RANGE:
        return []
    shoulder = int(carrying[0])
    names = tuple(robot.joints[j].name for j in carrying)
    if robot.first_moments:
        known = _standard(bench, robot.first_moments)
        against = _against_urdf(bench, h, robot, carrying, gravity)
        if against is not None and against.kind == "urdf_centres":
            return [against]
        expected = _rms(gravity @ known)
        heavy = carrying[expected[carrying] > HEAVY * expected[carrying].max()]
        if heavy.size:
            ratio = float(np.exp(np.median(np.log(felt[heavy] / expected[heavy]))))
            if 1.0 / MASS_FACTOR <= ratio <= MASS_FACTOR:
                return [] if against is None else [against]
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


def _standard(bench: Bench, moments: Mapping[str, float]) -> Array:
    """Return the base parameters (b,) of masses and first moments by name."""
    return np.asarray(bench.model.base.regroup @ np.array([moments.get(name, 0.0) for name in bench.model.names]))


def _against_urdf(
    bench: Bench, h: Hypothesis, robot: RobotConfig, carrying: NDArray[np.int64], gravity: Array
) -> SetupFinding | None:
    """Return the contradiction between the masses of the URDF and the torques of gravity (M, n, b), if there is one.

    Compared are the joints whose torque of gravity is known beside free springs and friction. The masses of a file err
    by an unknown share: the odds of its two readings are those of the sizes of their errors, of two moments per joint.
    A common factor of all torques is no contradiction: a heavier arm and another torque constant look the same.
    """
    found = fit(bench, h)
    theta = found.theta[: bench.rigid]
    felt, std = _rms(gravity @ theta), _std(bench, h, found, gravity)
    sizes = np.maximum(felt, LIGHT * felt[carrying].max())
    joints = carrying[SIGNIFICANT * std[carrying] < sizes[carrying]]
    if not joints.size:
        return None
    own, shares = (gravity @ theta)[:, joints], sizes[joints]
    link, base = (
        (gravity @ _standard(bench, moments))[:, joints]
        for moments in (robot.first_moments, robot.first_moments_of_base or robot.first_moments)
    )
    names = [robot.joints[j].name for j in joints]
    error = [float(np.sqrt(np.mean((_rms(own - made) ** 2 + std[joints] ** 2) / shares**2))) for made in (link, base)]
    gain = 2.0 * joints.size * float(np.log(error[0] / error[1])) - MISTAKE
    if gain > LEAST_ODDS and error[0] > LEAST_FALL * error[1]:
        message = (
            "the centres of mass of the URDF are in the frame of its base, not in those of the links: read so, the "
            f"masses miss {100 * error[1]:.0f} % of the torques of gravity, as they stand {100 * error[0]:.0f} %"
        )
        remedy = "express the inertial origins of the URDF in the frames of their links; the virtual arm takes them so"
        odds = float(np.exp(-gain))
        return SetupFinding("urdf_centres", tuple(names), 1.0 / (1.0 + odds), message, remedy, False, False)
    factor = float(np.sum(own * link / shares**2) / max(float(np.sum((link / shares) ** 2)), 1e-300))
    factor = min(max(factor, 1.0 / MASS_FACTOR), MASS_FACTOR)
    left, scaled = _rms(own - link), _rms(own - factor * link)
    most = np.maximum(URDF_SHARE * shares, SIGNIFICANT * std[joints])
    wrong = np.flatnonzero(left > most)
    if not wrong.size or np.all(scaled <= most):
        return None
    said = ", ".join(
        f"{names[k]} by {100 * left[k] / shares[k]:.0f} % ({left[k] / std[joints][k]:.0f} standard deviations)"
        for k in wrong
    )
    message = f"the masses of the URDF give other torques of gravity than the recording: {said}"
    remedy = (
        f"correct mass and centre of the links from {names[wrong[0]]} on in the URDF, or add the tool; identified "
        "parameters do not depend on them"
    )
    return SetupFinding("urdf_masses", tuple(names[k] for k in wrong), 1.0, message, remedy, False, False)


def _gravity_regressor(bench: Bench, h: Hypothesis) -> Array:
    """Torques of gravity at each instant and joint by the base parameters, (M, n, b), N m or N."""
    q = bench.rows(h.position).q
    with_it, without = (
        bench.model.with_gravity(g).rigid_regressor(q, 0.0 * q, 0.0 * q) for g in (h.gravity, 0.0 * h.gravity)
    )
    return np.asarray(with_it - without)


def _rms(torque: Array) -> Array:
    """Root mean square of torques (M, n) of each joint, (n,)."""
    return np.asarray(np.sqrt(np.mean(torque**2, axis=0)))


def _std(bench: Bench, h: Hypothesis, found: Fit, gravity: Array) -> Array:
    """Standard deviation of the identified torque of gravity of each joint, rms over the instants, (n,), N m or N."""
    residual = found.residual @ h.torque.T
    weights = np.where(bench.moving, 1.0 / np.maximum((residual**2).mean(axis=0), 1e-300), 0.0)
    x = regressors(bench, h)[:, :, : found.theta.size]
    gram = sum(w * a.T @ a for w, a in zip(weights, x, strict=True))
    gram *= float(independent_rows(residual)[bench.moving].mean()) / residual.shape[0]
    scale = np.sqrt(np.diag(gram))
    scale[scale <= 1e-12 * scale.max()] = np.inf
    covariance = np.linalg.inv(gram / np.outer(scale, scale) + RIDGE * np.eye(scale.size)) / np.outer(scale, scale)
    own = covariance[: bench.rigid, : bench.rigid]
    return np.asarray(np.sqrt(np.einsum("mjb,bc,mjc->j", gravity, own, gravity, optimize=True) / gravity.shape[0]))
