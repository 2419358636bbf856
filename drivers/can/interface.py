"""State of a CAN interface of this machine, and error messages with the administrator's command."""

from pathlib import Path

from armident.configs.errors import ConfigError
from armident.drivers.can.frames import BusDown
from armident.drivers.can.mmsg import FD_MTU

SYSFS = Path("/sys/class/net")
_IFF_UP = 1
_ARPHRD_CAN = 280


def is_up(channel: str) -> bool:
    """Return True if the interface exists and is administratively up."""
    try:
        return bool(int((SYSFS / channel / "flags").read_text(), 16) & _IFF_UP)
    except (OSError, ValueError):
        return False


def is_can(channel: str) -> bool:
    """Return True if the interface exists and is a CAN interface (``ARPHRD_CAN``)."""
    try:
        return int((SYSFS / channel / "type").read_text()) == _ARPHRD_CAN
    except (OSError, ValueError):
        return False


def check_fd(channel: str) -> None:
    """Refuse an interface that carries classic frames only; the ConfigError has the command that enables CAN FD."""
    try:
        mtu = int((SYSFS / channel / "mtu").read_text())
    except (OSError, ValueError):
        mtu = 0
    if mtu >= FD_MTU:
        return
    what = f"mtu {FD_MTU}" if channel.startswith("vcan") else "type can bitrate ... dbitrate ... fd on"
    link = f"sudo ip link set dev {channel}"
    raise ConfigError(
        f"bus {channel}: the interface carries no CAN FD; an administrator may run: "
        f"{link} down && {link} {what} && {link} up"
    )


def no_interface(channel: str, reason: str | None) -> ConfigError:
    """Error for an interface that does not exist or is not a CAN interface. ``reason``: text of the system's error."""
    hint = f"sudo ip link add dev {channel} type vcan && " if channel.startswith("vcan") else ""
    return ConfigError(
        f"bus {channel}: no such CAN interface ({reason}); "
        f"an administrator may run: {hint}sudo ip link set dev {channel} up"
    )


def down(channel: str, what: str) -> BusDown:
    """Error for an interface that is down, went down or was removed; ``what`` is the predicate of its message."""
    command = f"sudo ip link set dev {channel} up"
    return BusDown(f"bus {channel}: the interface {what}; an administrator may run: {command}")
