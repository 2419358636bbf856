"""Friction over speed, ripple and presliding of one joint as a document."""

from collections.abc import Sequence

import numpy as np

from armident.configs import ConfigError, RobotConfig
from armident.daq.recording import Recording
from armident.identify.characterisation.friction import DRAWN, Curve, Levels, friction_curve, measured_levels
from armident.identify.characterisation.motion import Plateau, alone, plateaus
from armident.identify.characterisation.reversals import reversals
from armident.identify.characterisation.ripple import Spectrum, ripples
from armident.identify.documents.base import reference, versions
from armident.identify.documents.characterisation import (
    NORMAL_95,
    CharacterisationDocument,
    Estimate,
    Friction,
    FrictionPoint,
    Presliding,
    Ripple,
    RippleOrder,
)
from armident.identify.effects.terms import arm_model
from armident.identify.identification.from_recording import experiments_of

NO_PLATEAU = (
    "not determined: {joint} never moves alone at a constant speed; record its motion `constant_speeds`, "
    "which --robot-command plays"
)
NO_REVERSAL = (
    "not determined: {joint} never reverses while the other joints rest; record its motion `reversals`, "
    "which --robot-command plays"
)
PLAY = (
    "not determined: an encoder at the motor does not see the play of the load; `armident diagnose` looks for its "
    "torque pulses as `backlash`"
)


def characterised(recordings: Sequence[Recording], robot: RobotConfig, joint: str) -> CharacterisationDocument:
    """Return friction, ripple and presliding of a joint by recordings. Raises ConfigError for an unknown joint."""
    number = joint_number(robot, joint)
    experiments, _ = experiments_of(recordings, robot, name_files=True)
    revolute = robot.joints[number].type == "revolute"
    torque, position = ("N m", "rad") if revolute else ("N", "m")
    motions = alone(experiments, robot, number)
    groups = plateaus(motions)
    friction = ripple = presliding = None
    orders: list[float] = []
    statements = dict.fromkeys(("friction", "ripple"), NO_PLATEAU.format(joint=joint))
    if groups:
        levels = measured_levels([plateau for group in groups for plateau in group])
        found = ripples(levels)
        ripple = _ripple(found, 2.0 * np.pi if revolute else 1.0, robot, number, torque)
        if found is not None:
            levels, orders = found.levels, [order for order, _, _ in found.peaks]
        friction = _friction(groups, levels, friction_curve(levels, robot, number), torque, position)
        statements["friction"] = _friction_words(friction)
        statements["ripple"] = _ripple_words(ripple, torque, "revolution" if revolute else "metre")
    statements["stiffness"] = NO_REVERSAL.format(joint=joint)
    turned = reversals(motions, float(arm_model(robot).smoothing[number]), orders)
    if turned is not None:
        unit = f"{torque}/{position}"
        half = NORMAL_95 * turned.std
        ends = (float(np.exp(turned.log_stiffness + k * half)) for k in (0.0, -1.0, 1.0)) if turned.seen else ()
        stiffness = (
            Estimate(**dict(zip(("value", "low", "high"), ends, strict=True)), unit=unit) if turned.seen else None
        )
        travel, measured, model = (column.tolist() for column in turned.drawn.T)
        presliding = Presliding(
            stiffness=stiffness, friction=turned.friction, travel=travel, measured=measured, model=model
        )
        statements["stiffness"] = (
            f"{_in_words(stiffness)}: of resting friction, as the encoder of the motor sees it, not of the transmission"
            if stiffness is not None
            else "dry friction reverses with the sign of the velocity; no elastic travel is seen"
        )
    return CharacterisationDocument(
        robot=robot.name,
        joint=joint,
        torque_unit=torque,
        position_unit=position,
        recordings=[reference(recording) for recording in recordings],
        friction=friction,
        ripple=ripple,
        presliding=presliding,
        statements={**statements, "play": PLAY},
        versions=versions(),
    )


def joint_number(robot: RobotConfig, joint: str) -> int:
    """Return the index of a joint. Raises ConfigError if there is none of this name."""
    names = [each.name for each in robot.joints]
    if joint not in names:
        raise ConfigError(f"--joint {joint}: {robot.name} has no such joint; it has {', '.join(names)}")
    return names.index(joint)


