"""``python -m armident.drivers.vcan [-n BUSES] [-m MEMORY] [--guest] -- COMMAND``: run with vcan buses."""

import argparse
import os
import sys

from armident.configs.errors import ArmidentError
from armident.drivers.vcan import guest, interfaces, packages

CANNOT_RUN = 125
"""Exit code if the command cannot be started, as of ``env`` and ``timeout``."""


def main() -> int:
    """Run the command on this kernel if it has usable vcan buses, else in a User-Mode Linux guest."""
    parser = argparse.ArgumentParser(prog="python -m armident.drivers.vcan", description=main.__doc__)
    parser.add_argument(
        "-n", dest="buses", type=int, default=1, metavar="BUSES", help="number of buses, from vcan0 (1)"
    )
    parser.add_argument("-m", dest="memory", default="4096M", help="memory of a guest (4096M)")
    parser.add_argument("--guest", action="store_true", help="use a guest even if this kernel has SocketCAN")
    parser.add_argument("--setup", action="store_true", help="only check, and fetch the guest's packages if needed")
    parser.add_argument("command", nargs=argparse.REMAINDER, metavar="-- COMMAND")
    options = parser.parse_args()
    command = options.command[1:] if options.command[:1] == ["--"] else options.command
    if not command and not options.setup:
        parser.error("no command")
    try:
        native = not options.guest and _native(options.buses)
        if options.setup:
            print("SocketCAN of this kernel" if native else f"User-Mode Linux in {packages.provide()}")
            return 0
        if native:
            os.execvp(command[0], command)
        return guest.run_in_guest(command, options.buses, options.memory)
    except (ArmidentError, OSError) as error:
        print(f"armident.drivers.vcan: {error}", file=sys.stderr)
        return CANNOT_RUN


def _native(buses: int) -> bool:
    """Bring this kernel's vcan buses up; ``False`` if it has none or refuses."""
    if not interfaces.have_socketcan():
        return False
    try:
        for number in range(buses):
            interfaces.ensure_vcan(f"vcan{number}")
    except ArmidentError as error:
        print(f"{error}; using a User-Mode Linux guest instead", file=sys.stderr)
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
