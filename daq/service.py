"""The command ``armident service``: user, folders, permissions and systemd units of a cell, made idempotently."""

import grp
import os
import pwd
import re
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ArmidentError, ConfigError
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
_CELL = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
"""Cells whose name systemd accepts as an instance name without escapes, and that is one component of a path."""


@dataclass(frozen=True)
class Step:
    """One part of an installation.

    ``name``: result of the step, for example ``folder /etc/armident``; ``is_done``: returns whether the result is there
    already; ``apply``: makes the result.
    """

    name: str
    is_done: Callable[[], bool]
    apply: Callable[[], None]


@dataclass(frozen=True)
class System:
    """The system on which a service is installed.

    ``root``: root folder: ``/``, or the folder of a system image; ``executable``: the command ``armident`` as the units
    start it.
    """

    root: Path
    executable: Path

    def __post_init__(self) -> None:
        for name in ("passwd", "group"):
            if not (self.root / "etc" / name).is_file():
                raise ConfigError(f"--root {self.root}: not the root of a Linux system: it has no etc/{name}")

    @property
    def is_running(self) -> bool:
        """True for the running system, false for an image."""
        return self.root == Path("/")

    @property
    def has_systemd(self) -> bool:
        """True if the running system was started by systemd."""
        return self.is_running and Path("/run/systemd/system").is_dir()

    def user_id(self) -> int | None:
        """Return the id of the user of the units, ``None`` if there is none."""
        if not self.is_running:
            return self._listed_id("passwd")
        try:
            return pwd.getpwnam(ACCOUNT).pw_uid
        except KeyError:
            return None

    def group_id(self) -> int | None:
        """Return the id of the group of the units, ``None`` if there is none."""
        if not self.is_running:
            return self._listed_id("group")
        try:
            return grp.getgrnam(ACCOUNT).gr_gid
        except KeyError:
            return None

    def _listed_id(self, name: str) -> int | None:
        lines = (self.root / "etc" / name).read_text(encoding="utf-8").splitlines()
        fields = (line.split(":") for line in lines)
        return next((int(found[2]) for found in fields if found[0] == ACCOUNT and len(found) > 2), None)

    def run(self, *words: str, timeout_s: float = 60.0) -> None:
        """Run a command of the package ``passwd`` or of systemd.

        ``timeout_s``: longest time for it, s. Raises ArmidentError if it is missing or fails.
        """
        prefix = () if self.is_running else ("--prefix", str(self.root))
        command = (words[0], *prefix, *words[1:]) if words[0] != "systemctl" else words
        try:
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=timeout_s)
        except FileNotFoundError:
            raise ArmidentError(f"{words[0]}: no such command; is /usr/sbin in PATH?") from None
        except subprocess.TimeoutExpired:
            raise ArmidentError(f"{' '.join(command)}: no answer in {timeout_s:g} s") from None
        except subprocess.CalledProcessError as error:
            reason = " ".join(error.stderr.split()) or f"exit code {error.returncode}"
            raise ArmidentError(f"{' '.join(command)}: {reason}") from None


def steps(system: System, cell: str) -> Iterator[Step]:
    """Return the steps of the installation of a cell, in their order: its parts, and a reload of systemd.

    ``cell``: name of the cell: its session configuration is ``/etc/armident/CELL.yaml``.
    """
    found = list(parts(system, cell))
    changed = not all(step.is_done() for step in found if step.name.startswith("unit "))
    yield from found
    if changed and system.has_systemd:
        yield Step("units known to systemd", lambda: False, lambda: system.run("systemctl", "daemon-reload"))


def parts(system: System, cell: str) -> Iterator[Step]:
    """Return the parts of the installation of a cell, in their order.

    ``cell``: name of the cell: its session configuration is ``/etc/armident/CELL.yaml``.
    """
    yield Step(
        f"system group {ACCOUNT}",
        lambda: system.group_id() is not None,
        lambda: system.run("groupadd", "--system", ACCOUNT),
    )
    yield Step(
        f"system user {ACCOUNT}, without login",
        lambda: system.user_id() is not None,
        lambda: system.run(
            *("useradd", "--system", "--gid", ACCOUNT, "--no-create-home", "--home-dir", f"/{STATE}"),
            *("--shell", "/usr/sbin/nologin", ACCOUNT),
        ),
    )
    # Keys of Zenoh may be beside the configuration: only the group reads it. systemd makes the others, with 0755, too.
    yield _folder(system, SETTINGS, 0o750, owner="root")
    yield _folder(system, STATE, 0o755, owner="root", group="root")
    yield _folder(system, STATE / cell, 0o755)
    yield _folder(system, CACHE, 0o755)
    session = SETTINGS / f"{cell}.yaml"
    if (system.root / session).is_file():
        yield _permissions(system, f"/{session}", session, 0o640, "root", ACCOUNT)
    for file in sorted((CONFIGS / "systemd").glob("armident-*@.*")):
        yield _unit(system, file)


