"""One answer of compare, reidentify and diagnose --baseline about the same two recordings, and watch's limits."""

from itertools import chain

import pytest

from armident.configs import load_robot
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.diagnosis.change_test import FALSE_ALARMS, compare
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.monitoring.recursive.estimator import RecursiveEstimator
from armident.identify.monitoring.recursive.recorded_blocks import blocks_of
from armident.identify.monitoring.recursive.report import BOTH_DIRECTIONS, document, joint_states
from armident.identify.monitoring.reidentify.summary import change_lines, finding_lines
from tests.fixtures.arms import FAST, hide, recording, tx40_baseline
from tests.fixtures.diagnoses import diagnosis

pytestmark = pytest.mark.slow

MOTION = "tx40_excitation"
CASES: dict[str, tuple[tuple[HiddenEffect, ...], set[tuple[str, str]]]] = {
    "nothing": ((), set()),
    "payload": ((hide("payload", "joint_6", mass=1.5, x=0.03, z=0.1),), {("payload", "joint_6")}),
    "worn": ((hide("friction_scale", "joint_3", factor=1.3),), {("friction_change", "joint_3")}),
    "worn in one direction": (
        (hide("asymmetric_viscous_friction", "joint_2", fva=0.2 * 5.5),),
        {("asymmetric_viscous_friction", "joint_2")},
    ),
    "gain": ((hide("drive_gain_error", "joint_2", error=0.1),), {("drive_gain_error", "joint_2")}),
    "spring": ((hide("joint_spring", "joint_2", stiffness=20.0),), {("joint_spring", "joint_2")}),
}
"""Hidden effects of each case, and the effects with their joints that every command names."""
NIGHTLY = ("payload", "worn", "gain", "spring")


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "case", [pytest.param(name, marks=pytest.mark.nightly) if name in NIGHTLY else name for name in CASES]
)
def test_every_command_gives_the_same_answer(case: str) -> None:
    hidden, expected = CASES[case]
    seed = 60 + list(CASES).index(case) if hidden else 1
    robot = load_robot("tx40")
    data = recording("tx40", MOTION, seed, *hidden, period=FAST)
    test = compare(tx40_baseline(), identify_recording(data, robot, check=None).document, FALSE_ALARMS, robot)
    assert test.drifted == bool(expected)
    assert {(found.change.effect.name, found.change.joints[0]) for found in test.explained} == expected
    diagnosed = diagnosis("tx40", MOTION, seed, *hidden, against_baseline=True).document
    assert {(finding.effect, finding.joint) for finding in diagnosed.findings} == expected
    assert diagnosed.verdict == ("explained" if expected else "no_gap")
    # The lines of reidentify: of the comparison, and of the diagnosis after it.
    lines = change_lines(test, robot)
    assert all(any(found.words in line for line in lines) for found in test.explained)
    assert len(finding_lines(diagnosed)) == len(expected)
    for finding, found in zip(diagnosed.findings, test.explained, strict=True):
        for name, value in finding.parameters.items():
            assert value == pytest.approx(found.parameters[name], abs=2 * found.deviations[name]), name


def test_watch_says_that_it_takes_the_mean_of_both_directions() -> None:
    robot = load_robot("tx40")
    hidden, _ = CASES["worn in one direction"]
    data = recording("tx40", MOTION, 63, *hidden, period=FAST)
    estimator = RecursiveEstimator(robot, tx40_baseline(), data.sample_rate_hz)
    list(map(estimator.handle, chain(blocks_of(data, 100_000))))
    found = estimator.result()
    assert "alarm" not in joint_states(found)
    assert document(found, robot)["friction_of"] == "mean of both directions"
    assert "mean of both directions" in BOTH_DIRECTIONS
