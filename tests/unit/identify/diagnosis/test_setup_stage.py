"""Doubtful mistakes of a set-up: what a diagnosis goes on with, and what it shows of them."""

from dataclasses import replace

import numpy as np
import pytest

from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.diagnose import _verdict
from armident.identify.diagnosis.setup_stage import SetupStage, set_up
from armident.identify.setup import judge
from armident.identify.signals.experiments import Experiment
from tests.fixtures import setups
from tests.fixtures.setups import random_arm

pytestmark = pytest.mark.slow

ARM = random_arm(0, 3)


def staged(experiments: list[Experiment]) -> SetupStage:
    return set_up(experiments[:1], experiments[1:], ARM, Criteria())


@pytest.fixture
def doubtful(monkeypatch: pytest.MonkeyPatch) -> None:
    """No probability is enough for a correction to copy."""
    monkeypatch.setattr(judge, "CORRECTED", 1.0)


def with_noise(experiments: list[Experiment], joint: int, share: float) -> list[Experiment]:
    """White noise in the torque of one joint. ``share``: of its standard deviation."""
    made = []
    for k, e in enumerate(experiments):
        tau = e.tau.copy()
        tau[:, joint] += share * tau[:, joint].std() * np.random.default_rng(k).standard_normal(len(tau))
        made.append(replace(e, tau=tau))
    return made


@pytest.mark.usefixtures("doubtful")
def test_a_doubtful_exchange_that_one_joint_does_not_confirm_is_a_finding_and_changes_no_model() -> None:
    noisy = with_noise(setups.record(ARM, 0), 2, 8.0)
    stage = staged(setups.with_torques(noisy, setups.in_order(0, 2, 1)))
    (finding,) = stage.findings
    assert (finding.effect, finding.joint, finding.other) == ("joint_order", "axis_2", "axis_3")
    assert finding.confidence > 0.5
    assert stage.robot == ARM
    assert finding.gap_after == finding.gap_before
    assert _verdict(stage.findings, []) == "unexplained"


@pytest.mark.usefixtures("doubtful")
def test_a_doubtful_direction_of_gravity_is_corrected_and_its_gap_falls() -> None:
    gravity = (0.9, 0.0, -9.77)
    stage = staged(setups.record(ARM, 0, gravity=gravity))
    (finding,) = stage.findings
    np.testing.assert_allclose(stage.robot.gravity, gravity, atol=0.15)
    assert finding.gap_after < 0.5 * finding.gap_before
    assert _verdict(stage.findings, []) == "explained"


@pytest.mark.usefixtures("doubtful")
def test_an_exchange_that_both_joints_confirm_is_corrected() -> None:
    stage = staged(setups.with_torques(setups.record(ARM, 0), setups.in_order(0, 2, 1)))
    (finding,) = stage.findings
    assert [entry.effect for entry in stage.robot.effects] == ["joint_order"]
    assert finding.gap_after < 0.5 * finding.gap_before
    assert _verdict(stage.findings, []) == "explained"


@pytest.mark.usefixtures("doubtful")
def test_an_exchange_is_confirmed_in_motion_and_not_by_what_dry_friction_holds_at_rest() -> None:
    order = setups.in_order(1, 0, 2)
    recorded = setups.with_torques(setups.record(ARM, 0, pauses=True), order)
    stage = staged(setups.with_positions(recorded, order))
    assert [(entry.effect, entry.joint, entry.other) for entry in stage.robot.effects] == [
        ("joint_order", "axis_1", "axis_2")
    ]
