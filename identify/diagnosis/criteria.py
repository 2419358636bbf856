"""All thresholds of a diagnosis, each with its unit and source."""

from dataclasses import dataclass

import numpy as np

from armident.identify.setup.search import NOT_UNDERSTOOD


@dataclass(frozen=True)
class Criteria:
    """Thresholds of a diagnosis; the document contains them.

    Parameters
    ----------
    false_alarm_rate
        Probability of any finding for a plant that has the structure of the model. `alpha` divides it among the tests.
    material_pct
        Least change of a joint's torque by a finding, percent of the root mean square of its torque. Smaller effects
        are listed as negligible. Chosen by the user (``--material``).
    least_share
        Least share of the power of a joint's predicted errors that a finding removes. A smaller one changes the error
        by less than 2 %, which is no cause of a gap.
    confirmation_level
        Significance level of the report part alone, which chose nothing: as the usual false-alarm rate. A finding
        that training data overrate, or that holds for one recording only, does not pass.
    named_share
        Least share of the errors' power that an effect with a name removes, over that of the best term without one.
        The name explains most of the regularity then, and the rest is found beside it.
    close
        Difference of log-likelihood below which two explanations are ambiguous: odds of 20 to 1.
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
    """

    false_alarm_rate: float = 0.01
    material_pct: float = 0.2
    least_share: float = 0.04
    confirmation_level: float = 0.01
    named_share: float = 0.5
    close: float = float(np.log(20.0))
    set_up_doubtful_pct: float = 100.0 * NOT_UNDERSTOOD
    most_findings: int = 8
    promising: float = 0.25
    shortlist: int = 10
    unnamed: int = 4

    @property
    def alpha(self) -> dict[str, float]:
        """Division of the false-alarm rate: selection of effects, lack of fit, and changed parameters."""
        rate = self.false_alarm_rate
        return {"selection": 0.5 * rate, "lack_of_fit": 0.25 * rate, "changed_parameters": 0.25 * rate}

    def selection_level(self, tests: int) -> float:
        """Significance level of the selection for one of a number of candidates."""
        return self.alpha["selection"] / max(tests, 1)

    def needed_gain(self, tests: int) -> float:
        """Gain of log-likelihood of a significant effect, found among a number of candidates, nats."""
        return -float(np.log(self.selection_level(tests)))
