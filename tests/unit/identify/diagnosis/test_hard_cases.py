"""Single cases of the shipped suite in which a wrong answer lies near."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from armident.identify.documents.files import to_json
from tests.evaluation.cases import all_cases
from tests.evaluation.plants.two_robots import simulate
from tests.evaluation.schema import load_suite
from tests.evaluation.tasks import DiagnosisTask, diagnose_file

pytestmark = [pytest.mark.slow, pytest.mark.nightly, pytest.mark.timeout(600)]
MISSED = pytest.mark.xfail(strict=True, reason="the stepwise selection misses it: docs/diagnosis.md, What is missed")
"""Promises of the former search that the selection does not keep yet."""


def diagnosed(name: str, folder: Path) -> tuple[dict[str, Any], dict[str, float]]:
    """Diagnosis of a case, with the model that the suite would give it, and what is hidden in it first."""
    (case,) = (case for case in all_cases(load_suite()) if case.name == name)
    file = folder / "case.mcap"
    request = {
        "robot": case.config,
        "trajectory": case.trajectory,
        "repeats": case.repeats,
        "period": case.period,
        "seed": case.seed,
        "effects": [asdict(part) for part in case.parts],
        "out": str(file),
    }
    hidden = simulate(request)["truth"][0]
    joints = tuple(part.joint for part in case.parts) if case.leave_out else ()
    document = diagnose_file(DiagnosisTask(file, case.config, case.leave_out, joints)).document
    return json.loads(to_json(document)), hidden


def test_a_late_torque_of_joint_2_is_found_in_the_loop_that_it_makes(tmp_path: Path) -> None:
    """The simulated loop without the delay speaks against the delay."""
    told, hidden = diagnosed("effect time_delay joint_2 obvious tx40 run 1", tmp_path)
    (found,) = told["findings"]
    assert (found["effect"], found["joint"]) == ("time_delay", "joint_2")
    assert abs(found["parameters"]["delay"] - hidden["delay"]) < 3.0 * found["evidence"]["std"]["delay"]
    errors = told["gap"]["validation"]
    assert errors["after"]["all"] < errors["before"]["all"]
    assert told["verdict"] == "explained"


@MISSED
@pytest.mark.parametrize("run", [3, 5])
def test_a_late_torque_is_no_friction_that_yields_where_noise_hides_what_the_loop_gains(
    run: int, tmp_path: Path
) -> None:
    """The corrected torque has more error at measured signals, where it is in phase with the encoder noise."""
    told, hidden = diagnosed(f"effect time_delay joint_3 typical tx40 run {run}", tmp_path)
    found = told["findings"][0]
    assert (found["effect"], found["joint"]) == ("time_delay", "joint_3")
    assert abs(found["parameters"]["delay"] - hidden["delay"]) < 3.0 * found["evidence"]["std"]["delay"]


@MISSED
@pytest.mark.parametrize("run", [1, 4])
def test_a_link_that_swings_beyond_the_bandwidth_is_found_where_measured_positions_bring_more_noise(
    run: int, tmp_path: Path
) -> None:
    """Fourth derivatives enlarge the error at measured signals, and the loop changes the torque little."""
    told, hidden = diagnosed(f"effect joint_elasticity joint_1 typical emps run {run}", tmp_path)
    (found,) = told["findings"]
    assert (found["effect"], told["verdict"]) == ("joint_elasticity", "explained")
    assert 0.5 < found["parameters"]["compliance"] / hidden["compliance"] < 2.0
    errors = told["gap"]["validation"]
    assert errors["after"]["all"] > errors["before"]["all"]  # what makes it hard
    # Without derivative noise the gap closes, and the document says so.
    assert found["gap_after"] < 0.97 * found["gap_before"]
    assert found["evidence"]["gap_at_measured_motion"] > found["gap_after"]


@MISSED
@pytest.mark.parametrize("run", [2, 5])
def test_a_link_on_a_spring_is_found_at_its_own_joint_although_the_one_before_shows_more_of_it(
    run: int, tmp_path: Path
) -> None:
    """At simulated signals of a rigid arm it explains less than a hundredth of its own joint's error.

    In the second of the two runs it explains so little of any joint; in the loop that it makes it explains enough, once
    its damping has been sought there.
    """
    told, hidden = diagnosed(f"effect joint_elasticity joint_3 typical tx40 run {run}", tmp_path)
    (found,) = told["findings"]
    assert (found["effect"], found["joint"], told["verdict"]) == ("joint_elasticity", "joint_3", "explained")
    off = found["parameters"]["compliance"] - hidden["compliance"]
    assert abs(off) < 3.0 * found["evidence"]["std"]["compliance"]
    errors = told["gap"]["validation"]
    # Both joints: the link's swing turns the reaction on the joint before it, too.
    for joint in ("joint_2", "joint_3"):
        assert errors["after"]["by_joint"][joint] < 0.93 * errors["before"]["by_joint"][joint]


@pytest.mark.parametrize("strength", ["obvious tx40 run 2", "typical tx40 run 2"])
def test_a_coupling_has_to_account_for_both_of_its_joints(strength: str, tmp_path: Path) -> None:
    """Crosstalk of currents, which the catalogue does not have, is no coupling of friction.

    Where it is weak the coupling takes all of it; but the torque of the other joint explains it far better. A term
    without a name claims no cause.
    """
    told, _ = diagnosed(f"outside current_crosstalk joint_4+joint_3 {strength}", tmp_path)
    assert all(found["confidence"] < 0.5 for found in told["findings"] if found["effect"] != "unnamed")
    assert "joint_4" in {part["joint"] for part in (*told["unexplained"], *told["findings"])}
    assert told["verdict"] == "unexplained"


@pytest.mark.parametrize(
    "case",
    [
        "outside stick_events joint_2 obvious tx40 run 4",
        "outside stick_events joint_1 typical emps run 1",
    ],
)
@MISSED
def test_friction_for_moments_at_random_times_is_no_noise(case: str, tmp_path: Path) -> None:
    """Dirt in the gear, which the catalogue does not have, adds a small part to the power of the residual."""
    told, hidden = diagnosed(case, tmp_path)
    assert hidden == {}
    assert told["verdict"] == "unexplained"
    (rest,) = told["unexplained"]
    assert rest["joint"] == case.split()[2]


@MISSED
def test_ripple_among_the_frequencies_of_the_motion_is_a_line(tmp_path: Path) -> None:
    """Mains of 16.7 Hz under a motion of 20 Hz: a tenth of the residual's power, at a single frequency."""
    told, _ = diagnosed("outside mains_ripple joint_1 typical emps run 2", tmp_path)
    (rest,) = told["unexplained"]
    assert rest["varies_with"] == "frequency"
    assert "16.7 Hz" in rest["hint"]


