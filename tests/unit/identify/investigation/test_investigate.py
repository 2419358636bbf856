"""Investigations end to end: doors, budget, refusals, and what a kill leaves."""

import json
from pathlib import Path

import numpy as np
import pytest

import armident
from armident.configs import ConfigError, DataError, MotionStopped, Trajectory
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.documents.investigation import InvestigationDocument
from tests.fixtures.arms import recording

pytestmark = pytest.mark.slow

SCENARIO = "emps_dry_screw"


class Arm:
    """The EMPS with a dry screw, or healthy; counts its motions."""

    def __init__(self, scenario: str | None) -> None:
        self.scenario, self.asked = scenario, list[Trajectory]()

    def first(self) -> armident.Recording:
        return armident.simulate_recording("emps", "emps_excitation", scenario=self.scenario, seed=1)

    def __call__(self, trajectory: Trajectory) -> armident.Recording:
        self.asked.append(trajectory)
        return armident.simulate_recording("emps", trajectory, scenario=self.scenario, seed=10 + len(self.asked))


def test_a_healthy_arm_is_healthy_after_one_motion_that_confirms_it() -> None:
    arm = Arm(None)
    found = armident.investigate("emps", arm, arm.first())
    assert found.outcome == "healthy"
    assert [one.chosen.motion for one in found.document.rounds] == ["fast_excitation"]
    assert found.document.motion_s == pytest.approx(arm.asked[0].duration)


def test_a_question_waits_for_its_answer_and_a_kill_loses_nothing(tmp_path: Path) -> None:
    arm = Arm(None)
    waiting = armident.investigate("emps", None, arm.first(), out=tmp_path / "a")
    assert waiting.outcome == "running"
    assert waiting.pending is not None
    written = InvestigationDocument.model_validate_json((tmp_path / "a/investigation.json").read_text())
    assert written.rounds[0].recording is None
    assert (tmp_path / "a/motion_1.yaml").exists()
    # A process that was killed before the answer asks for the same motion again.
    again = armident.investigate(resume=tmp_path / "a")
    assert again.pending == waiting.pending
    done = armident.investigate(resume=tmp_path / "a", recordings=arm(waiting.pending))
    assert done.outcome == "healthy"
    assert len(done.document.rounds) == 1
    # An investigation that has ended stays as it is.
    assert armident.investigate(resume=tmp_path / "a").document == done.document


def test_a_refused_motion_is_noted_and_not_asked_again() -> None:
    arm = Arm(None)

    def refuses(trajectory: Trajectory) -> armident.Recording:
        arm.asked.append(trajectory)
        raise DataError("the guard stopped the arm")

    found = armident.investigate("emps", refuses, arm.first())
    assert [one.refused for one in found.document.rounds] == ["the guard stopped the arm"]
    assert len(arm.asked) == 1
    assert found.outcome == "cannot_tell"
    assert found.document.motion_s == 0.0


def test_a_first_motion_that_is_refused_ends_the_investigation(tmp_path: Path) -> None:
    """Without a recording there is no other motion to ask for."""
    asked: list[Trajectory] = []

    def refuses(trajectory: Trajectory) -> armident.Recording:
        asked.append(trajectory)
        if len(asked) > 1:
            pytest.fail("the same motion was asked for again")
        raise DataError("No module named 'lerobot'")

    found = armident.investigate("emps", refuses, out=tmp_path)
    assert found.outcome == "cannot_tell"
    assert "was refused: No module named 'lerobot'. Find the cause" in found.document.statement
    assert found.save(tmp_path)[1].exists()
    assert armident.investigate(resume=tmp_path, ask=refuses).document.statement == found.document.statement


def test_a_motion_that_was_stopped_is_the_last_one(tmp_path: Path) -> None:
    arm = Arm(None)

    def stops(trajectory: Trajectory) -> armident.Recording:
        arm.asked.append(trajectory)
        raise MotionStopped("guard: joint_1: following error (recording: a.mcap)")

    found = armident.investigate("emps", stops, arm.first(), out=tmp_path)
    assert found.outcome == "cannot_tell"
    assert "joint_1: following error (recording: a.mcap)" in found.document.statement
    assert [one.refused for one in found.document.rounds] == ["guard: joint_1: following error (recording: a.mcap)"]
    assert armident.investigate(resume=tmp_path, ask=arm).document == found.document
    assert len(arm.asked) == 1


