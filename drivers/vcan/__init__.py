"""Virtual CAN buses: of this kernel where it has SocketCAN, of a User-Mode Linux guest where it has not.

``python -m armident.drivers.vcan -n 2 -- COMMAND`` runs a command where ``vcan0`` and ``vcan1`` are up, either way.
"""

from armident.drivers.vcan.guest import launcher_available, launcher_command
from armident.drivers.vcan.interfaces import ensure_vcan, have_socketcan, remove_vcan

__all__ = ["ensure_vcan", "have_socketcan", "launcher_available", "launcher_command", "remove_vcan"]
