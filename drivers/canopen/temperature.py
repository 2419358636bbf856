"""Temperatures of the drives, read now and then over SDO from where each drive has them, out of everybody's way."""

import threading
import time
from collections.abc import Sequence

from armident.configs.errors import ArmidentError
from armident.drivers.canopen.sdo import DriveSdo

CODES = {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"}
"""Types of an object, as ``struct`` names them."""
ANSWER_S = 0.1
"""How long a drive may take to answer; whoever wants to order it something waits so long at most."""
REST_S = 60.0
"""How long a drive that did not answer is left alone."""


class TemperaturePoll:
    """Reads temperatures in a thread of its own, one drive at a time; use it in a ``with`` block.

    A drive that is just being configured or ordered something is asked another time.

    Parameters
    ----------
    drives
        Those that have a temperature are polled.
    rest_s
        How long a drive that did not answer is left alone.
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
        """Last temperature of each joint's drive that gives one, degrees Celsius."""
        return dict(self._celsius)

    def stop(self) -> None:
        """Ask no more; does not wait."""
        self._over.set()

    def __enter__(self) -> "TemperaturePoll":
        """Poll in a ``with`` block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop, and wait for the last answer."""
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
        """Ask one drive; in how many seconds it is asked again."""
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
