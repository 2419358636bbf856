"""Socket for a few identifiers of a bus: rare frames that must not be lost when the sample socket overflows."""

from collections.abc import Iterator, Sequence
from contextlib import suppress

from armident.configs.errors import ArmidentError
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import STANDARD_ID_MASK, BusDown, FrameBus, Frames, frames
from armident.drivers.can.udp import open_bus

BATCH = 256
"""Maximum number of frames per batch."""


class FilteredSocket:
    """Socket for the identifiers ``cob_ids``; reopens a bus whose interface was removed and is back."""

    def __init__(self, bus: Bus, cob_ids: Sequence[int]) -> None:
        self._config, self._cob_ids = bus, tuple(cob_ids)
        self._bus = self._open()
        self._batch = frames(BATCH)
        self._gone = False

    def _open(self) -> FrameBus:
        classic = self._config.model_copy(update={"fd": False, "data_bitrate": None})
        return open_bus(classic, filters=[(cob_id, STANDARD_ID_MASK) for cob_id in self._cob_ids])

    def read(self) -> Iterator[Frames]:
        """Yield received frames in batches that are valid until the next one; none while the bus is down or removed."""
        if self._gone:
            with suppress(ArmidentError):
                fresh = self._open()
                self._bus.close()
                self._bus, self._gone = fresh, False
        try:
            while (got := self._bus.receive(self._batch)) > 0:
                yield self._batch[:got]
        except BusDown:
            # A socket whose interface was removed cannot be used again.
            self._gone = not self._bus.bound

    def close(self) -> None:
        """Release the socket."""
        self._bus.close()
