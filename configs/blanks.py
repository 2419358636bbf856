"""Blanks of a configuration: keys marked ``FILL_IN``, the commands that need each, and the way to find its value."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from armident.configs.errors import ConfigError

MARK = "FILL_IN"
"""Value of a key that is not known yet."""

LOG = "import of a bus log"
"""Use of a session to read the log of a bus, which needs what a capture needs of its drives."""


@dataclass(frozen=True)
class Need:
    """Use of a key that may be blank; ``how``: way to find the value.

    ``placeholder`` is the value of a required key, from the position of its entry in the list; else the default counts.
    """

    commands: tuple[str, ...]
    how: str
    placeholder: Callable[[int], Any] | None = None


_MOTION = ("trajectory",)
_DRIVES = ("capture", LOG)
_LINES = ("capture", "robot", "bus-load")
_NO_GEOMETRY = {"alpha": 0.0, "d": 0.0, "theta": 0.0, "r": 0.0}
_OWN = "nameplate or manual of the arm"

NEEDS: dict[str, Need] = {
    "joints[].mdh": Need(
        ("identify", "trajectory", "robot"),
        "modified Denavit-Hartenberg row {alpha, d, theta, r} from the manual of the arm, or from its URDF",
        lambda _: _NO_GEOMETRY,
    ),
    "joints[].limits.position": Need(_MOTION, f"[low, high] in rad or m: {_OWN}, less the reach of cables and walls"),
    "joints[].limits.velocity": Need(_MOTION, f"rad/s or m/s: {_OWN}"),
    "joints[].limits.acceleration": Need(
        _MOTION, "rad/s^2 or m/s^2: manual of the controller; else torque limit over the largest inertia"
    ),
    "joints[].limits.torque": Need(_MOTION, f"N m or N at the joint: {_OWN}"),
    "joints[].drive.gain": Need(
        ("identify", "capture", "robot"),
        "torque constant of the motor, N m (or N) per A or V: data sheet of the motor; "
        "times the gear ratio where transmission is the identity",
    ),
    "joints[].drive.rated": Need(
        _DRIVES, "A, V or N m at 1000 per mille: object 6075h (rated current) or 6076h (rated torque)"
    ),
    "joints[].drive.counts_per_unit": Need(
        _DRIVES, "encoder counts per motor turn (or per m): object 608Fh, or data sheet of the encoder"
    ),
    "transmission": Need(
        ("trajectory", *_DRIVES),
        "n rows of n numbers, motor turns per joint turn: gear ratios on the diagonal; "
        "the identity if drives report joint-side values",
    ),
    "bus.channel": Need(_LINES, "CAN interface: ip -br link show type can"),
    "bus.bitrate": Need(_LINES, "bit/s: setting of the drives; null on a virtual bus"),
    "sync.period_us": Need(_LINES, "SYNC period, us: object 1006h of the master, or the rate wanted"),
    "drives[].node_id": Need(
        (*_DRIVES, "robot", "bus-load"),
        "CANopen node id of the joint's drive: its switches or commissioning tool; heartbeats on the bus have the "
        "identifier 700h plus node id",
        lambda k: k + 1,
    ),
    "drives[].eds": Need(
        (*_DRIVES, "robot"),
        "electronic data sheet (.eds) of the drive, from its maker; eds/cia402_servo.eds for the virtual arm",
        lambda _: "eds/cia402_servo.eds",
    ),
}
"""Keys that a configuration may leave blank, by key without indices. Other keys are needed by every command."""


def pattern(key: str) -> str:
    """Key without the names of the entries: ``joints[elbow].mdh`` is ``joints[].mdh``."""
    return re.sub(r"\[[^\]]*\]", "[]", key)


def without_marks(data: dict[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Content of a file without blanks and lists with one, and their keys; required keys have placeholders."""
    blanks: list[str] = []
    content = _stripped(data, "", 0, blanks)
    return content, tuple(blanks)


def _stripped(value: dict[str, Any], key: str, place: int, blanks: list[str]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for name, one in value.items():
        own = f"{key}.{name}" if key else str(name)
        if _is_blank(one):
            blanks.append(own)
            need = NEEDS.get(pattern(own))
            if need is not None and need.placeholder is not None:
                made[name] = need.placeholder(place)
        elif isinstance(one, dict):
            made[name] = _stripped(one, own, place, blanks)
        elif isinstance(one, list):
            made[name] = [
                _stripped(each, f"{own}[{_entry(each, k)}]", k, blanks) if isinstance(each, dict) else each
                for k, each in enumerate(one)
            ]
        else:
            made[name] = one
    return made


def _is_blank(value: Any) -> bool:
    """Return True for the mark, and for a list (of lists) that contains it."""
    return value == MARK if isinstance(value, str) else isinstance(value, list) and any(map(_is_blank, value))


def _entry(entry: dict[str, Any], k: int) -> str:
    """Name of an entry of a list; its number if it has none."""
    return str(next((entry[key] for key in ("name", "joint") if isinstance(entry.get(key), str)), k))


def needed(blanks: Sequence[str], command: str | None, *, efforts_are_torques: bool = True) -> tuple[str, ...]:
    """Blanks whose value a command needs (``None``: any); without torques the transmission is needed to identify."""

    def wanted(key: str) -> bool:
        need = NEEDS.get(pattern(key))
        if command is None or need is None or command in need.commands:
            return True
        return command == "identify" and key == "transmission" and not efforts_are_torques

    return tuple(key for key in blanks if wanted(key))


def grouped(keys: Iterable[str]) -> dict[str, list[str]]:
    """Entries that lack a key, by key without indices; no entry where the key is that of no list."""
    entries: dict[str, list[str]] = {}
    for key in keys:
        found = re.search(r"\[([^\]]*)\]", key)
        entries.setdefault(pattern(key), []).extend([found[1]] if found else [])
    return entries


def blank_lines(keys: Iterable[str]) -> list[str]:
    """Blanks as lines of text: key, the entries that lack it, and how to find its value."""
    lines = []
    for key, names in grouped(keys).items():
        need = NEEDS.get(key)
        of = f" of {', '.join(names)}" if names else ""
        lines.append(f"{key}{of}" + (f" ({need.how})" if need is not None else ""))
    return lines


def check_filled(where: str, blanks: Sequence[str], command: str | None) -> None:
    """Raise ConfigError, with the way to find each value, if a configuration has blanks that the command needs."""
    if blanks:
        who = f"armident {command} needs" if command is not None else "expected"
        raise ConfigError(f"{where}: {who} values for keys marked {MARK}: {'; '.join(blank_lines(blanks))}")