def _folder(system: System, path: Path, mode: int, owner: str = ACCOUNT, group: str = ACCOUNT) -> Step:
    step = _permissions(system, f"folder /{path}", path, mode, owner, group)

    def apply() -> None:
        (system.root / path).mkdir(mode=mode, parents=True, exist_ok=True)
        step.apply()

    return Step(step.name, step.is_done, apply)


def _permissions(system: System, name: str, path: Path, mode: int, owner: str, group: str) -> Step:
    """Return the step that gives owner, group and mode to a file or folder."""
    target = system.root / path

    def ids() -> tuple[int | None, int | None]:
        return (0 if owner == "root" else system.user_id()), (0 if group == "root" else system.group_id())

    def is_done() -> bool:
        if not target.exists():
            return False
        found = target.stat()
        return (found.st_uid, found.st_gid, stat.S_IMODE(found.st_mode)) == (*ids(), mode)

    def apply() -> None:
        user, group_id = ids()
        if user is None or group_id is None:
            raise ArmidentError(f"{name}: there is no user or no group {ACCOUNT}")
        os.chown(target, user, group_id)
        target.chmod(mode)

    return Step(f"{name} ({owner}:{group}, {mode:04o})", is_done, apply)


def _unit(system: System, file: Path) -> Step:
    """Return the step that writes a unit with the path of the installed command."""
    target = system.root / UNITS / file.name
    plain = shipped_text(file.name).replace(SHIPPED_EXECUTABLE, str(system.executable))
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

    return Step(f"unit /{UNITS / file.name}", is_done, apply)


def shipped_text(name: str) -> str:
    """Return the text of a shipped unit. ``name``: name of its file."""
    return (CONFIGS / "systemd" / name).read_text(encoding="utf-8")


def named_cell(cell: str) -> str:
    """Return the name of a cell, after a check that a unit and a folder can have it.

    Raises ConfigError if it cannot be the name of a unit.
    """
    if _CELL.fullmatch(cell) is None:
        raise ConfigError(f"{cell!r}: expected letters, digits, '_', '-' and '.' as the name of a cell, at most 64")
    return cell


def installed_executable() -> Path:
    """Return the command ``armident`` of the running environment, as a unit can start it.

    Raises ConfigError if the units would not see it, or may not run it.
    """
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


def install(cell: str, root: Path = Path("/"), executable: Path | None = None, dry_run: bool = False) -> list[str]:
    """Install the service of a cell, and return the lines that say what was done.

    Parts that are there are left alone, so that a second run does nothing. No unit is enabled or started.

    ``root``: root folder of the system; another than ``/`` is that of a system image. ``executable``: the command
    ``armident`` as the units start it; default: that of this environment, in an image ``/opt/armident/bin/armident``.
    ``dry_run``: change nothing. Raises ConfigError if the name of the cell cannot be that of a unit, without the rights
    of root, or if there is a unit of other origin.
    """
    named_cell(cell)
    root = root.resolve()
    if executable is None:
        executable = installed_executable() if root == Path("/") else Path(SHIPPED_EXECUTABLE)
    system = System(root, executable)
    with_sudo = f"sudo {executable} service install {cell}"
    try:
        open_steps = [step for step in steps(system, cell) if not step.is_done()]
        remaining = list(_next(system, cell))
    except PermissionError as error:
        raise ConfigError(f"{error.filename}: only root may read it: {with_sudo}") from None
    if open_steps and not dry_run and os.geteuid() != 0:
        raise ConfigError(f"only root can install a service: {with_sudo}")
    lines = carry_out(open_steps, dry_run=dry_run)
    return [*(lines or [f"nothing to do: the service of cell {cell} is installed"]), *remaining]


def carry_out(open_steps: Sequence[Step], *, dry_run: bool) -> list[str]:
    """Carry out steps, and return one line for each.

    ``dry_run``: change nothing. Raises ArmidentError if a step fails.
    """
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
