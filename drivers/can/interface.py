"""A CAN interface of this machine: its state, and what an administrator has to do about it."""

from pathlib import Path

from armident.configs.errors import ConfigError
from armident.drivers.can.frames import BusDown
from armident.drivers.can.mmsg import FD_MTU

SYSFS = Path("/sys/class/net")
_IFF_UP = 1


def is_up(channel: str) -> bool:
    """Whether the interface is administratively up."""
    try:
        return bool(int((SYSFS / channel / "flags").read_text(), 16) & _IFF_UP)
    except (OSError, ValueError):
        return False


def check_fd(channel: str) -> None:
    """Refuse an interface that carries classic frames only.

    Raises
    ------
    ConfigError
        With the command that would make it carry CAN FD.
    """
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


def missing(channel: str, reason: str | None) -> ConfigError:
    """The error of an interface that is not there or is no CAN interface."""
    hint = f"sudo ip link add dev {channel} type vcan && " if channel.startswith("vcan") else ""
    return ConfigError(
        f"bus {channel}: no such CAN interface ({reason}); "
        f"an administrator may run: {hint}sudo ip link set dev {channel} up"
    )


def down(channel: str, what: str) -> BusDown:
    """The error of an interface that cannot be used now: it is down, went down or was removed."""
    command = f"sudo ip link set dev {channel} up"
    return BusDown(f"bus {channel}: the interface {what}; an administrator may run: {command}")
