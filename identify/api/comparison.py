"""Test for a change of the parameters between two identifications."""

from dataclasses import dataclass
from pathlib import Path

from armident.identify.api.identification import Identification, document_of
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.change_test import ParameterChangeTest
from armident.identify.monitoring.change.change_test import compare as test_parameter_change
from armident.identify.tables import Table


@dataclass(frozen=True, repr=False)
class ChangeTest:
    """Test for a change of the parameters between two identifications of one robot.

    Parameters
    ----------
    result
        Differences, standard deviations and p-values of parameters and groups.
    """

    result: ParameterChangeTest

    @property
    def changed(self) -> bool:
        """True if the parameters have changed, at the false-alarm rate asked for."""
        return self.result.drifted

    @property
    def p_value(self) -> float:
        """Probability of so large a difference of all parameters together without a change."""
        return self.result.p_joint

    @property
    def parameters(self) -> Table:
        """Table of the parameters: value before and after, standard deviation of the difference, p-value (Holm)."""
        result = self.result
        rows = [
            (p.name, float(before), p.value, float(std), float(p_value), p.unit)
            for p, before, std, p_value in zip(
                result.parameters, result.before, result.std, result.p_values, strict=True
            )
        ]
        return Table(("name", "before", "after", "std_of_difference", "p_value", "unit"), rows, result.words)

    def __bool__(self) -> bool:
        return self.changed

    def __repr__(self) -> str:
        return self.result.words

    def _repr_html_(self) -> str:
        return self.parameters._repr_html_()


def compare(
    baseline: Identification | IdentificationDocument | str | Path,
    now: Identification | IdentificationDocument | str | Path,
    *,
    false_alarm_rate: float = 1e-4,
) -> ChangeTest:
    """Test if the parameters of a robot have changed since a baseline.

    Parameters
    ----------
    baseline, now
        Two identifications of one robot with the same model, or the paths of their ``identification.json``.
    false_alarm_rate
        Probability of the answer "changed" without a change.

    Returns
    -------
    ChangeTest
        True in a condition if the parameters have changed.

    Raises
    ------
    DataError
        If the two are of different robots or models, or too imprecise for an answer.

    Examples
    --------
    >>> import armident
    >>> runs = [armident.simulate_recording("tx40", "tx40_excitation", seed=seed) for seed in (1, 2)]
    >>> first, second = (armident.identify(run, method="idim-iv") for run in runs)
    >>> bool(armident.compare(first, second))
    False
    """
    return ChangeTest(test_parameter_change(document_of(baseline), document_of(now), false_alarm_rate))
