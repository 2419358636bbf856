"""Values of a robot configuration that no arm is known to have, with the value that was probably meant."""

import math
from collections.abc import Iterator

from armident.configs.schema.robot import Joint, RobotConfig

STANDARD_GRAVITY = 9.81
"""Acceleration of gravity on Earth, m/s^2."""

GRAVITY_TOLERANCE = 0.05
"""Deviation from it that is a place on Earth or a rounded number, m/s^2: 9.764 to 9.834 are measured."""

LEAST_RATIO = 0.34
"""Smallest ratio of motor to joint: reducers of arms have 3 and more, direct drives 1, differentials a half."""

FASTEST = {"revolute": 50.0, "prismatic": 20.0}
"""Fastest joints, rad/s (2400 degrees/s: the last one of SCARA arms reaches 42) and m/s (linear motors reach 10)."""

FASTEST_DEGREES = 1000.0
"""Velocity limit of a revolute joint above which 1/min of a motor is likelier than degrees/s."""

QUICKEST_S = 0.005
"""Shortest time, s, to the velocity limit: the quickest arms take seven times as long."""

HEAVIEST = 2000.0
"""Mass over the cube of the reach, kg/m^3, that is rather in g: arms have 5 to 300."""

LARGEST_BITS = 34
"""Resolution that is likelier to be a number of bits than of counts per turn; 32 bits are the finest encoders."""

COARSEST_SCALE = 1000.0
"""Fewest counts per metre: a count of 1 mm."""

COUNTS_HELD = 2.0**31
"""Counts that an INT32 position (6064h) holds."""

LARGEST_RATED = {"current": 500.0, "voltage": 1000.0}
"""Largest rated values of a drive, A and V; 6075h is in mA."""

RATED_FACTOR = 30.0
"""Factor between the rated torque of a drive, at the joint, and the joint's limit. Peaks are three to five times the
rated value; a wrong unit (mA, mN m) is a factor of 1000."""


def implausible_values(robot: RobotConfig) -> Iterator[str]:
    """Yield key, value and probable meaning of each value that no arm is known to have."""
    size = math.hypot(*robot.gravity)
    if size and abs(size - STANDARD_GRAVITY) > GRAVITY_TOLERANCE:
        meant = [round(g / size * STANDARD_GRAVITY, 4) + 0.0 for g in robot.gravity]
        yield (
            f"gravity: {list(robot.gravity)} has a size of {size:.4g} m/s^2; on Earth this direction is {meant}, and "
            "[0, 0, 0] is for torques without gravity"
        )
    reach = sum(math.hypot(joint.mdh.d, joint.mdh.r) for joint in robot.joints)
    mass = sum(robot.first_moments.get(f"m{k}", 0.0) for k in range(1, robot.n + 1))
    if reach and mass > HEAVIEST * reach**3:
        yield f"urdf: masses of {mass:.4g} kg for a reach of {reach:.3g} m; if they are in g, {mass / 1000:.4g} kg"
    for k, (joint, row) in enumerate(zip(robot.joints, robot.transmission_matrix, strict=True)):
        ratio = max(map(abs, row.tolist()))
        if joint.type == "revolute" and ratio < LEAST_RATIO:
            yield (
                f"transmission[{k}]: the motor of {joint.name} turns {ratio:g} times per turn of the joint; a reducer "
                f"of {1 / ratio:.6g} to 1 has {1 / ratio:.6g}"
            )
        yield from _velocity(joint, f"joints[{k}].limits.velocity", ratio)
        most, fastest = joint.limits.acceleration, min(joint.limits.velocity, FASTEST[joint.type])
        if fastest / QUICKEST_S < most < math.inf:
            as_degrees = f"; as degrees/s^2 it is {math.radians(most):.4g} rad/s^2" * (joint.type == "revolute")
            yield f"joints[{k}].limits.acceleration: {most:g} reaches {fastest:g} in {fastest / most:.2g} s{as_degrees}"
        yield from _resolution(joint, f"joints[{k}].drive.counts_per_unit")
        yield from _drive(joint, f"joints[{k}].drive", ratio)


def _velocity(joint: Joint, place: str, ratio: float) -> Iterator[str]:
    value = joint.limits.velocity
    if not FASTEST[joint.type] < value < math.inf:
        return
    if joint.type == "prismatic":
        yield f"{place}: {value:g} m/s; as mm/s it is {value / 1000:g} m/s"
    elif value > FASTEST_DEGREES:
        at_joint = value * math.pi / 30 / max(ratio, 1.0 / ratio)
        yield f"{place}: {value:g} rad/s; as 1/min of the motor it is {at_joint:.4g} rad/s at the joint"
    else:
        yield f"{place}: {value:g} rad/s; as degrees/s it is {math.radians(value):.4g} rad/s"


def _resolution(joint: Joint, place: str) -> Iterator[str]:
    counts = joint.drive.counts_per_unit
    if counts is None:
        return
    if joint.type == "prismatic":
        if counts < COARSEST_SCALE:
            yield f"{place}: {counts:g} counts per m; as counts per mm it is {1000 * counts:g}"
    elif counts <= LARGEST_BITS:
        meant = f"; as bits of the encoder it is {2 ** int(counts)}" if counts == int(counts) else ""
        yield f"{place}: {counts:g} counts per turn of the motor{meant}"
    elif counts > COUNTS_HELD:
        yield f"{place}: {counts:g} counts per turn of the motor; 32 bits (6064h) hold less than one turn of them"


def _drive(joint: Joint, place: str, ratio: float) -> Iterator[str]:
    """Yield a rated value or a gain whose torque at the joint is far from the limit of the joint."""
    drive, limit = joint.drive, joint.limits.torque
    if drive.rated > LARGEST_RATED.get(drive.signal, math.inf):
        letter = drive.signal[0].replace("c", "A").replace("v", "V")
        yield f"{place}.rated: {drive.rated:g} {letter}; as m{letter} it is {drive.rated / 1000:g} {letter}"
        return
    if "rated" in drive.model_fields_set and not 1.0 <= (drive.saturation or drive.rated) / drive.rated <= RATED_FACTOR:
        yield f"{place}.saturation: {drive.saturation:g}, of a drive that is rated {drive.rated:g} (both A, V or N m)"
    if drive.gain == 0.0:
        yield f"{place}.gain: 0: every torque would be 0; give the torque per unit of the signal"
    elif {"gain", "rated"} <= drive.model_fields_set and limit < math.inf:
        torque = abs(drive.gain) * drive.rated * ratio
        if not 1.0 / RATED_FACTOR <= torque / limit <= RATED_FACTOR:
            yield (
                f"{place}: gain {drive.gain:g} and rated {drive.rated:g} give {joint.name} a rated torque of "
                f"{torque:.3g}, its limit is {limit:g}; correct gain (per A, not per mA), rated, transmission or limit"
            )
