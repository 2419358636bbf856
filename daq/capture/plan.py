"""What a capture is to do, loaded and checked before anything is touched."""

from collections.abc import Callable
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
    """What is to be captured."""

    session: SessionConfig
    robot: RobotConfig
    streams: tuple[CapturedStream, ...]
    trajectory: Trajectory | None
    directory: Path
    duration: float | None = None
    listen_only: bool = False
    config: str | Path | None = None
    """The file of the session, where it may be read again."""

    @property
    def producing(self) -> bool:
        """Whether we send SYNC."""
        return self.session.sync.role == "producer" and not self.listen_only

    @property
    def bus_of(self) -> tuple[int, ...]:
        """Number of the bus of each joint, in the robot's order."""
        return bus_numbers(self.session, self.robot)

    @property
    def overheard(self) -> tuple[int, ...]:
        """Nodes of the joints' drives, in the robot's order; none where they are configured by others."""
        return () if self.listen_only else node_ids(self.session, self.robot)

    def filters(self, bus: int) -> list[Filter]:
        """What the capture wants to see of a bus: SYNC, the TPDOs of its drives, and what others write to these."""
        wanted = [
            COB_SYNC,
            *(COB_SDO_REQUEST + n for n, b in zip(self.overheard, self.bus_of, strict=False) if b == bus),
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
    say: Callable[[str], None] = print,
) -> CapturePlan:
    """Load and check everything a capture needs; with ``sniff_s`` listen for so long for what the drives send.

    Raises
    ------
    ConfigError
        For whatever is wrong with the configuration, the trajectory's limits, or the load of the buses.
    """
    session = load_session(config)
    robot = load_robot(session.robot)
    check_fits(session, str(config))
    if sniff_s is not None:
        if not listen_only:
            raise ConfigError("--sniff: only with --listen-only; otherwise drives are configured as the session says")
        session = discover_pdos(session, sniff_s, say)
    trajectory = None
    if session.setpoints is not None and not listen_only:
        if session.sync.role != "producer":
            raise ConfigError(f"{config}: setpoints need sync.role producer; only who sends SYNC can play them")
        trajectory = load_trajectory(session.setpoints.trajectory)
        trajectory.check(robot, str(session.setpoints.trajectory))
    directory = out if out is not None else session.recording.directory
    streams, again = captured_streams(session, robot), None if sniff_s is not None else config
    return CapturePlan(session, robot, streams, trajectory, directory, duration, listen_only, again)
