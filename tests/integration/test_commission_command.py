"""``armident commission`` with the virtual arm as the program that moves the robot."""

import stat
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from armident.daq.cli import application
from armident.identify.documents.commissioning import CommissioningDocument
from armident.identify.documents.files import load_document

pytestmark = pytest.mark.slow

TWIN = f"{Path(sys.executable).with_name('armident')} robot --config emps.yaml --to-command"


def run(*words: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(application(list(words)), list(words))


@pytest.mark.nightly
def test_a_program_moves_a_new_arm_to_a_trusted_model(tmp_path: Path) -> None:
    out = tmp_path / "first_day"
    done = run("commission", "emps.yaml", "--yes", "--robot-command", TWIN, "--out", str(out))
    assert done.exit_code == 0, done.output
    document = load_document(out / "commissioning.json", CommissioningDocument)
    assert document.outcome == "trusted"
    # What moves is said with its duration before it moves, and every stage has a line.
    assert f"joint_1 slowly to both sides and back; the other joints rest, {document.motions[0].duration_s:.1f} s" in (
        done.stderr
    )
    assert all(f"{name}: {sentence}" in done.stderr for name, sentence in document.stages.items())
    assert (out / "model/identification.json").exists()
    assert "full excitation" in (out / "report.html").read_text(encoding="utf-8")
    again = run("commission", "emps.yaml", "--yes", "--robot-command", TWIN, "--continue", str(out))
    assert again.exit_code == 0, again.output
    assert load_document(out / "commissioning.json", CommissioningDocument) == document


def test_a_program_that_refuses_a_motion_stops_with_what_it_printed(tmp_path: Path) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho the brake is closed >&2\nexit 3\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    done = run("commission", "emps.yaml", "--yes", "--robot-command", str(program), "--out", str(tmp_path / "out"))
    assert done.exit_code == 3, done.output
    document = load_document(tmp_path / "out/commissioning.json", CommissioningDocument)
    assert document.outcome == "stopped"
    assert document.motions == []
    assert "the brake is closed" in document.stages["small motions"]
    assert "Next: find the cause" in done.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["emps.yaml"], "is no session; add --robot-command PROGRAM"),
        (["emps.yaml", "--robot-command", TWIN], "add --yes"),
        (["emps.yaml", "--yes", "--robot-command", "./no_such_program"], "./no_such_program: no such program"),
        (["emps.yaml", "--yes", "--robot-command", TWIN, "--continue", "a", "--out", "b"], "leave --out out"),
    ],
)
def test_a_wrong_request_is_refused_in_one_line(words: list[str], message: str) -> None:
    failed = run("commission", *words)
    assert failed.exit_code == 2
    assert message in " ".join(failed.stderr.split())
