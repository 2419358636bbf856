"""``armident characterise`` with the virtual arm as the program that moves the joint, and from its recordings."""

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from armident.daq.cli import application
from armident.identify.documents.characterisation import CharacterisationDocument
from armident.identify.documents.files import load_document

pytestmark = pytest.mark.slow

TWIN = f"{Path(sys.executable).with_name('armident')} robot --config emps.yaml --to-command"


def run(*words: str) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(application(list(words)), list(words))


@pytest.mark.nightly
def test_a_program_moves_the_joint_and_its_recordings_give_the_same_again(tmp_path: Path) -> None:
    out = tmp_path / "axis"
    words = ("characterise", "--joint", "joint_1", "--config", "emps.yaml", "--robot-command", TWIN, "--out", str(out))
    asked = run(*words)
    assert asked.exit_code == 2
    assert "--yes" in asked.stderr
    done = run(*words, "--yes")
    assert done.exit_code == 0, done.output
    document = load_document(out / "characterisation.json", CharacterisationDocument)
    assert document.friction is not None
    assert document.friction.points[-1].speed < 0.1 * 0.5 * 1.01
    assert document.friction.curve["fc"].value == pytest.approx(20.39, rel=0.05)
    assert "at constant speeds" in done.stderr
    report = (out / "report.html").read_text(encoding="utf-8")
    assert report.count("data:image/svg+xml") == 2
    answers = [str(file) for file in sorted(out.glob("answer_*.mcap"))]
    assert len(answers) == 2
    again = run("characterise", *answers, "--joint", "joint_1", "--json", "--out", str(tmp_path / "again"))
    assert again.exit_code == 0, again.output
    assert CharacterisationDocument.model_validate_json(again.stdout).friction == document.friction
    unknown = run("characterise", *answers, "--joint", "joint_9", "--out", str(tmp_path / "again"))
    assert unknown.exit_code == 2
    assert "it has joint_1" in unknown.stderr