def _estimate(value: float, variance: float, unit: str) -> Estimate:
    half = NORMAL_95 * float(np.sqrt(max(variance, 0.0)))
    return Estimate(value=float(value), low=float(value - half), high=float(value + half), unit=unit)


def _friction(
    groups: Sequence[tuple[Plateau, ...]], levels: Levels, curve: Curve | None, torque: str, position: str
) -> Friction:
    """Return friction at each speed: half differences of pairs, and with a curve the friction in each direction."""
    size = len(levels.plateaus)
    # Levels scatter about the curve by what the noise within a plateau does not show (Birge 1932).
    scatter = 1.0 if curve is None else curve.misfit**2
    values, covariance = levels.fit.theta[:size], scatter * levels.fit.covariance[:size, :size]
    side = np.sign([p.speed for p in levels.plateaus])
    against, spread = side * values, np.empty(0)
    if curve is not None:
        shift = np.eye(size) - curve.offset
        against = side * (shift @ values)
        spread = np.diag(shift @ covariance @ shift.T)
    points, first = [], 0
    for group in groups:
        own = range(first, first + len(group))
        first += len(group)
        half = np.zeros(size)
        half[list(own)] = 0.5 * side[list(own)]
        directions = {
            "forward" if side[k] > 0.0 else "backward": _estimate(float(against[k]), float(spread[k]), torque)
            for k in (own if spread.size else ())
        }
        points.append(
            FrictionPoint(
                speed=abs(group[0].speed),
                friction=_estimate(float(half @ values), float(half @ covariance @ half), torque)
                if len(group) == 2
                else None,
                **directions,
            )
        )
    if curve is None:
        return Friction(points=points)
    viscous = f"{torque} s/{position}"
    units = {"fv": viscous, "fva": viscous, "velocity": f"{position}/s"}
    parameters = {
        name: _estimate(curve.theta[k], curve.covariance[k, k], units.get(name, torque))
        for k, name in enumerate(curve.names)
    }
    speeds = np.geomspace(points[0].speed, points[-1].speed, DRAWN)
    forward, backward = (sign * curve.at(sign * speeds) for sign in (1.0, -1.0))
    return Friction(
        points=points, curve=parameters, speeds=speeds.tolist(), forward=forward.tolist(), backward=backward.tolist()
    )


def _friction_words(friction: Friction) -> str:
    low, high = friction.points[0].speed, friction.points[-1].speed
    text = f"{len(friction.points)} constant speeds from {low:.3g} to {high:.3g}"
    if not friction.curve:
        return f"{text}; a curve needs two different ones in each direction"
    stribeck = "" if "fst" in friction.curve else "; no Stribeck friction is seen"
    return f"{text}; {', '.join(f'{name} {_in_words(e)}' for name, e in friction.curve.items())}{stribeck}"


def _ripple(found: Spectrum | None, turn: float, robot: RobotConfig, joint: int, torque: str) -> Ripple | None:
    """Return the ripple; ``turn``: unit of position of one cycle of its orders, rad or m."""
    if found is None:
        return None
    ratio = float(np.abs(robot.transmission_matrix[joint, joint]))
    peaks = [
        RippleOrder(order=order * turn, motor_order=order * turn / ratio, amplitude=_estimate(size, std**2, torque))
        for order, size, std in found.peaks
    ]
    return Ripple(
        peaks=peaks,
        orders=(turn * found.orders).tolist(),
        amplitudes=found.amplitudes.tolist(),
        floor=found.floor.tolist(),
    )


def _ripple_words(ripple: Ripple | None, torque: str, turn: str) -> str:
    if ripple is None:
        return "not determined: the joint does not cross two periods of any ripple at constant speed; move it further"
    if not ripple.peaks:
        return f"none above the noise floor, {np.median(ripple.floor):.3g} {torque} (median over the orders)"
    return "; ".join(
        f"{_in_words(peak.amplitude)} at {peak.order:.4g} cycles per {turn} of the joint, "
        f"{peak.motor_order:.4g} of the motor"
        for peak in ripple.peaks
    )


def _in_words(estimate: Estimate) -> str:
    return f"{estimate.value:.4g} {estimate.unit} ({estimate.low:.4g} to {estimate.high:.4g})"