def test_an_investigation_that_has_not_begun_is_begun_again(tmp_path: Path) -> None:
    """The first recording is too short for a diagnosis; another one is taken in the same folder."""
    t = np.arange(60) / 1000.0
    short = armident.Recording.from_arrays(t, 0.01 * np.sin(9.0 * t), 50.0 * np.cos(9.0 * t), robot="emps")
    with pytest.raises(DataError):
        armident.investigate("emps", None, short, out=tmp_path)
    again = armident.investigate("emps", None, Arm(None).first(), out=tmp_path)
    assert again.pending is not None
    with pytest.raises(ConfigError, match="has an investigation already"):
        armident.investigate("emps", None, Arm(None).first(), out=tmp_path)


def test_the_change_since_a_baseline_is_named_and_kept_for_a_later_run(tmp_path: Path) -> None:
    """Viscous friction a quarter larger: no effect is missing, and beside the baseline it has a name."""
    before = armident.identify(Arm(None).first(), "emps")
    drier = HiddenEffect(effect="friction_drift", joint="joint_1", parameters={"change": 0.25, "time_constant": 1e-6})
    now = recording("emps", "emps_excitation", 3, drier)
    found = armident.investigate("emps", None, now, baseline=before, out=tmp_path)
    assert found.outcome == "named"
    assert "friction" in found.document.statement
    assert (tmp_path / "baseline.json").exists()
    assert armident.investigate(resume=tmp_path).document == found.document
    with pytest.raises(DataError, match="the baseline is of robot 'emps', the arm is 'tx40'"):
        armident.investigate("tx40", None, (), baseline=before)


def test_the_budget_of_motion_ends_an_investigation_with_the_reason(tmp_path: Path) -> None:
    arm = Arm(None)
    found = armident.investigate("emps", arm, arm.first(), minutes=0.01)
    assert found.outcome == "cannot_tell"
    assert "--minutes" in found.document.statement
    assert arm.asked == []
    assert "--minutes" in found.report(tmp_path / "report.html").read_text(encoding="utf-8")


def test_recordings_of_the_past_answer_in_place_of_the_arm(tmp_path: Path) -> None:
    arm = Arm(None)
    later = armident.simulate_recording("emps", "emps_excitation", seed=5)
    later.save(tmp_path / "later.mcap")
    found = armident.investigate("emps", None, arm.first(), choose_from=tmp_path / "later.mcap")
    assert [one.chosen.motion for one in found.document.rounds] == ["recording"]
    assert found.outcome == "healthy"


@pytest.mark.nightly
def test_the_effects_of_a_dry_screw_are_named_after_four_motions() -> None:
    arm = Arm(SCENARIO)
    found = armident.investigate("emps", arm, arm.first(), experiments=4)
    names = {entry.effect for entry in found.robot.effects}
    assert {"presliding_friction", "stribeck_friction"} <= names
    gains = [one.chosen.expected_gain for one in found.document.rounds]
    assert all(gain is not None and gain > 0.0 for gain in gains)


def test_a_changed_recording_and_a_folder_in_use_are_refused(tmp_path: Path) -> None:
    arm = Arm(None)
    armident.investigate("emps", None, arm.first(), out=tmp_path)
    with pytest.raises(ConfigError, match="--continue"):
        armident.investigate("emps", None, arm.first(), out=tmp_path)
    document = json.loads((tmp_path / "investigation.json").read_text())
    document["recordings"][0]["sha256"] = "0" * 64
    (tmp_path / "investigation.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match="not the recording that the investigation used"):
        armident.investigate(resume=tmp_path)
    with pytest.raises(ConfigError, match=r"no investigation\.json"):
        armident.investigate(resume=tmp_path / "elsewhere")
