"""Columns of the tables of laws and controllers that the compiled simulation reads."""

LAWS = (
    "viscous", "coulomb", "offset", "smoothing",
    "viscous_forward", "coulomb_forward",
    "stribeck", "stribeck_velocity", "stribeck_law",
    "tight", "tight_position", "tight_width",
    "ripple", "ripple_order", "ripple_phase",
    "spring", "spring_cubic", "spring_position",
    "work_drop", "work_scale",
    "time_drop", "time_scale",
    "curve", "curve_velocity", "curve_power",
    "load", "load_knee",
    "presliding",
    "slosh", "slosh_frequency", "slosh_damping",
    "eccentricity", "eccentricity_order", "eccentricity_phase",
    "lag",
)  # fmt: skip
"""Columns of a law table, one row per joint; zero leaves a law out."""

(
    VISCOUS, COULOMB, OFFSET, SMOOTHING,
    VISCOUS_FORWARD, COULOMB_FORWARD,
    STRIBECK, STRIBECK_VELOCITY, STRIBECK_LAW,
    TIGHT, TIGHT_POSITION, TIGHT_WIDTH,
    RIPPLE, RIPPLE_ORDER, RIPPLE_PHASE,
    SPRING, SPRING_CUBIC, SPRING_POSITION,
    WORK_DROP, WORK_SCALE,
    TIME_DROP, TIME_SCALE,
    CURVE, CURVE_VELOCITY, CURVE_POWER,
    LOAD, LOAD_KNEE,
    PRESLIDING,
    SLOSH, SLOSH_FREQUENCY, SLOSH_DAMPING,
    ECCENTRICITY, ECCENTRICITY_ORDER, ECCENTRICITY_PHASE,
    LAG,
) = range(len(LAWS))  # fmt: skip

GEARS = ("joint", "stiffness", "cubic", "damping", "gap")
"""Columns of a table of flexible joints; a row adds a coordinate for the motor."""
PAIRS = ("first", "second", "viscous", "coulomb")
"""Columns of a table of friction between two joints."""
CONTROLLERS = ("kp", "kv", "ki", "kd_only", "feedforward", "window", "filter", "limit")
"""Columns of a table of controllers, one row per joint."""
KP, KV, KI, ONE_LOOP, FEEDFORWARD, WINDOW, FILTER, LIMIT = range(len(CONTROLLERS))
