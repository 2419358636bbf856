"""The distribution installs one top-level name, and nothing in the working directory changes what it imports."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDERS = ("configs", "drivers", "daq", "identify", "virtual_robot", "tests")
COMMAND = ["-m", "armident.daq.cli", "bus-load", "--config", "tx40_cell.yaml"]
IMPORT = ["-c", "import armident.daq.capture.capture, armident.identify.monitoring.worker, armident.virtual_robot.run"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Names of the files in a wheel, built from a copy of the checkout so that no earlier build is in it."""
    out, source = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("source")
    for name in _git("ls-files", "--cached", "--others", "--exclude-standard"):
        if os.path.lexists(REPOSITORY / name):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPOSITORY / name, source / name, follow_symlinks=False)
    command = ["pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    subprocess.run([sys.executable, "-m", *command, "-w", str(out), str(source)], check=True, timeout=240)
    (built,) = out.glob("*.whl")
    with zipfile.ZipFile(built) as archive:
        return archive.namelist()


def test_a_wheel_holds_armident_and_nothing_else_at_top_level(wheel: list[str]) -> None:
    top = {name.partition("/")[0] for name in wheel}
    assert {name for name in top if not name.endswith(".dist-info")} == {"armident"}


def test_a_wheel_holds_every_file_that_the_packages_need(wheel: list[str]) -> None:
    there = [name for name in _git("ls-files", *FOLDERS[:-1]) if (REPOSITORY / name).exists()]
    missing = {f"armident/{name}" for name in there} - set(wheel)
    assert not missing
    assert "armident/py.typed" in wheel


@pytest.mark.parametrize(
    ("words", "python_path"),
    [(COMMAND, "."), (COMMAND, None), (IMPORT, ".")],
    ids=["command with PYTHONPATH=.", "command", "import with PYTHONPATH=."],
)
def test_folders_of_our_names_in_the_working_directory_break_nothing(
    words: list[str], python_path: str | None, tmp_path: Path
) -> None:
    for name in FOLDERS:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('imported from the working directory')\n")
    (tmp_path / "notebook.ipynb").write_text("{}")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if python_path is not None:
        environment["PYTHONPATH"] = python_path
    done = subprocess.run(
        [sys.executable, *words],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def _git(*words: str) -> list[str]:
    return subprocess.check_output(["git", *words], cwd=REPOSITORY, text=True).splitlines()
