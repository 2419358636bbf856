"""Choice of the supervision of a drive: node guarding asks once in a heartbeat period."""

from typing import Any, cast

import pytest

from armident.configs import SessionConfig, load_session
from armident.drivers.canopen import node_supervision as module
from armident.drivers.canopen.network import NodeNetwork
from armident.drivers.canopen.node_supervision import HEARTBEAT_MARGIN, HEARTBEATS_MISSED, NodeSupervision
from armident.drivers.canopen.objects import NmtState
from armident.drivers.canopen.sdo import DriveSdo


class Bus:
    """Clock, and a drive without heartbeat that answers node guarding at a request, or never (0)."""

    def __init__(self, session: SessionConfig, answers_at: int) -> None:
        self.now, self.asked, self.remarks = 0.0, list[float](), list[str]()
        self.drive, self.heartbeat_ms = session.drives[0], None
        self.answers_at = answers_at
        self.supervision = NodeSupervision(session, {bus.channel: cast(NodeNetwork, self) for bus in session.all_buses})

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def guard(self, node_id: int) -> None:
        assert node_id == self.drive.node_id
        self.asked.append(self.now)
        if len(self.asked) == self.answers_at:
            self.supervision.nmt[self.drive.joint] = NmtState.OPERATIONAL

    def remark(self, text: str) -> None:
        self.remarks.append(text)


@pytest.mark.parametrize(
    ("answers_at", "remark"),
    [(1, "supervised by node guarding every 100 ms"), (2, "supervised by node"), (0, "its failure is not detected")],
)
def test_a_drive_without_heartbeat_is_asked_once_in_a_period_until_it_answers(
    monkeypatch: pytest.MonkeyPatch, answers_at: int, remark: str
) -> None:
    session = load_session("tx40_cell.yaml")
    bus, period = Bus(session, answers_at), session.heartbeat_ms * 1e-3
    monkeypatch.setattr(module, "time", cast(Any, bus))
    bus.now = 100.0
    bus.supervision.add(cast(DriveSdo, bus))
    (said,) = bus.remarks
    assert remark in said
    limit = HEARTBEATS_MISSED * period + HEARTBEAT_MARGIN
    # A request at once, and one after every period until the drive answers or counts as silent.
    assert bus.asked[0] == 100.0
    assert all(second - first > period for first, second in zip(bus.asked, bus.asked[1:], strict=False))
    assert len(bus.asked) == (answers_at or int(limit / period))
