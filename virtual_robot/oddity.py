"""Deviation of a virtual drive from an ordinary one."""

from armident.configs.schema.session import Bus


class Oddity:
    """Deviation of a virtual drive from an ordinary one; this base class deviates in nothing."""

    answers_guarding = True
    """``True`` if the drive answers node guarding while it sends no heartbeat."""

    def preset(self) -> None:
        """Set objects to other power-on values."""

    def read(self, index: int, subindex: int) -> bytes | None:
        """Bytes that an SDO request reads; ``None``: those of the object. SdoAbortedError if the drive refuses."""
        return None

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Bytes that are stored when an SDO request writes; raises SdoAbortedError if the drive refuses."""
        return data

    def request(self, data: bytes) -> bool:
        """Return ``True`` if an SDO request is served."""
        return True

    def respond(self, data: bytes) -> list[bytes]:
        """Return the answers that are sent for one answer of the SDO server."""
        return [data]

    def nmt(self, command: int) -> bool:
        """Return ``True`` if an NMT command is executed. ``command``: command specifier."""
        return True

    def begin(self, bus: Bus) -> None:
        """Begin to run on a bus."""

    def end(self) -> None:
        """End what was begun."""
