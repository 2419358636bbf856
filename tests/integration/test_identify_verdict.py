"""Command line of `identify`: an impossible result exits with 3 in every method, a healthy one with 0."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from armident.daq.cli import application
from armident.daq.recording import Recording, write_recording
from armident.identify.estimators.methods import METHODS, Method, estimator
from tests.fixtures.arms import recording

pytestmark = pytest.mark.slow


USUAL: tuple[Method, ...] = ("idim-piv", "idim-ls", "cloe")
"""Methods of `make test`: with instruments, without, and one that needs a simulated loop."""


def turned(healthy: Recording) -> Recording:
    """The recording with the sign of every voltage changed in its scale."""
    samples = healthy.samples
    name = samples.named("voltage")
    assert name is not None
    field = samples.fields[name]
    wrong = replace(field, scale=tuple(-scale for scale in field.scale))
    fields = {**samples.fields, name: wrong}
    return replace(healthy, streams={**healthy.streams, "samples": replace(samples, fields=fields)})


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("verdict")
    healthy = recording("emps", "emps_excitation", 1)
    good, bad = folder / "good.mcap", folder / "bad.mcap"
    write_recording(healthy, good)
    write_recording(turned(healthy), bad)
    return good, bad


@pytest.mark.parametrize("method", [pytest.param(m, marks=[pytest.mark.nightly] * (m not in USUAL)) for m in METHODS])
def test_an_impossible_result_exits_with_3(files: tuple[Path, Path], tmp_path: Path, method: Method) -> None:
    words = ["identify", str(files[1]), "--method", method, "--out", str(tmp_path)]
    result = CliRunner().invoke(application(words), words)
    assert result.exit_code == 3, result.output
    if not estimator(method).measured:
        # Methods that need a simulated loop have no result at all, and one line that says so.
        (line,) = (line for line in result.stderr.splitlines() if "needs a simulated closed loop" in line)
        assert "which diverges" in line
        return
    lines = result.stdout.splitlines()
    assert lines[0] == "verdict: unusable"
    assert "converged" not in result.stdout
    assert lines[2].startswith("  Next: ")
    document = json.loads((tmp_path / "identification.json").read_text())
    assert document["verdict"] == "unusable"
    assert document["reasons"][0]["next_step"]
    assert 'class="verdict unusable"' in (tmp_path / "report.html").read_text()


def test_the_document_is_printed_with_the_same_exit_code(files: tuple[Path, Path], tmp_path: Path) -> None:
    words = ["identify", str(files[1]), "--method", "idim-ls", "--out", str(tmp_path), "--json"]
    result = CliRunner().invoke(application(words), words)
    assert result.exit_code == 3
    assert json.loads(result.stdout)["verdict"] == "unusable"


def test_a_healthy_result_exits_with_0_and_states_its_verdict_first(files: tuple[Path, Path], tmp_path: Path) -> None:
    words = ["identify", str(files[0]), "--method", "idim-ls", "--out", str(tmp_path)]
    result = CliRunner().invoke(application(words), words)
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("verdict: ")
    assert "unusable" not in result.stdout
