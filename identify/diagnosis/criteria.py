"""All thresholds by which a diagnosis decides, each with its unit and its source or reckoning."""

from dataclasses import dataclass

import numpy as np

from armident.identify.identification.identification_criteria import IdentificationCriteria
from armident.identify.setup.search import NOT_UNDERSTOOD


@dataclass(frozen=True)
class Criteria:
    """Thresholds of a diagnosis; the document contains them.

    Parameters
    ----------
    false_alarm_rate
        Probability of any finding for a plant that has the structure of the model. `alpha` divides it among the tests.
    change_rate
        Probability of a change against a baseline of the same plant, as of `armident compare`, so that both agree: one
        in 200 years of weekly runs.
    material_pct
        Least change of a joint's torque by a finding, percent of the root mean square of its torque. Smaller effects
        are listed as negligible. Chosen by the user (``--material``). A lack of fit is material if the joint's error on
        the report part falls by as much without it.
    least_share
        Least share of the power of a joint's predicted errors that a finding removes. A smaller one changes the error
        by less than 2 %, which is no cause of a gap.
    confirmation_level
        Significance level of the report part alone, which is not used for selection: as the usual false-alarm rate. A
        finding that training data overrate, or that holds for one recording only, does not pass.
    named_share
        Least share of the errors' power that an effect with a name removes, over that of the best term without one.
        The name explains most of the regularity then, and the rest is found beside it.
    close
        Difference of log-likelihood below which two explanations are ambiguous, nats: odds of 20 to 1. As prior odds of
        common changes (friction, loads, offsets) against rare ones, it decides where the data are ambiguous.
    set_up_doubtful_pct
        Relative error of a joint, percent, above which nothing is named there: the rigid model leaves more than a third
        of its torque, so that the set-up is in question.
    most_findings
        Most effects of one diagnosis.
    promising
        Least gain of log-likelihood that the screening promises, over that which a finding needs, for a test in the
        closed loop. In that loop an effect may gain more.
    shortlist, unnamed
        Numbers of named and unnamed candidates that are tested in their own closed loop, in each step.
    of_each_joint
        Number of named candidates of each joint that are tested whatever those of other joints promise.
    alternatives
        Most alternatives that are listed for a finding.
    doubtful
        Confidence below which another experiment is recommended: the alternatives together have odds of 2 to 3.
    held_out_share
        Share at the end of every recording for the report part, where no recording is given for it. A finding needs
        about 10 nats of the rest; of this share it has 5 nats, a p-value of 0.001, under `confirmation_level`.
    band
        Frequency up to which model and data are compared, in closed-loop bandwidths (thesis section B.2).
    stiff_loop
        Most squared error of simulated velocities with an effect over that without, where a nominal controller follows
        the motion whatever the arm: with up to 22 % more error such a loop is as good.
    noisy_motion
        Share of a torque beyond the simulated motion from which it counts as measurement noise: more than half.
    weighted_errors
        Most errors with weighted equations over those with white weights: efficient weights change an estimate by less
        than its standard deviation, and the errors by a few percent.
    beyond_model
        Least norm of the torque of an effect orthogonal to the model, over its own, for a test. Below it the effect
        would be a thousand times as large as what the data show of it.
    beyond_model_limit
        The same of one parameter, for a detection limit: a hundred times.
    beyond_model_function
        The same of a free function, for the lack of fit. Below it the standard deviation of the curve would be more
        than ten times as large as that of the residual, and distort the curve.
    detection_power
        Probability of a finding at the detection limit: nine diagnoses of ten.
    held_out_level
        Significance level of the held-out data alone for a dependence of the residual: usual 5 %.
    robust_deviations
        Limit of whitened residuals, robust standard deviations: normal noise exceeds it once in 16 000 samples.
    rows_per_function
        Least number of equations per free function: with 12 the functions take 8 % of the noise power.
    functions_in_noise
        Most sets of functions taken out of the residual of one joint for its noise model, against overfitting.
    most_unexplained
        Most unexplained dependences of one joint.
    motion_share
        Share of the dependence on the motion altogether that single variables have to explain, so that it is not
        listed beside them: the greater part.
    burst_share
        Least share of the residual's power in bursts that are reported: they are most of the error. Stick-slip of
        healthy arms, which the smoother of the velocity does not follow, has less.
    reversal
        Velocity under which dry friction reverses, in velocities of its transition: four fifths of it are there then.
    dragged_speed
        Speed of a joint in a recording over that in the recording where it moves most, below which other joints only
        drag it. In 31 recordings of 7 random arms joints that were asked to move have 0.29 at least, others 0.14 at
        most.
    line_level
        Significance level from which a spectral line is searched in the references: as the usual false-alarm rate.
    reference_line
        Power of a line of the references over that around it: of 1000 frequencies without a line, the largest exceeds
        14 times once in 1000 recordings; a line of a set-point generator is stronger by orders.
    modulated_line
        Width to either side of a line that the motion modulates, in bandwidths of the motion: sidebands of slow motion
        lie within a tenth.
    other_motion
        Factor of the standard deviations of a difference between two motions, where the residuals of one run are not
        noise: errors of the model do not cancel then. See docs/diagnosis.md, Baseline, for the healthy pairs.
    larger_error
        Relative error of a joint by the baseline and its changes, over that of the baseline in its own motion, above
        which an effect is looked for: half of the larger error is no error of the baseline then.
    larger_residuals
        Root mean square of the residuals of a joint over that in the baseline, with another motion, above which an
        effect is looked for; the same of the report part over the training data. Errors of one model differ with the
        motion; of 152 joints of healthy random arms, 5 differ by more.
    estimable
        Share of a parameter in the observed directions above which its change is reported by itself: the other
        directions hold 3 % of it at most.
    """

    false_alarm_rate: float = 0.01
    material_pct: float = IdentificationCriteria.material_pct
    change_rate: float = 1e-4
    least_share: float = 0.04
    confirmation_level: float = 0.01
    named_share: float = 0.5
    close: float = float(np.log(20.0))
    set_up_doubtful_pct: float = 100.0 * NOT_UNDERSTOOD
    most_findings: int = 8
    promising: float = 0.25
    shortlist: int = 10
    unnamed: int = 4
    of_each_joint: int = 2
    alternatives: int = 3
    doubtful: float = 0.6
    held_out_share: float = 0.35
    band: float = 5.0
    stiff_loop: float = 1.5
    noisy_motion: float = 0.5
    weighted_errors: float = 1.1
    beyond_model: float = 1e-3
    beyond_model_limit: float = 1e-2
    beyond_model_function: float = 0.1
    detection_power: float = 0.9
    held_out_level: float = 0.05
    robust_deviations: float = 4.0
    rows_per_function: int = 12
    functions_in_noise: int = 3
    most_unexplained: int = 2
    motion_share: float = 0.5
    burst_share: float = 0.5
    reversal: float = 3.0
    dragged_speed: float = 0.2
    line_level: float = 0.01
    reference_line: float = 100.0
    modulated_line: float = 0.1
    other_motion: float = 2.0
    larger_error: float = 1.5
    larger_residuals: float = 2.0
    estimable: float = 0.999

    @property
    def alpha(self) -> dict[str, float]:
        """Division of the false-alarm rate: selection of effects, lack of fit, and changed parameters."""
        rate = self.false_alarm_rate
        changed = min(0.25 * rate, self.change_rate)
        return {"selection": 0.5 * rate, "lack_of_fit": 0.25 * rate, "changed_parameters": changed}

    def selection_level(self, tests: int) -> float:
        """Significance level of the selection for one of a number of candidates."""
        return self.alpha["selection"] / max(tests, 1)

    def needed_gain(self, tests: int) -> float:
        """Gain of log-likelihood of a significant effect, found among a number of candidates, nats."""
        return -float(np.log(self.selection_level(tests)))
