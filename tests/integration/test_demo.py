"""The demo: the real processes from beginning to end, and one clear line if one of them fails."""

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from armident.configs import ArmidentError, load_robot
from armident.identify.robot.arm import ArmModel
from armident.virtual_robot.demo import DemoOptions, _running, worn
from armident.virtual_robot.demo_report import true_values
from armident.virtual_robot.drawn_parameters import torque_scale
from armident.virtual_robot.inertias import base_parameters, plant_parameters
from armident.virtual_robot.plant import Plant
from armident.virtual_robot.twin import ParameterChoice, load_twin

LONGEST_S = 280
REPOSITORY = Path(__file__).resolve().parents[2]
PICKER = REPOSITORY / "configs" / "examples" / "integration_test" / "picker.yaml"


@pytest.mark.slow
def test_a_process_that_fails_is_named_with_the_end_of_what_it_printed(tmp_path: Path) -> None:
    with (
        _running("capture", ["capture", "--config", "no_such_cell.yaml"], tmp_path) as capture,
        pytest.raises(
            ArmidentError, match=r"capture ended with exit code 2 \(log: .*capture\.log\).*no_such_cell\.yaml"
        ),
    ):
        capture.wait(60.0)


@pytest.mark.slow
def test_a_process_that_ends_before_it_is_ready_is_an_error_at_once(tmp_path: Path) -> None:
    begin = time.monotonic()
    with (
        pytest.raises(ArmidentError, match="capture ended with exit code 2 before it printed 'ready'"),
        _running("capture", ["capture", "--config", "no_such_cell.yaml"], tmp_path, "ready"),
    ):
        pytest.fail("it was never ready")
    assert time.monotonic() - begin < 60.0


@pytest.mark.slow
def test_processes_do_not_outlive_the_demo(tmp_path: Path) -> None:
    with _running("worker", ["worker", "--config", "tx40_replay.yaml"], tmp_path, "worker: ready") as worker:
        process = worker.process
        assert process.poll() is None
    assert process.poll() == 0


@pytest.mark.vcan
@pytest.mark.slow
@pytest.mark.timeout(LONGEST_S + 20)
def test_the_first_part_ends_with_a_table_the_next_commands_and_a_report_without_warnings(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "armident.daq.cli", "demo", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    last = done.stdout.strip().splitlines()[-1]
    report = Path(last.removeprefix("report: "))
    assert "identified dynamic model" in report.read_text(encoding="utf-8")
    distances = [float(v) for v in re.findall(r"(-?\d+\.\d) std$", done.stdout, re.MULTILINE)]
    assert len(distances) >= 20
    # Of some 25 parameters none may be further from the plant's own than five of its standard deviations.
    assert max(abs(d) for d in distances) < 5.0
    assert "armident identify my_robot.mcap" in done.stdout
    noise = re.compile("warning|fontconfig|matplotlib", re.IGNORECASE)
    assert [line for line in done.stderr.splitlines() if noise.search(line)] == []


def test_the_worn_bearing_is_in_the_joint_with_most_viscous_friction() -> None:
    twin = load_twin(PICKER)
    (hidden,) = worn(twin).effects
    Plant(twin.robot, twin.parameters.rest, worn(twin), twin.parameters)
    scale = torque_scale(twin.robot, twin.parameters.standard).torque
    share = {
        joint.name: twin.parameters.standard[f"fv{j}"] * joint.limits.velocity / scale[j - 1]
        for j, joint in enumerate(twin.robot.joints, start=1)
    }
    assert hidden.joint == max(share, key=lambda name: share[name])


def test_true_values_of_regrouped_parameters_follow_their_formulas() -> None:
    robot = load_robot("tx40")
    truth = plant_parameters(robot)
    model = ArmModel.from_config(robot)
    parameters = [{"name": name, "formula": model.base.formulas[name]} for name in model.base.names]
    expected = base_parameters(truth)
    found = true_values({"parameters": [*parameters, {"name": "spring2", "formula": None}]}, truth, robot)
    assert set(found) == set(model.base.names)
    assert found == pytest.approx({name: expected.get(name, truth.get(name)) for name in found})


def test_options_of_the_demo_reach_the_guest(tmp_path: Path) -> None:
    choice = ParameterChoice(seed=3, draw_masses=True)
    words = DemoOptions(tmp_path / "out", quick=True, config=PICKER, scenario=Path("worn"), choice=choice).words()
    assert " ".join(words) == (
        f"--out {tmp_path / 'out'} --config {PICKER} --scenario worn --arm-seed 3 --quick --draw-masses"
    )


@pytest.mark.vcan
@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(LONGEST_S + 20)
def test_a_configured_arm_is_identified_and_asked_and_its_hidden_effect_found(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "armident.daq.cli", "demo", "--config", str(PICKER), "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    distances = [float(v) for v in re.findall(r"(-?\d+\.\d) std$", done.stdout, re.MULTILINE)]
    assert len(distances) >= 12
    assert max(abs(d) for d in distances) < 5.0
    assert "hidden: asymmetric viscous friction in lift\n" in done.stdout
    assert "asymmetric_viscous_friction in lift: " in done.stdout
    assert "Then asymmetric viscous friction in lift was hidden" in (tmp_path / "report.html").read_text("utf-8")
