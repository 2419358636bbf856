"""``armident investigate`` with the virtual arm as the program that moves the robot, and by hand."""

import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import armident
from armident.configs import load_trajectory
from armident.daq.cli import application
from armident.identify.documents.files import load_document
from armident.identify.documents.investigation import InvestigationDocument

pytestmark = pytest.mark.slow

RATE_HZ = 1000.0
TWIN = f"{Path(sys.executable).with_name('armident')} robot --config emps.yaml --to-command"


def run(*words: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(application(list(words)), list(words))


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recordings") / "first.mcap"
    armident.simulate_recording("emps", "emps_excitation", seed=1, period=1.0 / RATE_HZ).save(file)
    return file


def test_the_twin_plays_a_table_of_references_at_its_rate_with_noise_of_its_own(tmp_path: Path) -> None:
    q = load_trajectory("trajectories/emps_excitation.yaml").sample(1.0 / RATE_HZ)[:4000]
    taus = []
    for name, table in (("a", q), ("b", q[: len(q) // 2])):
        t = np.arange(len(table)) / RATE_HZ
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([t, table]), delimiter=",", header="t,qr1", comments="")
        words = ("robot", "--config", "emps.yaml", "--to-command", str(tmp_path / f"{name}.csv"), str(tmp_path / name))
        assert run(*words).exit_code == 0
        made = armident.read_recording(tmp_path / f"{name}.mcap")
        assert made.sample_rate_hz == pytest.approx(RATE_HZ)
        taus.append(made.samples.si(next(f for f in made.samples.fields if f not in ("position", "status"))))
    common = slice(400, len(taus[1]) - 400)
    assert not np.array_equal(taus[0][common], taus[1][common])
    beyond = np.column_stack([np.arange(len(q)) / RATE_HZ, 10.0 * q])
    np.savetxt(tmp_path / "c.csv", beyond, delimiter=",", header="t,qr1", comments="")
    refused = run("robot", "--config", "emps.yaml", "--to-command", str(tmp_path / "c.csv"), str(tmp_path / "c"))
    assert refused.exit_code == 2
    assert "reference: joint_1 moves over" in refused.stderr


def test_a_program_moves_the_robot_until_the_arm_is_healthy(first: Path, tmp_path: Path) -> None:
    out = tmp_path / "why"
    done = run("investigate", str(first), "--yes", "--robot-command", TWIN, "--out", str(out))
    assert done.exit_code == 0, done.output
    document = load_document(out / "investigation.json", InvestigationDocument)
    assert document.outcome == "healthy"
    assert document.rounds[0].recording is not None
    table = np.loadtxt(out / "reference_1.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(np.diff(table[:, 0]), 1.0 / RATE_HZ, atol=1e-9)
    assert "all joints at once" in (out / "report.html").read_text(encoding="utf-8")
    model = (out / "model.yaml").read_text(encoding="utf-8")
    # Nothing is asked or lost when an investigation that has ended is continued.
    (out / "model.yaml").write_text(model.replace("effects: []", "effects: [{effect: joint_spring, joint: joint_1}]"))
    assert run("investigate", "--continue", str(out)).exit_code == 0
    assert "joint_spring" in (out / "model.yaml").read_text(encoding="utf-8")


def test_a_program_that_fails_refuses_the_motion_with_what_it_printed(first: Path, tmp_path: Path) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho the brake is closed >&2\nexit 3\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    done = run("investigate", str(first), "--yes", "--robot-command", str(program), "--out", str(tmp_path / "why"))
    assert done.exit_code == 4
    document = load_document(tmp_path / "why/investigation.json", InvestigationDocument)
    assert document.rounds[0].refused == "the program ended with exit code 3: the brake is closed"
    assert "the brake is closed" in done.stdout


@pytest.mark.nightly
def test_by_hand_it_says_what_to_record_and_goes_on_with_it(first: Path, tmp_path: Path) -> None:
    out = tmp_path / "why"
    done = run("investigate", str(first), "--by-hand", "--out", str(out))
    assert done.exit_code == 4
    assert f"--continue {out} RECORDING" in done.stdout
    answer = armident.simulate_recording("emps", out / "motion_1.yaml", seed=4, period=1.0 / RATE_HZ)
    answer.save(tmp_path / "answer.mcap")
    done = run("investigate", "--continue", str(out), str(tmp_path / "answer.mcap"))
    assert done.exit_code == 0, done.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give one way to ask"),
        (["--by-hand", "--robot-command", "x"], "give one way to ask"),
        (["--by-hand", "--continue", "a", "--out", "b"], "leave --config, --baseline and --out out"),
        (["--config", "emps_cell.yaml"], "add --yes"),
        (["--config", "emps_cell.yaml", "--by-hand"], "a robot file is wanted"),
        (["--config", "tx40_replay.yaml", "--yes"], "tx40_replay.yaml: setpoints: missing"),
        (["--config", "emps.yaml", "--yes"], "give one way to ask: --config with a session"),
        (["--robot-command", TWIN], "add --yes"),
        (["--yes", "--robot-command", "./no_such_program"], "--robot-command ./no_such_program: no such program"),
        (["--replay", "/nowhere"], "no recordings"),
    ],
)
def test_a_wrong_request_is_refused_in_one_line(first: Path, tmp_path: Path, words: list[str], message: str) -> None:
    given = words if "--out" in words else [*words, "--out", str(tmp_path / "why")]
    failed = run("investigate", str(first), *given)
    assert failed.exit_code == 2
    assert message in " ".join(failed.stderr.split())
