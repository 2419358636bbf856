"""Polling of the drives' temperatures over SDO in the background."""

import threading
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager

from armident.configs.errors import ArmidentError
from armident.drivers.canopen.sdo import DriveSdo

CODES = {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"}
"""Formats of `struct` by object type."""
ANSWER_S = 0.1
"""Longest wait for an answer, s, and so the longest delay of other SDO transfers."""
REST_S = 60.0
"""Pause after a drive did not answer, s."""


class TemperaturePoll(AbstractContextManager["TemperaturePoll", None]):
    """Reads temperatures in a separate thread, one drive at a time; use it in a ``with`` block.

    A drive with another SDO transfer in progress waits for its next turn; one that did not answer rests for ``rest_s``.
    """

    def __init__(self, drives: Sequence[DriveSdo], rest_s: float = REST_S) -> None:
        self._drives = [sdo for sdo in drives if sdo.drive.temperature is not None]
        self._rest_s = rest_s
        self._celsius: dict[str, float] = {}
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        if self._drives:
            self._thread = threading.Thread(target=self._run, name="temperatures", daemon=True)
            self._thread.start()

    def celsius(self) -> dict[str, float]:
        """Last temperature of each drive that answers, degrees Celsius, by joint."""
        return dict(self._celsius)

    def stop(self) -> None:
        """End polling without waiting for the thread."""
        self._over.set()

    def __exit__(self, *_: object) -> None:
        """Stop polling and wait for the thread."""
        self.stop()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        due = {sdo.drive.joint: 0.0 for sdo in self._drives}
        while not self._over.is_set():
            for sdo in self._drives:
                if due[sdo.drive.joint] <= time.monotonic() and not self._over.is_set():
                    due[sdo.drive.joint] = time.monotonic() + self._ask(sdo)
            self._over.wait(max(0.0, min(due.values()) - time.monotonic()))

    def _ask(self, sdo: DriveSdo) -> float:
        """Poll one drive; return the time until its next turn, s."""
        wanted, joint = sdo.drive.temperature, sdo.drive.joint
        assert wanted is not None
        try:
            value = sdo.poll(wanted.index, wanted.subindex, CODES[wanted.type], ANSWER_S)
        except ArmidentError:
            self._celsius.pop(joint, None)
            return self._rest_s
        if value is not None:
            self._celsius[joint] = value * wanted.scale
        return wanted.every_s
