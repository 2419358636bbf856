"""Reception of emergency messages without sending anything (listen-only capture)."""

from contextlib import AbstractContextManager

from armident.configs.schema.session import SessionConfig
from armident.drivers.can.filtered_socket import FilteredSocket
from armident.drivers.canopen.emcy import read_emergencies
from armident.drivers.canopen.master import DriveEvent
from armident.drivers.canopen.objects import COB_EMCY


class EmcyListener(AbstractContextManager["EmcyListener", None]):
    """Receives the emergency messages of a session's drives and sends nothing; use it in a ``with`` block."""

    def __init__(self, session: SessionConfig) -> None:
        self._texts = session.emcy_texts
        self._sockets: list[tuple[FilteredSocket, dict[int, str]]] = []
        try:
            for bus in session.all_buses:
                joints = {drive.node_id: drive.joint for drive in session.drives_on(bus)}
                self._sockets.append((FilteredSocket(bus, [COB_EMCY + node for node in joints]), joints))
        except BaseException:
            self.close()
            raise

    def supervise(self) -> list[DriveEvent]:
        """Events since the last call; never waits."""
        return [
            DriveEvent(
                kind="emcy",
                joint=joints[emcy.node],
                node_id=emcy.node,
                t_ns=emcy.t_ns,
                text=f"node {emcy.node} ({joints[emcy.node]}): {emcy.text(self._texts)}",
                code=emcy.code,
            )
            for socket, joints in self._sockets
            for batch in socket.read()
            for emcy in read_emergencies(batch)
        ]

    def close(self) -> None:
        """Release the sockets."""
        for socket, _ in self._sockets:
            socket.close()

    def __exit__(self, *_: object) -> None:
        """Release the sockets."""
        self.close()
