"""Result of the set-up check."""

from dataclasses import dataclass

from armident.configs import RobotConfig


@dataclass(frozen=True)
class SetupFinding:
    """One mistake of the set-up.

    Parameters
    ----------
    kind
        ``position_sign``, ``torque_sign``, ``joint_order``, ``position_unit``, ``torque_unit``, ``time_unit``,
        ``gear_ratio``, ``side``, ``gravity_direction``, ``gravity_missing``, ``time_shift``, ``torque_clipped``,
        ``rate_too_slow``, ``standstill`` or ``joint_at_rest``.
    joints
        Names of the joints concerned.
    probability
        Posterior share of the hypothesis among those tried, 0 to 1.
    message
        One sentence with figures.
    remedy
        Line of the configuration, or option of a command, that corrects it.
    decisive
        True if results without the correction are unusable.
    """

    kind: str
    joints: tuple[str, ...]
    probability: float
    message: str
    remedy: str
    decisive: bool


@dataclass(frozen=True)
class SetupCheck:
    """Result of `armident.identify.setup.check.check_setup`.

    Parameters
    ----------
    findings
        Mistakes of the set-up; empty if it is right.
    relative_error_pct
        Norm of the torque residual of the rigid model as configured over that of the torque, percent, (n,).
    corrected_error_pct
        The same with the corrections, (n,).
    joints_not_understood
        Joints of which the rigid model, even with a spring and free friction, leaves more than a third of the torque,
        and no hypothesis explains it.
    tried
        Hypotheses tried, in words.
    corrected_robot
        Configuration with the corrections that a configuration can express; ``None`` if there are none.
    clock
        True over recorded duration: the sampling period has to be multiplied by it.
    """

    findings: tuple[SetupFinding, ...]
    relative_error_pct: tuple[float, ...]
    corrected_error_pct: tuple[float, ...]
    joints_not_understood: tuple[str, ...]
    tried: tuple[str, ...]
    corrected_robot: RobotConfig | None
    clock: float = 1.0