@MISSED
@pytest.mark.parametrize("strength", ["obvious emps run 3", "typical emps run 4"])
def test_a_spring_is_found_beside_friction_that_is_far_stronger(strength: str, tmp_path: Path) -> None:
    """A bristle carries the Coulomb friction of a joint with Stribeck friction, too, or reversals hide the spring."""
    told, _ = diagnosed(f"pair joint_spring joint_1 and stribeck_friction joint_1 {strength}", tmp_path)
    assert {found["effect"] for found in told["findings"]} == {"joint_spring", "stribeck_friction"}
    assert all(found["confidence"] > 0.9 for found in told["findings"])
    assert told["verdict"] == "explained"
    assert told["gap"]["validation"]["after"]["all"] < 0.5


@MISSED
def test_friction_far_from_where_it_seems_is_found_where_the_arm_sticks_and_its_model_does_not(tmp_path: Path) -> None:
    """Four fifths of the torque are error before; steps downhill from the first look end in a hollow beside it.

    The simulated loop without the friction moves so differently that the friction explains nothing in it.
    """
    told, hidden = diagnosed("pair joint_spring joint_1 and stribeck_friction joint_1 obvious emps run 1", tmp_path)
    found = {f["effect"]: f for f in told["findings"]}
    assert set(found) == {"joint_spring", "stribeck_friction"}
    assert told["verdict"] == "explained"
    spring = found["joint_spring"]
    assert abs(spring["parameters"]["ks"] - hidden["ks"]) < 3.0 * spring["evidence"]["std"]["ks"]
    errors = told["gap"]["validation"]
    assert errors["before"]["all"] > 70.0
    assert errors["after"]["all"] < 1.0


