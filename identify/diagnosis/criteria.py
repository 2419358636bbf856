"""All thresholds of a diagnosis, each with its unit and source."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Criteria:
    """Thresholds of a diagnosis; the document contains them.

    Parameters
    ----------
    false_alarm_rate
        Probability of any finding for a plant that has the structure of the model. Shared equally by all candidates of
        a step (Bonferroni): odds of candidates to `false_alarm_rate` are asked of the likelihood.
    material_pct
        Least change of a joint's torque by a finding, percent of the root mean square of its torque. Smaller effects
        are listed as negligible. Chosen by the user (``--material``).
    least_share
        Least share of the power of a joint's predicted errors that a finding removes. A smaller one changes the error
        by less than 2 %, which is no cause of a gap.
    set_up_doubtful_pct
        Relative error of a joint, percent, above which nothing is named there: the rigid model leaves more than a third
        of its torque, so that the set-up is in question.
    most_findings
        Most effects of one diagnosis.
    shortlist, unnamed
        Numbers of named and unnamed candidates that are tested in their own closed loop, in each step.
    """

    false_alarm_rate: float = 0.01
    material_pct: float = 0.2
    least_share: float = 0.04
    set_up_doubtful_pct: float = 33.3
    most_findings: int = 8
    shortlist: int = 10
    unnamed: int = 4
