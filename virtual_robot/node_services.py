"""NMT slave and SDO server of a virtual drive."""

# mypy: disable-error-code="no-untyped-call"
# canopen is typed in part only.

from typing import TYPE_CHECKING

import can
from canopen.nmt import NmtSlave
from canopen.sdo.server import SdoServer

from armident.drivers.canopen.objects import (
    COB_HEARTBEAT,
    COB_SDO_REQUEST,
    COB_SDO_RESPONSE,
    HEARTBEAT_PRODUCER,
    NmtCommand,
    NmtState,
)

if TYPE_CHECKING:
    from armident.virtual_robot.node import Drive

STATE_AFTER: dict[int, NmtState] = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


GUARDING_TOGGLE = 0x80
"""Bit that alternates in the answers of node guarding (CiA 301)."""


class Nmt(NmtSlave):
    """NMT slave (CiA 301, section 7.3.2): a reset ends in pre-operational, after a boot-up message."""

    _toggle = 0

    def on_command(self, can_id: int, data: bytes, timestamp: float) -> None:
        """Execute a command addressed to this node or to all; malformed commands are ignored."""
        if len(data) != 2 or data[1] not in (0, self.id):
            return
        drive: Drive = self._local_node
        if not all([oddity.nmt(data[0]) for oddity in drive.oddities]):
            return
        if data[0] in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            drive.reset(communication_only=data[0] == NmtCommand.RESET_COMMUNICATION)
            self.boot()
            drive.changed()
        elif data[0] in STATE_AFTER:
            self.enter(STATE_AFTER[data[0]])

    def enter(self, state: NmtState) -> None:
        """Enter an NMT state and report it in the heartbeat."""
        self._state = int(state)
        self.update_heartbeat()
        self._local_node.changed()

    def boot(self) -> None:
        """Send the boot-up message, enter pre-operational and start the heartbeat (1017h)."""
        self.stop_heartbeat()
        self._toggle = 0
        self.network.send_message(COB_HEARTBEAT + self.id, b"\0")
        self._state = int(NmtState.PRE_OPERATIONAL)
        self.resume()

    def resume(self) -> None:
        """Start the heartbeat (1017h)."""
        self.start_heartbeat(int.from_bytes(self._local_node.get_data(HEARTBEAT_PRODUCER, 0), "little"))

    def answer_guarding(self) -> None:
        """Answer a request of node guarding: NMT state and toggle bit, unless the node sends a heartbeat."""
        drive: Drive = self._local_node
        if self._send_task is None and all(oddity.answers_guarding for oddity in drive.oddities):
            self.network.send_message(COB_HEARTBEAT + self.id, bytes([self._state | self._toggle]))
            self._toggle ^= GUARDING_TOGGLE

    def stop_heartbeat(self) -> None:
        """Stop the heartbeat, even if its bus is closed already."""
        try:
            super().stop_heartbeat()
        except (can.CanError, OSError):
            self._send_task = None

    def halt(self) -> None:
        """Stop the heartbeat."""
        self.stop_heartbeat()

    @property
    def operational(self) -> bool:
        """``True`` if the node is operational and exchanges PDOs."""
        return bool(self._state == NmtState.OPERATIONAL)

    @property
    def stopped(self) -> bool:
        """``True`` if the node is stopped and reacts to NMT only."""
        return bool(self._state == NmtState.STOPPED)


class Sdo(SdoServer):
    """SDO server that does not answer while the node is stopped, nor requests of other than eight bytes."""

    def __init__(self, node: "Drive") -> None:
        super().__init__(COB_SDO_REQUEST + node.node_id, COB_SDO_RESPONSE + node.node_id, node)
        self._index = self._subindex = 0

    def on_request(self, can_id: int, data: bytes, timestamp: float) -> None:
        """Serve one request."""
        if len(data) != 8 or self._node.nmt.stopped:
            return
        if all([oddity.request(bytes(data)) for oddity in self._node.oddities]):
            super().on_request(can_id, data, timestamp)

    def send_response(self, response: bytes) -> None:
        """Send an answer, as the oddities of the drive change it. ``response``: data bytes of the answer."""
        answers = [bytes(response)]
        for oddity in self._node.oddities:
            answers = [changed for answer in answers for changed in oddity.respond(answer)]
        for answer in answers:
            super().send_response(answer)
