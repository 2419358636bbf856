"""Confirmation of a finding by data that are not used for selection."""

import pytest
from scipy import stats

from armident.configs.schema.robot import Effect
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.diagnosis.confirmation import Confirmation, confirmed
from armident.identify.diagnosis.model_state import with_report_part
from tests.fixtures.arms import hide
from tests.fixtures.diagnoses import SPRING, selection, with_effects

pytestmark = pytest.mark.slow

TERM = Effect(effect="joint_spring", joint="joint_1")


def compared(seed: int, *hidden: HiddenEffect) -> Confirmation:
    """Comparison of the models with and without a spring."""
    _, first = selection(seed, *hidden)
    return confirmed(with_report_part(with_effects(first, TERM)), with_report_part(first))


@pytest.mark.parametrize("runs", [4, pytest.param(12, marks=pytest.mark.nightly)])
def test_p_values_of_a_useless_term_are_spread_over_the_whole_range(runs: int) -> None:
    """The test of Kolmogorov and Smirnov is exact for any number of runs."""
    p = [compared(seed).p_value for seed in range(1, 1 + runs)]
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_a_true_effect_is_confirmed_and_the_error_is_smaller() -> None:
    found = compared(1, SPRING)
    assert found.p_value < 0.01
    assert found.smaller
    assert not found.absent
    assert found.scale == pytest.approx(1.0, abs=0.3)
    assert found.after[0] < 0.5 * found.before[0]
    assert found.share[0] > 0.75


def test_a_stronger_effect_changes_the_error_more() -> None:
    weak, strong = (compared(1, hide("joint_spring", "joint_1", stiffness=k)) for k in (20.0, 80.0))
    assert 0.0 < weak.before[0] ** 2 - weak.best[0] ** 2 < strong.before[0] ** 2 - strong.best[0] ** 2
