"""Stepwise selection: effects are added in their own loop, exchanged, removed, and negligible below a limit."""

from dataclasses import replace

import numpy as np
import pytest

from armident.configs.schema.robot import Effect
from armident.identify.diagnosis.candidate_comparison import Addition, SelectionStep, advantage
from armident.identify.diagnosis.candidates import Candidate, Shapes
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.diagnosis.selected import Selected
from armident.identify.diagnosis.selection import StepwiseSelection
from armident.identify.diagnosis.shortlist import Incumbent, shortlist
from armident.identify.effects.registry import known
from armident.identify.effects.terms import arm_model
from tests.fixtures.arms import hide
from tests.fixtures.diagnoses import SPRING, WORN, selection, with_effects

pytestmark = pytest.mark.slow

FRICTION = Effect(effect="asymmetric_viscous_friction", joint="joint_1")


def addition_of(step: SelectionStep, key: str) -> Addition:
    """The addition of an effect with a law."""
    return next(a for a in step.ranked if a.candidate.effect.key == key)


def loop_error(state: ModelState) -> float:
    """Norm of the difference of simulated and measured velocity, m/s."""
    return float(np.linalg.norm(np.concatenate([s.simulated.qd - s.measured.qd for s in state.study.train])))


def test_an_effect_is_tested_in_the_loop_that_it_makes() -> None:
    steps, first = selection(1, SPRING)
    best = steps.admitted(steps.step(first))
    assert best is not None
    assert best.candidate.effect.name == "joint_spring"
    assert [e.effect for e in best.state.robot.effects if e not in first.robot.effects] == ["joint_spring"]
    healthy = selection(1)[1]
    without, own, noise = (loop_error(state) for state in (first, best.state, healthy))
    # Without the effect the simulated loop moves otherwise; with it only the noise of the measurement is left.
    assert without > 1.5 * noise
    assert own == pytest.approx(noise, rel=0.05)


def test_nothing_is_admitted_in_a_healthy_arm() -> None:
    steps, first = selection(1)
    final, found = steps.run(first)
    assert found == ()
    assert final.robot == first.robot


def test_an_addition_whose_parameters_may_be_zero_does_not_pass() -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    best = steps.admitted(step)
    assert best is not None
    assert steps.passes(best, step.tests)
    undetermined = replace(best)
    undetermined.__dict__["p_value"] = 0.01
    assert not steps.passes(undetermined, step.tests)


def test_a_superfluous_finding_is_removed() -> None:
    steps, first = selection(1, SPRING)
    best = steps.admitted(steps.step(first))
    assert best is not None
    both = with_effects(best.state, FRICTION)
    superfluous = Selected(FRICTION, steps.step(first), best)
    state, kept = steps._reduced(both, (superfluous, Selected(best.entry, steps.step(first), best)))
    assert [one.entry.effect for one in kept] == ["joint_spring"]
    assert FRICTION not in state.robot.effects


class OneAtATime(StepwiseSelection):
    """A selection in which every effect makes the earlier ones superfluous, as two that resemble each other do."""

    def _superfluous(self, state: ModelState, less: ModelState, tests: int) -> bool:
        return True


@pytest.mark.timeout(300)
def test_effects_that_make_each_other_superfluous_end_the_selection() -> None:
    steps, first = selection(1, SPRING, WORN)
    one_at_a_time = OneAtATime(steps.study)
    _, found = one_at_a_time.run(first)
    assert len(found) == 1
    assert one_at_a_time.compared >= 3


def test_a_wrong_finding_is_exchanged_for_the_right_one() -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    wrong = addition_of(step, "presliding_friction")
    state, found = steps._exchanged(wrong.state, (Selected(wrong.entry, step, wrong),))
    assert [one.entry.effect for one in found] == ["joint_spring"]
    assert wrong.entry not in state.robot.effects


def test_an_effect_beside_which_a_finding_stays_does_not_take_its_place() -> None:
    """Both effects are there: the clearer one is a better model alone, and no rival of the other."""
    steps, first = selection(1, SPRING, WORN)
    step = steps.step(first)
    clearer = steps.admitted(step)
    assert clearer is not None
    assert clearer.candidate.effect.name == "joint_spring"
    other = addition_of(step, "asymmetric_viscous_friction")
    assert advantage(clearer.state, other.state) > steps.criteria.close
    state, found = steps._exchanged(other.state, (Selected(other.entry, step, other),))
    assert state is other.state
    assert [one.entry for one in found] == [other.entry]


def test_only_effects_on_a_joint_of_a_finding_compete_with_it() -> None:
    worn = hide("asymmetric_viscous_friction", "joint_2", fva=0.2 * 5.5)
    _, first = selection(63, worn, arm="tx40", motion="tx40_excitation")
    every = shortlist(first, None, set())
    joints = np.arange(6) == 1
    chosen = shortlist(first, Incumbent(0.0, joints), set())
    motion = first.study.motion(first.study.train[0], "measured", first.fit.theta)

    def acts(candidate: Candidate, shapes: Shapes) -> bool:
        return bool(candidate.effect.torque(motion, candidate.place, dict(shapes))[:, 1].any())

    assert chosen.tests == every.tests
    assert not all(acts(candidate, shapes) for candidate, shapes, _ in every.chosen)
    assert all(acts(candidate, shapes) for candidate, shapes, _ in chosen.chosen)
    assert ("asymmetric_viscous_friction", 1) in [(one.effect.key, one.place.joint) for one, *_ in chosen.chosen]


