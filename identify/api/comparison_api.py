"""Test for a change of the parameters between two identifications."""

from dataclasses import dataclass
from pathlib import Path

from armident.identify.api.identification_api import Identification, identified
from armident.identify.api.result_base import Result
from armident.identify.api.result_tables import Table
from armident.identify.documents.comparison import ComparisonDocument
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.comparison import compare_models


@dataclass(frozen=True, repr=False)
class ChangeTest(Result):
    """Test for a change of the parameters between two identifications of one robot; true if they have changed.

    Parameters
    ----------
    document
        Everything that ``comparison.json`` holds: parameters, groups, residuals, warnings.
    now
        The later identification.
    """

    document: ComparisonDocument
    now: IdentificationDocument
    file = "comparison.json"

    @property
    def changed(self) -> bool:
        """True if the parameters have changed, at the false-alarm rate asked for."""
        return self.document.verdict == "changed"

    @property
    def p_value(self) -> float:
        """Probability of so large a difference of all parameters together without a change."""
        return self.document.p_value

    @property
    def parameters(self) -> Table:
        """Table of the parameters: value before and after, standard deviation of the difference, p-value (Holm)."""
        columns = ("name", "joint", "before", "now", "std_of_difference", "p_value", "unit", "changed")
        rows = [[getattr(p, column) for column in columns] for p in self.document.parameters]
        return Table(columns, rows, self.document.sentence)

    def __bool__(self) -> bool:
        return self.changed

    def _html(self) -> str:
        from armident.identify.report.comparison_report import comparison_report

        return comparison_report(self.document, self.now)

    def _summary(self) -> str:
        return self.document.sentence

    def _table(self) -> Table | None:
        columns, changed = self.parameters.columns[:-1], [p for p in self.document.parameters if p.changed]
        return Table(columns, [[getattr(p, column) for column in columns] for p in changed]) if changed else None


def compare(
    baseline: Identification | IdentificationDocument | str | Path,
    now: Identification | IdentificationDocument | str | Path,
    *,
    false_alarm_rate: float = 1e-4,
    common: bool = False,
) -> ChangeTest:
    """Test if the parameters of a robot have changed since a baseline.

    Parameters
    ----------
    baseline, now
        Two identifications of one robot, or the paths of their ``identification.json``.
    false_alarm_rate
        Probability of the answer "changed" without a change.
    common
        True to compare the parameters that both have, if their models differ.

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
    >>> runs = [armident.simulate_recording("emps", "emps_excitation", seed=seed) for seed in (1, 2)]
    >>> first, second = (armident.identify(run, method="idim-iv") for run in runs)
    >>> bool(armident.compare(first, second))
    False
    """
    first, second = identified(baseline), identified(now)
    document = compare_models(first, second, common=common, false_alarms=false_alarm_rate)
    return ChangeTest(document, second[0])
