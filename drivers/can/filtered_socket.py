"""A few identifiers of a bus in a socket of their own: what is rare, and must not be lost when samples are."""

from collections.abc import Iterator, Sequence
from contextlib import suppress

from armident.configs.errors import ArmidentError
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import STANDARD_ID_MASK, BusDown, FrameBus, Frames, frames
from armident.drivers.can.udp import open_bus

BATCH = 256


class SideSocket:
    """Frames of some identifiers, read when it suits; a bus that was removed is opened again when it is back.

    Parameters
    ----------
    bus
        The bus.
    cob_ids
        What is received.

    Raises
    ------
    ConfigError
        If there is no such bus.
    BusDown
        If the bus is down.
    """

    def __init__(self, bus: Bus, cob_ids: Sequence[int]) -> None:
        self._config, self._cob_ids = bus, tuple(cob_ids)
        self._bus = self._open()
        self._batch = frames(BATCH)
        self._gone = False

    def _open(self) -> FrameBus:
        classic = self._config.model_copy(update={"fd": False, "data_bitrate": None})
        return open_bus(classic, filters=[(cob_id, STANDARD_ID_MASK) for cob_id in self._cob_ids])

    def read(self) -> Iterator[Frames]:
        """What has come, in batches that are good until the next one; nothing while the bus is down or removed."""
        if self._gone:
            with suppress(ArmidentError):
                fresh = self._open()
                self._bus.close()
                self._bus, self._gone = fresh, False
        try:
            while (got := self._bus.receive(self._batch)) > 0:
                yield self._batch[:got]
        except BusDown:
            # A socket whose interface was removed has lost it for good.
            self._gone = not self._bus.bound

    def close(self) -> None:
        """Release the socket."""
        self._bus.close()
