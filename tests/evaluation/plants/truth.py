"""Kinds of cases, their shares in the suite, and the findings that are accepted for each: the only such table."""

from typing import Literal

Family = Literal["healthy", "effect", "setup", "outside"]

ACCEPTED: dict[str, tuple[str, ...]] = {
    "healthy": (),
    # effects of the catalogue
    "stribeck_law": ("stribeck_friction",),
    "tight_spot": ("position_dependent_friction",),
    "ripple_joint": ("torque_ripple", "cogging_torque"),
    "ripple_motor": ("torque_ripple", "cogging_torque"),
    "stiffening_spring": ("joint_spring",),
    "one_sided_viscosity": ("asymmetric_viscous_friction",),
    "warming_with_work": ("friction_drift",),
    "warming_with_time": ("friction_drift",),
    "curved_viscosity": ("nonlinear_viscous_friction",),
    "load_friction": ("load_dependent_friction",),
    "presliding": ("presliding_friction",),
    "pair_friction": ("coupling_friction",),
    "elastic_gear": ("joint_elasticity",),
    "play": ("backlash",),
    "soft_saturation": ("drive_gain_saturation",),
    "gain_error": ("drive_gain_error",),
    "torque_delay": ("time_delay", "actuator_bandwidth"),
    "slow_actuator": ("actuator_bandwidth", "time_delay"),
    "eccentric_encoder": ("encoder_eccentricity",),
    "tilted_base": ("gravity_direction",),
    "missing_rotor": ("rotor_inertia",),
    # set-up
    "another_gravity": ("gravity_direction",),
    "position_sign": ("position_sign", "sign_error"),
    "torque_sign": ("torque_sign", "sign_error"),
    "both_signs": ("position_sign", "torque_sign", "sign_error"),
    "all_torque_signs": ("torque_sign", "position_sign", "sign_error"),
    "joint_order": ("joint_order",),
    "torque_order": ("joint_order",),
    "degrees": ("position_unit",),
    "torque_unit": ("torque_unit",),
    "milliamperes": ("torque_unit", "side", "drive_gain_error"),
    "per_mille": ("torque_unit", "drive_gain_error"),
    "milliseconds": ("time_unit",),
    "motor_side_position": ("side", "gear_ratio", "position_unit"),
    "motor_side_torque": ("side", "gear_ratio", "torque_unit"),
    "gear_ratio": ("gear_ratio",),
    "all_late": ("time_shift", "time_delay"),
    "gravity_missing": ("gravity_missing",),
    "clipped": ("torque_clipped", "drive_gain_saturation"),
    # outside the catalogue: no name is accepted
    "torque_bursts": (),
    "unrecorded_signal": (),
    "vibration": (),
    "offset_steps": (),
    "slosh": (),
}
"""Names of findings that are right for a hidden kind, by kind; the names of the set-up check come first."""

SHARES: dict[Family, dict[str, int]] = {
    "healthy": {"healthy": 28},
    "effect": {
        "stribeck_law": 2, "tight_spot": 2, "ripple_joint": 3, "ripple_motor": 1, "stiffening_spring": 2,
        "one_sided_viscosity": 1, "warming_with_work": 2, "warming_with_time": 1, "curved_viscosity": 1,
        "load_friction": 1, "presliding": 1, "pair_friction": 1, "elastic_gear": 2, "play": 1, "soft_saturation": 1,
        "gain_error": 1, "torque_delay": 1, "slow_actuator": 1, "eccentric_encoder": 1, "tilted_base": 2,
        "missing_rotor": 1,
    },
    "setup": {
        "another_gravity": 2, "position_sign": 1, "torque_sign": 1, "both_signs": 1, "all_torque_signs": 1,
        "joint_order": 2, "torque_order": 2, "degrees": 1, "torque_unit": 1, "milliamperes": 1, "per_mille": 1,
        "milliseconds": 1, "motor_side_position": 1, "motor_side_torque": 1, "gear_ratio": 1, "all_late": 1,
        "gravity_missing": 1, "clipped": 1,
    },
    "outside": {"torque_bursts": 2, "unrecorded_signal": 2, "vibration": 2, "offset_steps": 2, "slosh": 2},
}  # fmt: skip
"""Cases of each kind in a block; blocks repeat, each in an order of its own."""


def block() -> list[tuple[Family, str]]:
    """Family and kind of the cases of one block."""
    return [(family, kind) for family, kinds in SHARES.items() for kind, count in kinds.items() for _ in range(count)]