@MISSED
def test_friction_of_a_joint_that_moves_the_same_without_it_is_looked_for_in_its_own_loop(tmp_path: Path) -> None:
    """With it the simulated wrist follows the arm neither better nor worse; the torque of its reversals differs."""
    case = "pair asymmetric_viscous_friction joint_2 and stribeck_friction joint_5 typical tx40 run 5"
    told, _ = diagnosed(case, tmp_path)
    assert {(f["effect"], f["joint"]) for f in told["findings"]} == {
        ("asymmetric_viscous_friction", "joint_2"),
        ("stribeck_friction", "joint_5"),
    }
    assert told["verdict"] == "explained"


@MISSED
def test_what_shows_at_no_joint_alone_shows_at_all_of_them_together(tmp_path: Path) -> None:
    """A base that shakes: a thousandth by chance is no alarm at the worst of six joints, but is one over all."""
    told, _ = diagnosed("outside base_vibration joint_1 typical tx40 run 5", tmp_path)
    assert told["verdict"] == "unexplained"
    assert [rest["varies_with"] for rest in told["unexplained"]] == ["motion"]


@pytest.mark.parametrize("run", [pytest.param(3, marks=MISSED), 4])
def test_a_saturated_drive_is_found_where_a_stiff_loop_moves_the_same_without_it(run: int, tmp_path: Path) -> None:
    """Simulated and measured velocity differ by a ten-thousandth either way; the torques by five times."""
    told, hidden = diagnosed(f"effect drive_gain_saturation joint_1 obvious emps run {run}", tmp_path)
    (found,) = told["findings"]
    assert (found["effect"], told["verdict"]) == ("drive_gain_saturation", "explained")
    assert abs(found["parameters"]["gain_loss"] - hidden["gain_loss"]) < 3.0 * found["evidence"]["std"]["gain_loss"]


@MISSED
@pytest.mark.parametrize("joint", ["joint_3", "joint_5"])
def test_a_joint_that_yields_before_it_slides_is_found_where_the_rigid_loop_reverses_at_other_instants(
    joint: str, tmp_path: Path
) -> None:
    """Columns at the motion of a loop without the bristle have a fifteenth of those at the measured one in common."""
    told, _ = diagnosed(f"effect presliding_friction {joint} typical tx40 run 2", tmp_path)
    (found,) = told["findings"]
    assert (found["effect"], found["joint"], told["verdict"]) == ("presliding_friction", joint, "explained")


@pytest.mark.parametrize(
    "case", ["friction_drift joint_5 typical tx40 run 4", "joint_spring joint_4 typical tx40 run 1"]
)
def test_noise_of_the_measured_positions_does_not_speak_against_a_finding(case: str, tmp_path: Path) -> None:
    """Three percent less at simulated signals; at measured ones the errors of the other joints change by as much."""
    told, _ = diagnosed(f"effect {case}", tmp_path)
    (found,) = told["findings"]
    assert [found["effect"], found["joint"]] == case.split()[:2]


def test_a_rotor_that_is_missing_is_no_wrong_sign(tmp_path: Path) -> None:
    """Both signs of the wrist's roll exchanged leave a little less than the model with the rotor."""
    told, _ = diagnosed("effect rotor_inertia joint_6 obvious tx40 run 5", tmp_path)
    (found,) = told["findings"]
    assert (found["effect"], found["joint"]) == ("rotor_inertia", "joint_6")
