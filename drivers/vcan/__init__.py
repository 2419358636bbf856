"""Virtual CAN buses: of this kernel if it has SocketCAN, else of a User-Mode Linux guest.

``python -m armident.drivers.vcan -n 2 -- COMMAND`` runs a command with ``vcan0`` and ``vcan1`` in either case.
"""

from armident.drivers.vcan.guest import launcher_command, launcher_obstacle
from armident.drivers.vcan.interfaces import ensure_vcan, have_socketcan, remove_vcan

__all__ = ["ensure_vcan", "have_socketcan", "launcher_command", "launcher_obstacle", "remove_vcan"]
