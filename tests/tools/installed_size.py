"""Measures what an installation brings: time, packages and megabytes of each set of extras, in clean environments.

``python -m tests.tools.installed_size`` builds a wheel of the checkout and installs it by pip, so it needs network.
``--python`` takes another Python. ``--debian`` installs in an empty Debian 12 instead (debootstrap, as root).
``--demo`` also runs the demo from the wheel with all extras, in a folder of its own.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
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
        wheel = options.wheel or build(options.python, folder / "wheel")
        root = empty_debian(folder / "debian") if options.debian else None
        if root is not None:
            shutil.copy(wheel, root)
            wheel = Path("/", wheel.name)
        for number, extras in enumerate(options.extras):
            begin = time.monotonic()
            requirement = f"{wheel}[{extras}]" if extras else str(wheel)
            if root is None:
                packages = install(options.python, folder / str(number), requirement)
            else:
                packages = install_in(root, f"/{number}", requirement)
            seconds = time.monotonic() - begin
            print(f"armident[{extras}]: {seconds:.0f} s, {size(packages)}", flush=True)
        if options.demo:
            install(options.python, folder / "demo", f"{wheel}[identify,virtual]")
            run(str(folder / "demo/bin/armident"), "demo", "--out", str(folder / "out"), cwd=folder)


def build(python: str, folder: Path) -> Path:
    """Return a wheel of the checkout. ``python``: Python for which it is built."""
    run(python, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(REPOSITORY), cwd=REPOSITORY)
    (wheel,) = folder.glob("*.whl")
    return wheel


def install(python: str, folder: Path, requirement: str) -> Path:
    """Install a wheel into a new environment and return its site-packages.

    ``requirement``: the wheel, with extras in brackets.
    """
    run(python, "-m", "venv", str(folder), cwd=folder.parent)
    run(str(folder / "bin/python"), "-m", "pip", "install", "-q", requirement, cwd=folder)
    (packages,) = (folder / "lib").glob("python3*/site-packages")
    return packages


def empty_debian(root: Path) -> Path:
    """Make an empty Debian 12 with Python in a folder and return it; it gets the certificates of this machine."""
    run(
        "debootstrap",
        "--variant=minbase",
        "--include=python3-venv,ca-certificates",
        "bookworm",
        str(root),
        cwd=root.parent,
    )
    for file in ("/etc/resolv.conf", "/etc/ssl/certs/ca-certificates.crt"):
        shutil.copy(file, root / file.lstrip("/"))
    return root


def install_in(root: Path, folder: str, requirement: str) -> Path:
    """Install into a new environment of another system, run ``armident --version`` there, return its site-packages."""
    inside = ("chroot", str(root))
    run(*inside, "python3", "-m", "venv", folder, cwd=root)
    run(*inside, f"{folder}/bin/python", "-m", "pip", "install", "-q", requirement, cwd=root)
    run(*inside, f"{folder}/bin/armident", "--version", cwd=root)
    (packages,) = Path(root, folder.lstrip("/"), "lib").glob("python3*/site-packages")
    return packages


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
