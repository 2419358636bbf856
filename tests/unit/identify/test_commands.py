"""Command line of a diagnosis: limit of time, limit of material effects, progress."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

import armident
from armident.configs import ConfigError
from armident.daq.cli import application
from armident.daq.recording import write_recording
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import load_document
from tests.fixtures.arms import FAST, recording
from tests.fixtures.diagnoses import SPRING

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sprung(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the virtual EMPS with a hidden spring."""
    file = tmp_path_factory.mktemp("recordings") / "sprung.mcap"
    write_recording(recording("emps", "emps_1", 1, SPRING, period=FAST), file)
    return file


def diagnosed(file: Path, out: Path, *options: str) -> tuple[int, DiagnosisDocument, str]:
    """Exit code, document and stderr of ``armident diagnose``."""
    words = ["diagnose", str(file), "--out", str(out), *options]
    result = CliRunner().invoke(application(words), words)
    return result.exit_code, load_document(out / "diagnosis.json", DiagnosisDocument), result.stderr


def test_a_time_limit_ends_the_selection_and_is_reported_in_one_line(sprung: Path, tmp_path: Path) -> None:
    code, document, stderr = diagnosed(sprung, tmp_path, "--time-limit", "0.01")
    assert document.findings == []
    (line,) = [w for w in document.warnings if "time limit" in w]
    assert "0 complete comparisons and 0 findings" in line
    assert line.endswith("repeat with a larger --time-limit")
    assert stderr.count(line) == 1
    # The lack of fit is tested all the same, so that a gap is still an exit code of 4.
    assert document.verdict == "unexplained"
    assert code == 4


def test_a_time_limit_of_zero_is_refused(sprung: Path) -> None:
    with pytest.raises(ConfigError, match="--time-limit: expected a time greater than 0 s"):
        armident.diagnose(sprung, time_limit_s=0.0)


def test_effects_below_the_material_limit_are_listed_as_negligible(sprung: Path, tmp_path: Path) -> None:
    _, document, _ = diagnosed(sprung, tmp_path, "--material", "50")
    assert document.findings == []
    assert "joint_spring" in {entry.effect for entry in document.negligible}
    assert document.criteria is not None
    assert document.criteria["material_pct"] == 50.0


def test_a_large_time_limit_changes_nothing_and_the_progress_never_falls(sprung: Path) -> None:
    seen: list[tuple[str, float]] = []
    found = armident.diagnose(sprung, time_limit_s=600.0, progress=lambda stage, share: seen.append((stage, share)))
    assert [f.effect for f in found.document.findings] == ["joint_spring"]
    assert not [w for w in found.document.warnings if "time limit" in w]
    shares = [share for _, share in seen]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    # Each candidate of a comparison counts.
    assert len({share for stage, share in seen if stage == "comparison of effects"}) > 3
