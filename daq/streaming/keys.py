"""Zenoh key expressions of a cell (ARCHITECTURE: ``armident/<cell>/<robot>/...``)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Keys:
    """Key expressions of one robot in one cell."""

    cell: str
    robot: str

    @property
    def base(self) -> str:
        """Prefix of every key of this robot."""
        return f"armident/{self.cell}/{self.robot}"

    @property
    def samples(self) -> str:
        """Blocks of raw samples, in the order of the recording."""
        return f"{self.base}/samples"

    @property
    def events(self) -> str:
        """Marks, gaps, EMCY, heartbeat losses (JSON)."""
        return f"{self.base}/events"

    @property
    def health(self) -> str:
        """Rates, gaps, drops, queue depth at 1 Hz (JSON)."""
        return f"{self.base}/health"

    @property
    def status(self) -> str:
        """State of capture and worker, with progress (JSON)."""
        return f"{self.base}/status"

    @property
    def identification(self) -> str:
        """The last identification document (published, and answered to queries)."""
        return f"{self.base}/result/identification"

    @property
    def diagnosis(self) -> str:
        """The last diagnosis document (published, and answered to queries)."""
        return f"{self.base}/result/diagnosis"

    @property
    def recursive(self) -> str:
        """Friction and parameters tracked on the live stream, every second (JSON, published and answered)."""
        return f"{self.base}/result/recursive"

    @property
    def sent(self) -> str:
        """Key without messages; its declaration follows announcements, so that these have been sent."""
        return f"{self.base}/sent"

    def command(self, name: str) -> str:
        """Key of a command to the capture (``save``, ``mark``, ``stop``), which is answered like a query."""
        return f"{self.base}/command/{name}"

    def alive(self, component: str) -> str:
        """Key of the liveliness token of a component (``capture``, ``worker``, ``watch``)."""
        return f"{self.base}/alive/{component}"
