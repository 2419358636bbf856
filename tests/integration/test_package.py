"""Source distribution and wheel: complete, with one top-level name, and usable without extras."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import zipfile
from dataclasses import dataclass
from importlib.metadata import Distribution
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement

from armident.compiled import SHIPPED
from armident.configs import config_path
from armident.extras import EXTRAS
from tests.fixtures.processes import armident
from tests.fixtures.store import shared

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]  # the kernels are compiled once

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDERS = ("configs", "drivers", "daq", "identify", "virtual_robot", "tests")
COMMAND = ["-m", "armident.daq.cli", "bus-load", "--config", "tx40_cell.yaml"]
IMPORT = [
    "-c",
    "import armident.daq.capture.capture, armident.identify.monitoring.worker.worker, armident.virtual_robot.run",
]


@dataclass(frozen=True)
class Built:
    """Files of a release."""

    sdist: Path
    wheel: Path

    @property
    def names(self) -> list[str]:
        """Names of the files in the wheel."""
        with zipfile.ZipFile(self.wheel) as archive:
            return archive.namelist()


@shared
def _built(out: Path) -> Built:
    """Build a source distribution of a copy of the checkout, so that no earlier build is in it, and its wheel."""
    source = out / "source"
    for name in _git("ls-files", "--cached", "--others", "--exclude-standard"):
        if os.path.lexists(REPOSITORY / name):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPOSITORY / name, source / name, follow_symlinks=False)
    sdist = f"from setuptools import build_meta; build_meta.build_sdist({str(out)!r})"
    subprocess.run([sys.executable, "-c", sdist], cwd=source, check=True, timeout=120, capture_output=True)
    (archive,) = out.glob("*.tar.gz")
    command = ["pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run(
        [sys.executable, "-m", *command, "-w", str(out), str(archive)], env=environment, check=True, timeout=600
    )
    (wheel,) = out.glob("*.whl")
    return Built(archive, wheel)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """Source distribution and the wheel built from it, once for all test processes."""
    # The parent of the folders of all processes of this run.
    out = tmp_path_factory.getbasetemp()
    return _built((out.parent if "PYTEST_XDIST_WORKER" in os.environ else out) / "release")


@pytest.fixture(scope="module")
def wheel(built: Built) -> list[str]:
    """Names of the files in the wheel."""
    return built.names


@pytest.fixture(scope="module")
def base(built: Built, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Commands of an environment with the wheel and what it requires without extras, and nothing else."""
    folder = tmp_path_factory.mktemp("base")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True, timeout=60)
    (packages,) = (folder / "lib").glob("python3*/site-packages")
    with zipfile.ZipFile(built.wheel) as archive:
        archive.extractall(packages)
    (information,) = packages.glob("armident-*.dist-info")
    _link_requirements(Distribution.at(information), packages, set())
    command = folder / "bin" / "armident"
    command.write_text(f"#!{folder}/bin/python\nfrom armident.daq.cli import main\nmain()\n")
    command.chmod(0o755)
    return folder / "bin"


def _link_requirements(distribution: Distribution, packages: Path, done: set[str]) -> None:
    """Link the installed distributions that one requires, and those that these require."""
    for line in distribution.requires or []:
        requirement = Requirement(line)
        if requirement.name in done or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        done.add(requirement.name)
        required = Distribution.from_name(requirement.name)
        for top in {file.parts[0] for file in required.files or [] if file.parts[0] not in ("..", "__pycache__")}:
            if not (packages / top).exists():
                (packages / top).symlink_to(Path(str(required.locate_file(top))))
        _link_requirements(required, packages, done)


def _run(command: list[str], folder: Path) -> "subprocess.CompletedProcess[str]":
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.nightly
def test_a_source_distribution_holds_the_files_and_no_links(built: Built) -> None:
    with tarfile.open(built.sdist) as archive:
        members = archive.getmembers()
    assert not [member.name for member in members if member.issym() or member.islnk()]
    names = {member.name.partition("/")[2] for member in members}
    there = {name for name in _git("ls-files", *FOLDERS[:-1]) if (REPOSITORY / name).exists()}
    assert {f"src/armident/{name}" for name in there} <= names
    assert {"setup.py", "pyproject.toml", "LICENSE", "README.md"} <= names


