"""Notifications to systemd (sd_notify(3)): ready, progress for the watchdog, reloading, stopping."""

import os
import socket
import time


class Notifier:
    """Sends states to the service manager, if there is one (``$NOTIFY_SOCKET``).

    A service calls `progress` when its work has advanced, not by a timer: systemd restarts one that hangs.
    """

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):
            self._address = "\0" + self._address[1:]
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) if self._address else None

    def ready(self, status: str) -> None:
        """Report that the service has started. ``status``: status line for ``systemctl status``."""
        self._send(f"READY=1\nSTATUS={status}")

    def progress(self, status: str) -> None:
        """Reset the watchdog, and set the status line."""
        self._send(f"WATCHDOG=1\nSTATUS={status}")

    def reloading(self) -> None:
        """Report that the configuration is being reloaded; `ready` reports the end."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self) -> None:
        """Report that the service finishes its work and ends."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, state: str) -> None:
        if self._socket is not None:
            try:
                self._socket.sendto(state.encode(), socket.MSG_DONTWAIT, self._address)
            except OSError:
                # The manager has ended or its buffer is full: the service goes on without it.
                return
