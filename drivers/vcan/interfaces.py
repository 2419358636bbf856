"""Creation and removal of vcan interfaces of the running kernel."""

import socket
import subprocess

from armident.configs.errors import ConfigError
from armident.drivers.can.interface import SYSFS, is_up


def have_socketcan() -> bool:
    """Return True if this kernel opens raw CAN sockets; loads the kernel module if there is one."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def ensure_vcan(name: str = "vcan0") -> None:
    """Bring a vcan interface up, and create it if needed; a ConfigError has the command for an administrator."""
    if is_up(name):
        return
    if not have_socketcan():
        raise ConfigError(f"{name}: this kernel has no SocketCAN (try: sudo modprobe -a can_raw vcan)")
    steps = [["ip", "link", "set", "dev", name, "up"]]
    if not (SYSFS / name).exists():
        steps.insert(0, ["ip", "link", "add", "dev", name, "type", "vcan"])
    for step in steps:
        problem = _run(step)
        if problem is not None:
            administrator = " && ".join("sudo " + " ".join(s) for s in [["modprobe", "vcan"], *steps])
            raise ConfigError(f"{name}: cannot bring it up ({problem}); an administrator must run: {administrator}")


def remove_vcan(name: str) -> None:
    """Delete a vcan interface if it exists. Raises ConfigError if it cannot be deleted."""
    if not (SYSFS / name).exists():
        return
    problem = _run(["ip", "link", "delete", "dev", name])
    if problem is not None:
        raise ConfigError(f"{name}: cannot delete it ({problem})")


def _run(command: list[str]) -> str | None:
    """Run a command; return its error on one line, ``None`` on success."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    return None if done.returncode == 0 else " ".join(done.stderr.split()) or f"{command[0]} exited {done.returncode}"
