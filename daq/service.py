"""The command ``armident service``: files for systemd-sysusers, systemd-tmpfiles and systemctl."""

import grp
import os
import pwd
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

from armident.configs import ArmidentError, ConfigError, load_session
from armident.configs.loading import HERE as CONFIGS

ACCOUNT = "armident"
"""User and group of the units in ``configs/systemd``."""
SHIPPED_EXECUTABLE = "/opt/armident/bin/armident"
"""Executable that the shipped units name; it is replaced by the installed one."""
HEADER = "# Written by `armident service install`. Put changes into a drop-in (systemctl edit), not into this file.\n"
UNITS = Path("etc/systemd/system")
STATE = Path("var/lib/armident")
SETTINGS = Path("etc/armident")
CACHE = Path("var/cache/armident")
HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Folders that the units do not see: ``ProtectHome``, ``PrivateTmp``."""
INSTALLED = "installed"
LONGEST_STOP_S = 240.0
"""Longest time for a service to stop, s: more than the 180 s that a capture may take to finish its file."""
_CELL = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
"""Cells whose name systemd accepts as an instance name without escapes, and that is one component of a path."""
_WORDS = {"d": "folder ", "z": ""}
"""Types of the lines for systemd-tmpfiles, in messages."""


@dataclass(frozen=True)
class InstallStep:
    """One part of an installation: its name, a check that it is there, and the function that makes it."""

    name: str
    is_done: Callable[[], bool]
    apply: Callable[[], object]


@dataclass(frozen=True)
class System:
    """The system on which a service is installed: its root folder, and the command ``armident`` of the units."""

    root: Path
    executable: Path

    def __post_init__(self) -> None:
        for name in ("passwd", "group"):
            if not (self.root / "etc" / name).is_file():
                raise ConfigError(f"--root {self.root}: not the root of a Linux system: it has no etc/{name}")

    @property
    def has_systemd(self) -> bool:
        """True if the running system was started by systemd, false for an image."""
        return self.root == Path("/") and Path("/run/systemd/system").is_dir()

    def id_of(self, name: str, kind: str) -> int | None:
        """Return the id of a user (``passwd``) or group (``group``); ``None`` if there is none."""
        if self.root == Path("/"):
            try:
                return pwd.getpwnam(name).pw_uid if kind == "passwd" else grp.getgrnam(name).gr_gid
            except KeyError:
                return None
        lines = (self.root / "etc" / kind).read_text(encoding="utf-8").splitlines()
        fields = (line.split(":") for line in lines)
        return next((int(found[2]) for found in fields if found[0] == name and len(found) > 2), None)

    def has_account(self) -> bool:
        """Return ``True`` if there are user and group of the units."""
        return None not in (self.id_of(ACCOUNT, "passwd"), self.id_of(ACCOUNT, "group"))

    def run(self, *words: str, timeout_s: float = 60.0) -> None:
        """Run a command of systemd for this system; one that is missing or fails is an ArmidentError."""
        command = (words[0], *(() if self.root == Path("/") else (f"--root={self.root}",)), *words[1:])
        try:
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=timeout_s)
        except FileNotFoundError:
            raise ArmidentError(f"{words[0]}: no such command; it belongs to systemd") from None
        except subprocess.TimeoutExpired:
            raise ArmidentError(f"{' '.join(command)}: no answer in {timeout_s:g} s") from None
        except subprocess.CalledProcessError as error:
            reason = " ".join(error.stderr.split()) or f"exit code {error.returncode}"
            raise ArmidentError(f"{' '.join(command)}: {reason}") from None


def steps(system: System, cell: str) -> Iterator[InstallStep]:
    """Return the steps of the installation of a cell, in their order: its parts, and a reload of systemd."""
    found = list(parts(system, cell))
    changed = not all(step.is_done() for step in found if step.name.startswith("unit "))
    yield from found
    if changed and system.has_systemd:
        yield InstallStep("units known to systemd", lambda: False, lambda: system.run("systemctl", "daemon-reload"))


def parts(system: System, cell: str) -> Iterator[InstallStep]:
    """Return the parts of the installation of a cell, in their order."""
    yield _file(system, Path("etc/sysusers.d/armident.conf"), shipped_text("armident.sysusers"), "users")
    yield InstallStep(
        f"system group {ACCOUNT} and user {ACCOUNT}, without login",
        system.has_account,
        lambda: system.run("systemd-sysusers", "armident.conf"),
    )
    cell_lines = shipped_text("armident-cell.tmpfiles").replace("CELL", cell)
    for name, text in (("armident", shipped_text("armident.tmpfiles")), (f"armident-{cell}", cell_lines)):
        yield _file(system, Path(f"etc/tmpfiles.d/{name}.conf"), text, "folders")
        for line in text.splitlines():
            kind, path, mode, owner, group = line.split()
            if kind == "d" or (system.root / path[1:]).is_file():
                yield InstallStep(
                    f"{_WORDS[kind]}{path} ({owner}:{group}, {mode})",
                    partial(_agrees, system, path, mode, owner, group),
                    partial(system.run, "systemd-tmpfiles", "--create", f"{name}.conf"),
                )
    for name in _unit_names():
        yield _file(
            system, UNITS / name, shipped_text(name).replace(SHIPPED_EXECUTABLE, str(system.executable)), "unit"
        )
    drop_in, text = _drop_in(system, cell)
    if text:
        yield _file(system, drop_in, text, "unit")


def _drop_in(system: System, cell: str) -> tuple[Path, str]:
    """Return the file that ties the capture of a cell to its CAN interfaces, and its text; empty without a session."""
    session, devices = system.root / SETTINGS / f"{cell}.yaml", list[str]()
    if session.is_file():
        with suppress(ArmidentError):
            buses = load_session(session, "").all_buses
            devices = [bus.channel for bus in buses if bus.interface == "socketcan"]
    # Characters that systemd.unit(5) wants escaped.
    devices = [re.sub(r"[^A-Za-z0-9:_.]", lambda found: f"\\x{ord(found[0]):02x}", name) for name in devices]
    units = " ".join(f"sys-subsystem-net-devices-{name}.device" for name in devices)
    # Without a device its start job ends after 90 s; the device then starts the unit itself, also later on.
    text = f"[Unit]\nBindsTo={units}\nAfter={units}\n\n[Install]\nWantedBy={units}\n" if units else ""
    return UNITS / f"armident-capture@{cell}.service.d/bus.conf", text


def _agrees(system: System, path: str, mode: str, owner: str, group: str) -> bool:
    """Return ``True`` if a file or folder has its mode, owner and group."""
    target = system.root / path[1:]
    if not target.exists():
        return False
    found = target.stat()
    wanted = (system.id_of(owner, "passwd"), system.id_of(group, "group"), int(mode, 8))
    return (found.st_uid, found.st_gid, stat.S_IMODE(found.st_mode)) == wanted


def _file(system: System, path: Path, plain: str, kind: str) -> InstallStep:
    """Return the step that writes a file of ours; one of other origin is refused."""
    target = system.root / path
    wanted = HEADER + plain

    def is_done() -> bool:
        if not target.exists():
            return False
        found = target.read_text(encoding="utf-8", errors="replace")
        if not found.startswith(HEADER) and found != plain:
            raise ConfigError(
                f"{target}: was not written by this command, and differs: move it away, then repeat; "
                "put local changes into a drop-in (systemctl edit)"
            )
        return found == wanted

    def apply() -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        whole = target.with_name(f".{target.name}.new")
        whole.write_text(wanted, encoding="utf-8")
        whole.chmod(0o644)
        whole.replace(target)

    return InstallStep(f"{kind} /{path}", is_done, apply)


def _unit_names() -> list[str]:
    """Return the names of the shipped units, those that start others first."""
    units = [file for file in (CONFIGS / "systemd").iterdir() if file.suffix in (".service", ".timer")]
    return [file.name for file in sorted(units, key=lambda file: (file.suffix != ".timer", file.name))]


def shipped_text(name: str) -> str:
    """Return the text of a shipped file for systemd."""
    return (CONFIGS / "systemd" / name).read_text(encoding="utf-8")


def installed_executable() -> Path:
    """Return the command ``armident`` of this environment; ConfigError if the units would not see or may not run it."""
    beside = Path(sys.executable).with_name("armident")
    remedy = (
        "install armident where every user may read it: sudo python3 -m venv /opt/armident && "
        f"sudo /opt/armident/bin/pip install armident, then sudo {SHIPPED_EXECUTABLE} service install CELL"
    )
    if not beside.is_file():
        raise ConfigError(f"{beside}: no such file; {remedy}")
    for path in (beside, Path(sys.executable).resolve()):
        hidden = next((folder for folder in HIDDEN if path.is_relative_to(folder)), None)
        if hidden is not None:
            raise ConfigError(f"{path}: a service does not see {hidden}; {remedy}")
        closed = next((each for each in (path, *path.parents) if not each.stat().st_mode & stat.S_IXOTH), None)
        if closed is not None:
            raise ConfigError(f"{path}: user {ACCOUNT} may not run it: {closed} is closed to others; {remedy}")
    return beside


def _system(cell: str, root: Path, executable: Path | None) -> System:
    """Return a system after a check of the name of the cell, which a unit and a folder must be able to have."""
    if _CELL.fullmatch(cell) is None:
        raise ConfigError(f"{cell!r}: expected letters, digits, '_', '-' and '.' as the name of a cell, at most 64")
    root = root.resolve()
    return System(root, executable or (installed_executable() if root == Path("/") else Path(SHIPPED_EXECUTABLE)))


def install(cell: str, root: Path = Path("/"), executable: Path | None = None, dry_run: bool = False) -> list[str]:
    """Install the service of a cell, and return the lines of a report; nothing is enabled or started."""
    system = _system(cell, root, executable)
    with_sudo = f"sudo {system.executable} service install {cell}"
    try:
        open_steps = [step for step in steps(system, cell) if not step.is_done()]
        remaining = list(_next(system, cell))
    except PermissionError as error:
        raise ConfigError(f"{error.filename}: only root may read it: {with_sudo}") from None
    if open_steps and not dry_run and os.geteuid() != 0:
        raise ConfigError(f"only root can install a service: {with_sudo}")
    lines = _carry_out(open_steps, dry_run)
    return [*(lines or [f"nothing to do: the service of cell {cell} is installed"]), *remaining]


def _carry_out(open_steps: Sequence[InstallStep], dry_run: bool) -> list[str]:
    lines = []
    for step in open_steps:
        if not dry_run:
            try:
                step.apply()
            except OSError as error:
                raise ArmidentError(f"{step.name}: {error.strerror}: {error.filename}") from None
        lines.append(f"{'to do' if dry_run else 'done'}: {step.name}")
    return lines


def _next(system: System, cell: str) -> Iterator[str]:
    """Return what remains to be done by hand."""
    session = SETTINGS / f"{cell}.yaml"
    if not (system.root / session).is_file():
        yield f"next: write the session configuration /{session}, with the files that it names beside it; repeat this"
        return
    yield f"next: cd /{STATE / cell} && sudo -u {ACCOUNT} {system.executable} doctor --config /{session}"
    yield f"next: sudo systemctl enable --now armident-capture@{cell}"


def status(cell: str, root: Path = Path("/"), executable: Path | None = None) -> tuple[list[str], bool]:
    """Return the lines on the state of the services of a cell, and ``True`` if all parts are installed."""
    system = _system(cell, root, executable)
    try:
        states = [(_state(step), step.name) for step in parts(system, cell)]
        lines = [f"{state}: {name}" for state, name in states]
        session = SETTINGS / f"{cell}.yaml"
        if not (system.root / session).is_file():
            lines.append(f"missing: session configuration /{session}, which you write")
        lines += [f"{_activity(system, name)}: {name}" for name in _instances(cell)]
        lines.append(_recordings(system.root, cell))
    except PermissionError as error:
        raise ConfigError(f"{error.filename}: only root may read it: sudo armident service status {cell}") from None
    return lines, all(state == INSTALLED for state, _ in states)


def _state(step: InstallStep) -> str:
    """Return the state of a part of an installation in words."""
    try:
        return INSTALLED if step.is_done() else "missing or different"
    except ConfigError:
        return "written by another program or person"


def uninstall(cell: str, root: Path = Path("/"), dry_run: bool = False) -> list[str]:
    """Stop, disable and remove the services of a cell, but no recordings; return the lines of a report."""
    system = _system(cell, root, Path(SHIPPED_EXECUTABLE))
    try:
        open_steps = list(_removals(system, cell))
        kept = list(_kept(system, cell))
    except PermissionError as error:
        raise ConfigError(f"{error.filename}: only root may read it: sudo armident service uninstall {cell}") from None
    if open_steps and not dry_run and os.geteuid() != 0:
        raise ConfigError(f"only root can remove a service: sudo armident service uninstall {cell}")
    lines = _carry_out(open_steps, dry_run)
    return [*(lines or [f"nothing to do: the service of cell {cell} is not installed"]), *kept]


def _instances(cell: str) -> list[str]:
    return [name.replace("@.", f"@{cell}.") for name in _unit_names() if "@" in name]


def _links(system: System, name: str) -> list[Path]:
    """Return the links with which systemd starts a unit; those of an image may lead nowhere."""
    folders = sorted(path for path in (system.root / UNITS).glob("*.*") if path.is_dir())
    return [path for each in folders for path in each.iterdir() if fnmatch(path.name, name) and path.is_symlink()]


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


def _removals(system: System, cell: str) -> Iterator[InstallStep]:
    """Return the parts of the removal of a cell that are needed, in their order."""

    def step(name: str, apply: Callable[[], object]) -> InstallStep:
        return InstallStep(name, lambda: False, apply)

    # Units without a cell, such as the page, end with the last one.
    shared = [] if _other_cells(system, cell) else [name for name in _unit_names() if "@" not in name]
    for name in (names := [*_instances(cell), *shared]):
        if _is_active(system, name):
            words = ("systemctl", "stop", name)
            yield step(f"stop {name}", partial(system.run, *words, timeout_s=LONGEST_STOP_S))
    links = [link for name in names for link in _links(system, name)]
    yield from (step(f"disable {link.name} ({link.parent.name})", link.unlink) for link in links)
    own = [system.root / path for path in (f"etc/tmpfiles.d/armident-{cell}.conf", _drop_in(system, cell)[0])]
    units = [] if _other_cells(system, cell) else [unit for unit in _units(system) if _is_ours(unit)]
    files = [*own, *([*units, system.root / "etc/tmpfiles.d/armident.conf"] if units else [])]
    for file in files:
        if file.is_file():
            kind = "unit" if file in (*units, own[1]) else "file"
            yield step(f"remove {kind} /{file.relative_to(system.root)}", file.unlink)
    if own[1].is_file() and len(list(own[1].parent.iterdir())) == 1:
        yield step(f"remove folder /{own[1].parent.relative_to(system.root)}", own[1].parent.rmdir)
    cache = system.root / CACHE
    if units and cache.is_dir():
        yield step(f"remove folder /{CACHE} (fonts, compiled kernels)", lambda: shutil.rmtree(cache))
    if (units or links or own[1].is_file()) and system.has_systemd:
        yield step("units known to systemd", partial(system.run, "systemctl", "daemon-reload"))


def _units(system: System) -> list[Path]:
    """Return the installed unit files of the shipped names."""
    return [path for name in sorted(_unit_names()) if (path := system.root / UNITS / name).is_file()]


def _is_ours(unit: Path) -> bool:
    """Return ``True`` if a unit file was written by ``armident service install``, or is a copy of the shipped one."""
    text = unit.read_text(encoding="utf-8", errors="replace")
    return text.startswith(HEADER) or text == shipped_text(unit.name)


def _other_cells(system: System, cell: str) -> list[str]:
    """Return the other cells that use the unit files: those with a session configuration or an enabled unit."""
    settings = system.root / SETTINGS
    files = sorted(settings.glob("*.yaml")) if settings.is_dir() else []
    sessions = {file.stem for file in files if "armident/session/" in file.read_text("utf-8", errors="replace")}
    enabled = {
        link.name.partition("@")[2].rpartition(".")[0] for link in (system.root / UNITS).glob("*.*/armident-*@*.*")
    }
    return sorted((sessions | enabled) - {cell})


def _kept(system: System, cell: str) -> Iterator[str]:
    """Return the lines on what a removal leaves."""
    yield _recordings(system.root, cell)
    session = SETTINGS / f"{cell}.yaml"
    if (system.root / session).is_file():
        yield f"kept: session configuration /{session}; delete it yourself if the cell does not come back"
    others = _other_cells(system, cell)
    if others and _units(system):
        yield f"kept: unit files, for {', '.join(others)} (session in /{SETTINGS}, or enabled)"
    for unit in _units(system):
        if not _is_ours(unit):
            yield f"kept: unit /{unit.relative_to(system.root)}, which this command did not write"
    if system.has_account():
        yield f"kept: user and group {ACCOUNT}, which own the recordings"


def _recordings(root: Path, cell: str) -> str:
    """Return the line on recordings and results of a cell: folder, number of files and size."""
    folder = root / STATE / cell
    if not folder.is_dir():
        return f"no recordings and results: there is no folder /{STATE / cell}"
    files = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    size = sum(path.stat().st_size for path in files) / 1e6
    return f"recordings and results: /{STATE / cell} ({len(files)} files, {size:.1f} MB); never deleted"
