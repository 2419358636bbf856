"""Plan of a capture, loaded and checked before a bus or a file is opened."""

from dataclasses import dataclass
from pathlib import Path

from armident.configs import (
    ConfigError,
    RobotConfig,
    SessionConfig,
    Trajectory,
    load_robot,
    load_session,
    load_trajectory,
)
from armident.daq.capture.pdo_discovery import discover_pdos
from armident.daq.matching.streams import CapturedStream, bus_numbers, captured_streams, node_ids
from armident.drivers.can.frames import STANDARD_ID_MASK, Filter
from armident.drivers.canopen.bus_load import check_fits
from armident.drivers.canopen.objects import COB_SDO_REQUEST, COB_SYNC


@dataclass(frozen=True)
class CapturePlan:
    """Options of a capture; ``duration``: s, ``None``: until the trajectory ends; ``config``: if it may be reloaded."""

    session: SessionConfig
    robot: RobotConfig
    streams: tuple[CapturedStream, ...]
    trajectory: Trajectory | None
    directory: Path
    duration: float | None = None
    listen_only: bool = False
    config: str | Path | None = None

    @property
    def produces_sync(self) -> bool:
        """True if the capture sends SYNC."""
        return self.session.sync.role == "producer" and not self.listen_only

    @property
    def bus_of(self) -> tuple[int, ...]:
        """Number of the bus of each joint, in the robot's order."""
        return bus_numbers(self.session, self.robot)

    @property
    def sdo_nodes(self) -> tuple[int, ...]:
        """Nodes whose SDO requests the capture reads, in the robot's order; none if it only listens."""
        return () if self.listen_only else node_ids(self.session, self.robot)

    def filters(self, bus: int) -> list[Filter]:
        """Return the filters of bus number ``bus``: SYNC, the TPDOs of its drives, and SDO requests to them."""
        wanted = [
            COB_SYNC,
            *(COB_SDO_REQUEST + n for n, b in zip(self.sdo_nodes, self.bus_of, strict=False) if b == bus),
        ]
        for stream in self.streams:
            wanted += [cob for cob, b in zip(stream.bus.cob_ids, self.bus_of, strict=True) if b == bus]
        return [(can_id, STANDARD_ID_MASK) for can_id in wanted]


def load_plan(
    config: str | Path,
    out: Path | None,
    duration: float | None,
    listen_only: bool,
    sniff_s: float | None = None,
) -> CapturePlan:
    """Return the checked plan of a capture; ConfigError if the trajectory exceeds limits, or a bus is overloaded."""
    session = load_session(config, "capture")
    robot = load_robot(session.robot, "capture")
    check_fits(session, str(config))
    if sniff_s is not None:
        if not listen_only:
            raise ConfigError("--sniff: needs --listen-only; without it, the capture maps the TPDOs itself")
        session = discover_pdos(session, sniff_s)
    trajectory = None
    if session.setpoints is not None and not listen_only:
        if session.sync.role != "producer":
            raise ConfigError(f"{config}: setpoints need sync.role: producer, because each set point follows a SYNC")
        trajectory = load_trajectory(session.setpoints.trajectory)
        trajectory.check(robot, str(session.setpoints.trajectory))
    directory = out if out is not None else session.recording.directory
    streams, again = captured_streams(session, robot), None if sniff_s is not None else config
    return CapturePlan(session, robot, streams, trajectory, directory, duration, listen_only, again)