@pytest.mark.nightly
def test_the_base_runs_what_a_capture_machine_needs(base: Path, tmp_path: Path) -> None:
    command = str(base / "armident")
    assert "capture" in _run([command, "--help"], tmp_path).stdout
    doctor = " ".join(_run([command, "doctor", "--config", "tx40_cell.yaml"], tmp_path).stdout.split())
    assert "ok installation" in doctor
    assert "kernels are compiled" in doctor
    phase = np.arange(200) * 1e-2
    rows = np.column_stack([0.1 * phase, 0.1 * np.sin(phase), np.cos(phase)])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="t,q1,tau1", comments="")
    for words in (
        ["import", "run.csv", "--config", "emps.yaml", "--out", "run.mcap"],
        ["recover", "run.mcap"],
        ["export", "run.mcap", "--out", "again.csv"],
        ["bus-load", "--config", "tx40_cell.yaml"],
    ):
        done = _run([command, *words], tmp_path)
        assert done.returncode == 0, done.stderr
    assert len((tmp_path / "again.csv").read_text().splitlines()) == 201
    done = _run([command, "identify", "run.mcap"], tmp_path)
    assert done.stderr == "armident: armident identify needs extra packages: pip install 'armident[identify]'\n"
    assert done.returncode == 2


@pytest.mark.nightly
def test_the_base_imports_nothing_of_the_extras(base: Path, tmp_path: Path) -> None:
    modules = sorted({module for names in EXTRAS.values() for module in names})
    script = f"import importlib.util\nprint([name for name in {modules!r} if importlib.util.find_spec(name)])"
    assert _run([str(base / "python"), "-c", script], tmp_path).stdout == "[]\n"


@pytest.mark.nightly
def test_the_wheel_holds_the_machine_code_of_every_kernel(built: Built, base: Path, tmp_path: Path) -> None:
    found = {name.rpartition("/")[2] for name in built.names if name.endswith(".code")}
    subprocess.run([sys.executable, "-m", "armident.compiled"], check=True, timeout=600)
    # Tests that ran in this checkout have left kernels of their own.
    assert found == {path.name for path in SHIPPED.iterdir() if not path.name.startswith("tests.")}
    script = str(REPOSITORY / "tests" / "tools" / "matched_streams.py")
    ours = _run([str(base / "python"), script], tmp_path)
    assert ours.returncode == 0, ours.stderr
    here = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True, timeout=120)
    assert ours.stdout == here.stdout
    (packages,) = base.parent.glob("lib/python3*/site-packages")
    assert {path.name for path in (packages / "armident" / "kernels").iterdir()} == found


@pytest.mark.vcan
@pytest.mark.nightly
def test_the_base_captures_six_axes_at_5_khz_without_a_loss(base: Path, vcan_bus: str, tmp_path: Path) -> None:
    session = tmp_path / "cell.yaml"
    session.write_text(config_path("tx40_cell.yaml").read_text().replace("vcan0", vcan_bus))
    robot = armident("robot", "--config", session)
    assert robot.stdout is not None
    assert "ready" in robot.stdout.readline()
    done = _run([str(base / "armident"), "capture", "--config", str(session), "--json"], tmp_path)
    robot.send_signal(signal.SIGTERM)
    robot.communicate(timeout=60)
    assert done.returncode == 0, done.stderr
    counters = json.loads(done.stdout)["counters"]
    assert counters["samples.rows"] == counters["samples.expected"] == counters["sync_sent"] > 40_000


@pytest.mark.nightly
def test_a_wheel_holds_armident_and_nothing_else_at_top_level(wheel: list[str]) -> None:
    top = {name.partition("/")[0] for name in wheel}
    assert {name for name in top if not name.endswith(".dist-info")} == {"armident"}


@pytest.mark.nightly
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
