"""Limits of the verdict of an identification, each with its unit and source."""

from dataclasses import dataclass

from armident.identify.estimators.residual_tests import FALSE_ALARM_RATE


@dataclass(frozen=True)
class IdentificationCriteria:
    """Limits by which an identification judges itself; the document contains them.

    ``max_joint_error_pct``: largest error of a joint's torque that a model may leave, percent of the torque's norm. A
        third is as much as friction or a load of the usual size takes: more is no detail that the rigid model lacks,
        but a wrong signal.
    ``max_rest_error_pct``: the same for a joint at rest, percent: friction at rest has no model, but 100 % is the error
        of no model at all.
    ``sign_tolerance_std``: standard deviations by which a quantity must be negative to count as negative. 3: one true
        value of zero in 740 is rejected (Gaussian, one-sided).
    ``max_relative_std``: relative standard deviation up to which a parameter counts as determined: 1/3, as
        ``sign_tolerance_std``.
    ``max_inertia_std``: relative standard deviation of the inertia of a joint above which the motion does not determine
        it. 1: not even its order of magnitude is known.
    ``max_gravity_std``: standard deviation of the gravity torque of a joint anywhere between its limits, relative to
        its recorded torque, above which the motion does not determine it. 1/3: an error as large as
        ``max_joint_error_pct``.
    ``rest_share``: range of a joint, relative to the greatest range of a joint of its type, below which it is at rest.
        0.01: the deflection of a held joint under the torques of the others (virtual TX40: 0.008 at most).
    ``rest_limit_share``: the same relative to the range of its position limits. 0.001: the deflection of a joint held
        against noise (virtual TX40: 0.003 rad of 6.3 rad).
    ``rest_counts``: range, encoder counts, up to which a joint is at rest: quantisation and dither of a servo in
        position.
    ``rest_noise_std``: range, standard deviations of the white position noise, up to which a joint is at rest. 10: the
        range of 1e6 Gaussian samples.
    ``false_alarm_rate``: probability that the tests of all residuals of a correct model find something (Bonferroni over
        the joints).
    ``white_fraction``: fraction of autocorrelation lags outside two standard deviations up to which a residual counts
        as white noise; 0.05 is expected, 0.15 is exceeded with a probability of 2 % for 20 lags.
    ``max_motion_share``: share of the power of a joint's residual that its averages over position or velocity may
        explain beyond chance. 0.2: without it the residual is a tenth smaller. Healthy virtual arms have 0.13 at most.
    ``min_motion_deviation``: deviation of that share from its mean under circular shifts, standard deviations of the
        shifts, from which on a dependence counts. 4: noise with a pole up to 0.9 per row reaches 3.7 in 540 tests.
    ``material_pct``: torque that such a dependence moves, percent of the joint's torque, from which on it counts: the
        default of ``diagnose --material``.
    ``max_bias_std``: bias by derivatives, encoder noise and sampling, standard deviations, above which an estimate is
        corrected. 0.5: an interval of two standard deviations with this bias covers 92.7 % instead of 95.4 %.
    ``max_serial_std_ratio``: ratio of standard deviations with and without serial correlation above which intervals are
        doubtful where the residuals are not white. 1.25: an interval of two standard deviations covers 89 %.
    ``serial_level``: significance level of that test for white residuals. 1e-3: the parallel filter alone, whose
        cut-off is the decimated Nyquist frequency, correlates neighbours by about 0.1, which 0.01 would reject.
    ``max_std_ratio``: ratio of the standard deviations that allow for serial correlation to those of the method, above
        which the latter are too small. 1.5: an interval of two standard deviations covers 82 % instead of 95 %.
    ``max_velocity_error``: relative error of the simulated velocities above which the closed loop does not move like
        the robot. 0.3: the instruments then keep a correlation of 0.95 with the motion (``sqrt(1 - 0.3^2)``).
    ``min_smoothed_sign``: smoothed sign at the root mean square velocity of a joint below which a warning names it.
        0.98: viscous friction absorbs the 2 % of Coulomb friction that the smoothed sign lacks there, and is wrong by
        as much of its torque.
    ``max_delay_samples``: deviation of the torque delay from the expected half a sample that is tolerated, samples. 1:
        a drive that reports the torque of the sample before or after has less.
    ``max_listed``: largest number of parameters that a sentence lists by name: two lines of text.
    """

    max_joint_error_pct: float = 100.0 / 3.0
    max_rest_error_pct: float = 100.0
    sign_tolerance_std: float = 3.0
    max_relative_std: float = 1.0 / 3.0
    max_inertia_std: float = 1.0
    max_gravity_std: float = 1.0 / 3.0
    rest_share: float = 0.01
    rest_limit_share: float = 1e-3
    rest_counts: float = 5.0
    rest_noise_std: float = 10.0
    false_alarm_rate: float = FALSE_ALARM_RATE
    white_fraction: float = 0.15
    max_motion_share: float = 0.2
    min_motion_deviation: float = 4.0
    material_pct: float = 0.2
    max_bias_std: float = 0.5
    max_serial_std_ratio: float = 1.25
    serial_level: float = 1e-3
    max_std_ratio: float = 1.5
    max_velocity_error: float = 0.3
    min_smoothed_sign: float = 0.98
    max_delay_samples: float = 1.0
    max_listed: int = 12
