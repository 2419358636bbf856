"""The plug-in for pytest in another repository: its worked example, and tests of the fixtures, on a virtual bus."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLE = REPOSITORY / "configs" / "examples" / "integration_test"

pytestmark = pytest.mark.vcan

FIXTURES = """
import pytest
from armident.configs import ArmidentError


def test_fixtures(virtual_bus, virtual_arm, capture, tmp_path):
    arm = virtual_arm("emps_cell.yaml", noise=0.0, scenario={"drives": {"joint_1": {"oddities": ["no1019"]}}})
    assert arm.bus == virtual_bus
    assert arm.session.cell.startswith("emps_test_")
    assert arm.truth["m1"] == pytest.approx(95.1, abs=0.1)
    with pytest.raises(ArmidentError, match="an arm is on this bus already"):
        virtual_arm("emps_cell.yaml")
    recording = capture(arm, duration_s=1.0)
    assert recording.robot.name == "emps"
    assert recording.path.is_relative_to(tmp_path)
    arm.stop()
    with pytest.raises(ArmidentError, match="did not start.*no effect.*is not an effect of the virtual arm"):
        virtual_arm("emps_cell.yaml", scenario={"effects": [{"effect": "no_effect", "joint": "joint_1"}]})
    with pytest.raises(ArmidentError, match="capture: "):
        capture(arm, duration_s=1.0)
"""


def run_pytest(folder: Path, *words: str) -> "subprocess.CompletedProcess[str]":
    """Run pytest as the owner of another repository does."""
    command = [sys.executable, "-m", "pytest", "-p", "armident.testing", "-rA", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.nightly
def test_the_worked_example_runs_in_another_repository(tmp_path: Path) -> None:
    folder = tmp_path / "other_repository"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    done = run_pytest(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed" in done.stdout


def test_the_fixtures_start_arms_and_say_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "test_fixtures.py").write_text(FIXTURES.replace("no effect.*", ""))
    done = run_pytest(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
