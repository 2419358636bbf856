"""Measures what an installation brings: time, packages and megabytes of each set of extras, in clean environments.

Each one is used as a new user would: help, an example, an import, an identification, a virtual arm.

``python -m tests.tools.installed_size`` builds a wheel of the checkout and installs it by pip, so it needs network.
``--python`` takes another Python. ``--debian`` installs in an empty Debian 12 instead (debootstrap, as root).
``--demo`` also runs the demo from the wheel with all extras, in a folder of its own.
"""

import argparse
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
EXTRAS = ("", "identify", "identify,virtual", "all")
OF_THE_ENVIRONMENT = ("pip", "setuptools", "pkg_resources", "_distutils_hack", "distutils-precedence")
"""First words of what a new environment holds before anything is installed."""


def main(arguments: Sequence[str]) -> None:
    """Print a line per set of extras."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.installed_size", description=__doc__)
    parser.add_argument("--extras", nargs="*", default=list(EXTRAS), help="Sets of extras, each with commas.")
    parser.add_argument("--python", default=sys.executable, help="Python of the environments.")
    parser.add_argument("--wheel", type=Path, help="A wheel instead of one of the checkout.")
    parser.add_argument("--demo", action="store_true", help="Run the demo from the wheel, too.")
    parser.add_argument("--debian", action="store_true", help="Install in an empty Debian 12.")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheel = options.wheel.resolve() if options.wheel else build(options.python, folder / "wheel")
        root = empty_debian(folder / "debian") if options.debian else None
        if root is not None:
            shutil.copy(wheel, root)
            wheel = Path("/", wheel.name)
        for number, extras in enumerate(options.extras):
            system = System(root or Path("/"), f"/{number}" if root else str(folder / str(number)))
            before = os.times()
            system.install("python3" if root else options.python, f"{wheel}[{extras}]" if extras else str(wheel))
            after = os.times()
            took = f"{after.elapsed - before.elapsed:.0f} s, {after.children_user - before.children_user:.0f} s of CPU"
            print(f"armident[{extras}]: {took}, {size(system.packages)}", flush=True)
            system.use(extras)
        if options.demo:
            system = System(Path("/"), str(folder / "demo"))
            system.install(options.python, f"{wheel}[identify,virtual]")
            system.run(f"{system.folder}/bin/armident", "demo", "--out", str(folder / "out"))


def build(python: str, folder: Path) -> Path:
    """Return a wheel of the checkout. ``python``: Python for which it is built."""
    run(python, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(REPOSITORY), cwd=REPOSITORY)
    (wheel,) = folder.glob("*.whl")
    return wheel


@dataclass(frozen=True)
class System:
    """A folder with an environment of Python.

    ``root``: root folder of its system; ``folder``: absolute path there.
    """

    root: Path
    folder: str

    @property
    def outside(self) -> Path:
        """The folder on this machine."""
        return self.root / self.folder.lstrip("/")

    @property
    def packages(self) -> Path:
        """Folder site-packages of the environment on this machine."""
        (packages,) = (self.outside / "lib").glob("python3*/site-packages")
        return packages

    def run(self, *command: str) -> None:
        """Run a command of the system in the folder."""
        inside = () if self.root == Path("/") else ("chroot", str(self.root))
        run(*inside, "env", f"--chdir={self.folder}", *command, cwd=self.root)

    def install(self, python: str, requirement: str) -> None:
        """Install a wheel into a new environment of ``python``; the requirement has its extras in brackets."""
        self.outside.mkdir()
        self.run(python, "-m", "venv", ".")
        self.run("bin/python", "-m", "pip", "install", "-q", requirement)

    def use(self, extras: str) -> None:
        """Run what a new user runs, as far as the extras go: a table of an axis, its model, a virtual arm."""
        self.run("bin/armident", "--help")
        self.run("bin/armident", "example", "integration_test")
        (self.outside / "axis.csv").write_text(table_of_an_axis(), encoding="utf-8")
        self.run("bin/armident", "import", "axis.csv", "--config", "emps.yaml", "--out", "axis.mcap")
        self.run("bin/armident", "export", "axis.mcap", "--out", "again.csv")
        if extras:
            self.run("bin/armident", "identify", "axis.mcap", "--out", "model")
        if "virtual" in extras or extras == "all":
            config = "integration_test/picker.yaml"
            self.run("bin/armident", "robot", "--config", config, "--to-file", "picker.mcap")
            self.run("bin/armident", "check", "picker.mcap")


def table_of_an_axis() -> str:
    """Return the table of a linear axis of 95 kg with friction, 4 s at 1 kHz."""
    rows = ["t,q1,tau1"]
    for step in range(4000):
        t = step * 1e-3
        waves = [(0.04, 3.0), (0.015, 7.0), (0.004, 17.0)]
        q, qd, qdd = (sum(a * w**k * math.sin(w * t + k * math.pi / 2) for a, w in waves) for k in range(3))
        rows.append(f"{t:.3f},{q:.9f},{95 * qdd + 200 * qd + 20 * math.tanh(1e3 * qd):.6f}")
    return "\n".join(rows)


def empty_debian(root: Path) -> Path:
    """Make an empty Debian 12 with Python in a folder and return it; it gets the certificates of this machine."""
    run(
        "debootstrap",
        "--variant=minbase",
        "--include=python3-venv,ca-certificates,libgomp1",  # libgomp1: for Pinocchio
        "bookworm",
        str(root),
        cwd=root.parent,
    )
    for file in ("/etc/resolv.conf", "/etc/ssl/certs/ca-certificates.crt"):
        shutil.copy(file, root / file.lstrip("/"))
    return root


def size(packages: Path) -> str:
    """Return number and size of the packages, without what every environment holds.

    ``packages``: the folder site-packages.
    """
    present = (file for file in packages.rglob("*") if file.is_file() and not file.is_symlink())
    files = [file for file in present if not file.relative_to(packages).parts[0].startswith(OF_THE_ENVIRONMENT)]
    bytecode = sum(file.stat().st_size for file in files if file.suffix == ".pyc")
    total = sum(file.stat().st_size for file in files)
    count = sum(not path.name.startswith(OF_THE_ENVIRONMENT) for path in packages.glob("*.dist-info"))
    return f"{count} packages, {(total - bytecode) / 1e6:.0f} MB, and {bytecode / 1e6:.0f} MB of bytecode"


def run(*command: str, cwd: Path) -> None:
    """Run a command outside the checkout's import path. ``cwd``: its working directory."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run(command, cwd=cwd, env=environment | {"PIP_DISABLE_PIP_VERSION_CHECK": "1"}, check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
