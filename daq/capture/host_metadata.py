"""Metadata of machine and program that a recording holds."""

import datetime
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_CLOCK = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
_GIT_TIMEOUT_S = 2.0


def host_metadata(now: datetime.datetime) -> dict[str, str]:
    """Return host, kernel, clock source, program version and git revision, as far as they are known."""
    metadata = {
        "started_utc": now.astimezone(datetime.UTC).isoformat(timespec="microseconds"),
        "host": platform.node(),
        "kernel": platform.release(),
        "machine": platform.machine(),
        "python": platform.python_version(),
    }
    try:
        metadata["armident"] = version("armident")
    except PackageNotFoundError:
        metadata["armident"] = "unpackaged"
    revision = git_revision(Path(__file__).resolve().parent)
    if revision is not None:
        metadata["git_revision"] = revision
    if _CLOCK.is_file():
        metadata["clocksource"] = _CLOCK.read_text().strip()
    return metadata


def git_revision(folder: Path) -> str | None:
    """Return the git revision of a folder, with ``+`` if files were changed; ``None`` outside of a working tree."""
    try:
        head = _git(folder, "rev-parse", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", ".")
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+" if changed else "")


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=_GIT_TIMEOUT_S)
    return done.stdout.strip()
