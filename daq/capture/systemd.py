"""What a service tells systemd (sd_notify(3)): that it is ready, that it makes progress, that it ends."""

import os
import socket
import time


class Notifier:
    """Sends states to the service manager; nothing happens where there is none.

    The watchdog is fed by `progress`, which is called when samples were taken or the bus was seen silent, and not by a
    timer: a capture that hangs is restarted.
    """

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):
            self._address = "\0" + self._address[1:]
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) if self._address else None

    def ready(self, status: str) -> None:
        """The capture records."""
        self._send(f"READY=1\nSTATUS={status}")

    def progress(self, status: str) -> None:
        """Work was done since the last call."""
        self._send(f"WATCHDOG=1\nSTATUS={status}")

    def reloading(self) -> None:
        """The configuration is being read again; `ready` says when that is over."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self) -> None:
        """The end has begun; the file is being finished."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Say no more."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, state: str) -> None:
        if self._socket is not None:
            try:
                self._socket.sendto(state.encode(), self._address)
            except OSError:
                # The manager is gone or full; a capture goes on without it.
                return
