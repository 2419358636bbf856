"""The example notebooks of the documentation run on the measured data, where these are present."""

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLES = ("emps", "tx40", "kuka_lwr4", "panda")
"""Names of the notebooks."""
LONGEST_CELL_S = 900


@pytest.mark.nightly
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name: str, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    if not (shared_data / name).is_dir():
        pytest.skip(f"no {name} folder in the measured data")
    monkeypatch.setenv("ARMIDENT_SHARED_DATA", str(shared_data))
    notebook = nbformat.read(REPOSITORY / "docs" / "examples" / f"{name}.ipynb", 4)
    client = nbclient.NotebookClient(
        notebook, timeout=LONGEST_CELL_S, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert outputs
    assert all(output.output_type != "error" for output in outputs)


def test_every_example_is_tested() -> None:
    found = {path.stem for path in (REPOSITORY / "docs" / "examples").glob("*.ipynb")}
    assert found == set(EXAMPLES)


def test_examples_hold_no_outputs() -> None:
    """No measured data of others are in the repository."""
    nbformat = pytest.importorskip("nbformat")
    for path in (REPOSITORY / "docs" / "examples").glob("*.ipynb"):
        cells = nbformat.read(path, 4).cells
        assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in cells), path