def test_every_joint_has_a_place_on_the_shortlist_whatever_others_promise() -> None:
    worn = hide("asymmetric_viscous_friction", "joint_2", fva=0.2 * 5.5)
    _, first = selection(63, worn, arm="tx40", motion="tx40_excitation")

    def joints(most: int) -> list[int]:
        criteria = replace(first.study.criteria, shortlist=most, unnamed=most, of_each_joint=1)
        chosen = shortlist(first.of_study(replace(first.study, criteria=criteria)), None, set()).chosen
        return [one.place.joint for one, *_ in chosen if one.effect.name != "unnamed"]

    every, few = joints(1000), joints(1)
    assert few[0] == 1
    assert set(few) == set(every) == set(range(6))
    assert len(few) < len(every)


def test_a_finding_does_not_compete_again_while_its_joints_have_not_changed() -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    wrong = addition_of(step, "presliding_friction")
    once = StepwiseSelection(steps.study)
    state, found = once._exchanged(wrong.state, (Selected(wrong.entry, step, wrong),), np.array([False]))
    assert state is wrong.state
    assert [one.entry for one in found] == [wrong.entry]


def test_the_advantage_of_a_model_is_the_disadvantage_of_the_other() -> None:
    steps, first = selection(1, SPRING)
    best = steps.admitted(steps.step(first))
    assert best is not None
    assert advantage(best.state, first) > steps.criteria.close
    assert advantage(first, best.state) == pytest.approx(-advantage(best.state, first), rel=1e-9)
    assert advantage(first, first) == 0.0


def test_no_exchange_returns_to_an_earlier_model() -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    wrong, right = addition_of(step, "presliding_friction"), addition_of(step, "joint_spring")
    again = StepwiseSelection(steps.study)
    again._exchanged(right.state, ())
    state, found = again._exchanged(wrong.state, (Selected(wrong.entry, step, wrong),))
    assert state is wrong.state
    assert [one.entry for one in found] == [wrong.entry]


def test_of_two_laws_that_predict_as_well_the_simpler_one_is_preferred() -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    linear, cubic = addition_of(step, "joint_spring"), addition_of(step, "joint_spring/cubic")
    assert len(linear.candidate.effect.linear) < len(cubic.candidate.effect.linear)
    ranked = tuple(sorted((linear, cubic), key=lambda a: -a.log_likelihood))
    close = StepwiseSelection(replace(steps.study, criteria=replace(steps.criteria, close=1e9)))
    admitted = close.admitted(replace(step, ranked=ranked, passing=ranked))
    assert admitted is linear


def test_a_law_with_more_parameters_has_to_explain_materially_more() -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    linear, cubic = addition_of(step, "joint_spring"), addition_of(step, "joint_spring/cubic")
    for factor, expected in ((0.9, linear), (1.1, cubic)):
        share = linear.share + factor * steps.criteria.least_share * (1.0 - linear.share)
        larger = 2.0 * linear.material_pct
        better = replace(cubic, log_likelihood=linear.log_likelihood + 50.0, share=share, material_pct=larger)
        admitted = steps.admitted(replace(step, ranked=(better, linear), passing=(better, linear)))
        assert admitted is not None
        assert admitted.candidate.effect.key == expected.candidate.effect.key


@pytest.mark.parametrize("passing", [True, False])
def test_smaller_noise_of_corrected_torques_is_no_evidence_against_an_effect(passing: bool) -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    named = addition_of(step, "joint_spring")
    candidate = replace(named.candidate, effect=known("actuator_bandwidth"))
    entry = Effect(effect="actuator_bandwidth", joint="joint_1", parameters={"lag": 0.003})
    fitted = replace(named.fitted, candidate=candidate, entry=entry)
    for p_value, expected in ((1e-6, "joint_spring"), (1e-30, "actuator_bandwidth")):
        spring = replace(named)
        lag = replace(named, fitted=fitted, log_likelihood=named.log_likelihood + 100.0)
        spring.__dict__["p_value"], lag.__dict__["p_value"] = 1e-20, p_value
        able = (lag, spring) if passing else (spring,)
        admitted = steps.admitted(replace(step, ranked=(lag, spring), passing=able))
        found = None if admitted is None else admitted.candidate.effect.name
        assert found == (expected if passing or expected == "joint_spring" else None)


def test_a_named_effect_that_explains_half_comes_before_a_better_term_without_a_name() -> None:
    steps, first = selection(1, SPRING)
    step = steps.step(first)
    named = addition_of(step, "joint_spring")
    effect = known("unnamed/time")
    nameless = replace(named, fitted=replace(named.fitted, candidate=replace(named.candidate, effect=effect)))
    for factor, expected in ((1.9, "joint_spring"), (2.1, "unnamed")):
        better = replace(nameless, share=factor * named.share)
        both = replace(step, ranked=(better, named), passing=(better, named))
        admitted = steps.admitted(both)
        assert admitted is not None
        assert admitted.candidate.effect.name == expected


def test_a_selection_is_deterministic() -> None:
    steps, first = selection(1, SPRING)
    again = StepwiseSelection(steps.study)
    one, other = steps.step(first), again.step(again.start())
    assert [a.entry for a in one.ranked] == [a.entry for a in other.ranked]
    np.testing.assert_array_equal([a.gain for a in one.ranked], [a.gain for a in other.ranked])


def test_the_selected_model_is_a_model_of_identify() -> None:
    steps, first = selection(1, SPRING)
    final, _ = steps.run(first)
    assert "ks1" in arm_model(final.with_values()).base.names
