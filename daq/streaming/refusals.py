"""Report of messages that are refused: the first one of a kind, the tenth, the hundredth, and so on."""

import logging
import math
import threading
from collections import Counter


class Refusals:
    """Counts refused messages by kind, from any thread."""

    def __init__(self, log: logging.Logger) -> None:
        self._log, self._lock, self._numbers = log, threading.Lock(), Counter[str]()

    def refuse(self, kind: str, reason: object) -> None:
        """Count a message, and report it if its number is a power of ten."""
        with self._lock:
            self._numbers[kind] += 1
            number = self._numbers[kind]
        if math.log10(number).is_integer():
            self._log.warning("%s%s", reason, f" ({number} times)" if number > 1 else "")

    @property
    def total(self) -> int:
        """Number of refused messages."""
        return self._numbers.total()
