"""The commands ``armident service status`` and ``uninstall``: state of the services of a cell, and their removal."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from armident.configs import ConfigError
from armident.configs.loading import HERE as CONFIGS
from armident.daq.service import (
    ACCOUNT,
    CACHE,
    HEADER,
    SETTINGS,
    SHIPPED_EXECUTABLE,
    STATE,
    UNITS,
    Step,
    System,
    carry_out,
    installed_executable,
    named_cell,
    parts,
    shipped_text,
)

INSTALLED = "installed"

LONGEST_STOP_S = 240.0
"""Longest time for a service to stop, s: more than the 180 s that a capture may take to finish its file."""


def status(cell: str, root: Path = Path("/"), executable: Path | None = None) -> tuple[list[str], bool]:
    """Return the lines on the state of the services of a cell, and ``True`` if all parts are installed.

    ``root``: root folder of the system. ``executable``: the command ``armident`` as the units start it; default as for
    `armident.daq.service.install`. Raises ConfigError if the name of the cell cannot be that of a unit, or a file may
    be read by root only.
    """
    root = root.resolve()
    system = System(root, executable or (installed_executable() if root == Path("/") else Path(SHIPPED_EXECUTABLE)))
    try:
        states = [(_state(step), step.name) for step in parts(system, named_cell(cell))]
        lines = [f"{state}: {name}" for state, name in states]
        session = SETTINGS / f"{cell}.yaml"
        if not (root / session).is_file():
            lines.append(f"missing: session configuration /{session}, which you write")
        lines += [f"{_activity(system, name)}: {name}" for name in _instances(cell)]
        lines.append(_recordings(root, cell))
    except PermissionError as error:
        raise ConfigError(f"{error.filename}: only root may read it: sudo armident service status {cell}") from None
    return lines, all(state == INSTALLED for state, _ in states)


def _state(step: Step) -> str:
    """Return the state of a part of an installation in words."""
    try:
        return INSTALLED if step.is_done() else "missing or different"
    except ConfigError:
        return "written by another program or person"


def uninstall(cell: str, root: Path = Path("/"), dry_run: bool = False) -> list[str]:
    """Remove the services of a cell, and return the lines that say what was done and what was kept.

    Its units are stopped and disabled. The unit files, which all cells share, go with the last cell. Recordings,
    results, configurations and the user that owns them are kept.

    ``root``: root folder of the system; another than ``/`` is that of a system image. ``dry_run``: change nothing.
    Raises ConfigError if the name of the cell cannot be that of a unit, or without the rights of root.
    """
    root = root.resolve()
    system = System(root, Path(SHIPPED_EXECUTABLE))
    try:
        open_steps = [step for step in _removals(system, named_cell(cell)) if not step.is_done()]
        kept = list(_kept(system, cell))
    except PermissionError as error:
        raise ConfigError(f"{error.filename}: only root may read it: sudo armident service uninstall {cell}") from None
    if open_steps and not dry_run and os.geteuid() != 0:
        raise ConfigError(f"only root can remove a service: sudo armident service uninstall {cell}")
    lines = carry_out(open_steps, dry_run=dry_run)
    return [*(lines or [f"nothing to do: the service of cell {cell} is not installed"]), *kept]


def _instances(cell: str) -> list[str]:
    """Return the units of a cell, those that start others first."""
    files = sorted((CONFIGS / "systemd").glob("armident-*@.*"), key=lambda file: (file.suffix != ".timer", file.name))
    return [file.name.replace("@.", f"@{cell}.") for file in files]


def _links(system: System, name: str) -> list[Path]:
    """Return the links with which systemd starts a unit; those of an image may lead nowhere."""
    return [path for folder in _link_folders(system) if (path := folder / name).is_symlink()]


def _link_folders(system: System) -> list[Path]:
    return [folder for end in ("wants", "requires") for folder in sorted((system.root / UNITS).glob(f"*.{end}"))]


def _is_active(system: System, name: str) -> bool:
    """Return ``True`` if a unit of the running system is active."""
    if not system.has_systemd:
        return False
    return subprocess.run(["systemctl", "is-active", "--quiet", name], check=False, timeout=60).returncode == 0


def _activity(system: System, name: str) -> str:
    enabled = "enabled" if _links(system, name) else "not enabled"
    if not system.has_systemd:
        return enabled
    return f"{enabled}, {'active' if _is_active(system, name) else 'not active'}"


def _removals(system: System, cell: str) -> Iterator[Step]:
    """Return the parts of the removal of a cell, in their order."""
    for name in _instances(cell):
        yield _stopped(system, name)
    for name in _instances(cell):
        for link in _links(system, name):
            yield _absent(link, f"disable {name} ({link.parent.name})")
    units = [] if _other_cells(system, cell) else [unit for unit in _units(system) if _is_ours(unit)]
    for unit in units:
        yield _absent(unit, f"remove unit /{unit.relative_to(system.root)}")
    cache = system.root / CACHE
    if units and cache.is_dir():
        yield Step(f"remove folder /{CACHE} (compiled code)", lambda: False, lambda: shutil.rmtree(cache))
    if (units or any(_links(system, name) for name in _instances(cell))) and system.has_systemd:
        yield Step("units known to systemd", lambda: False, lambda: system.run("systemctl", "daemon-reload"))


def _stopped(system: System, name: str) -> Step:
    return Step(
        f"stop {name}",
        lambda: not _is_active(system, name),
        lambda: system.run("systemctl", "stop", name, timeout_s=LONGEST_STOP_S),
    )


def _absent(path: Path, name: str) -> Step:
    return Step(name, lambda: False, lambda: path.unlink(missing_ok=True))


def _units(system: System) -> list[Path]:
    """Return the installed unit files of the shipped names."""
    names = sorted(file.name for file in (CONFIGS / "systemd").glob("armident-*@.*"))
    return [path for name in names if (path := system.root / UNITS / name).is_file()]


def _is_ours(unit: Path) -> bool:
    """Return ``True`` if a unit file was written by ``armident service install``, or is a copy of the shipped one."""
    text = unit.read_text(encoding="utf-8", errors="replace")
    return text.startswith(HEADER) or text == shipped_text(unit.name)


def _other_cells(system: System, cell: str) -> list[str]:
    """Return the other cells that use the unit files: those with a session configuration or an enabled unit."""
    settings = system.root / SETTINGS
    files = sorted(settings.glob("*.yaml")) if settings.is_dir() else []
    sessions = {file.stem for file in files if "armident/session/" in file.read_text("utf-8", errors="replace")}
    links = [link for folder in _link_folders(system) for link in folder.glob("armident-*@*.*")]
    enabled = {link.name.partition("@")[2].rpartition(".")[0] for link in links}
    return sorted((sessions | enabled) - {cell})


def _kept(system: System, cell: str) -> Iterator[str]:
    """Return the lines on what a removal leaves."""
    yield _recordings(system.root, cell)
    session = SETTINGS / f"{cell}.yaml"
    if (system.root / session).is_file():
        yield f"kept: session configuration /{session}; delete it yourself if the cell does not come back"
    others = _other_cells(system, cell)
    foreign = [unit for unit in _units(system) if not _is_ours(unit)]
    if others and _units(system):
        yield f"kept: unit files, for {', '.join(others)} (session in /{SETTINGS}, or enabled)"
    for unit in foreign:
        yield f"kept: unit /{unit.relative_to(system.root)}, which this command did not write"
    if system.user_id() is not None:
        yield f"kept: user and group {ACCOUNT}, which own the recordings"


def _recordings(root: Path, cell: str) -> str:
    """Return the line on recordings and results of a cell: folder, number of files and size."""
    folder = root / STATE / cell
    if not folder.is_dir():
        return f"no recordings and results: there is no folder /{STATE / cell}"
    files = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    size = sum(path.stat().st_size for path in files) / 1e6
    return f"recordings and results: /{STATE / cell} ({len(files)} files, {size:.1f} MB); never deleted"
