"""Schema of a session: buses, drives, streams, recording, publication and identification."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from armident.configs.schema.base import FrozenModel, WithBlanks
from armident.configs.schema.robot import JointName, Name, Positive

ObjectName = Literal["position", "velocity", "current", "torque", "demand", "status"]
Every = Annotated[int, Field(ge=1, le=240)]


class Bus(FrozenModel):
    """A CAN bus.

    Parameters
    ----------
    interface, channel
        Kind of bus, and its interface name or multicast address.
    bitrate
        Nominal bit rate, bit/s; ``None`` on a virtual bus, which has none.
    fd
        ``True`` if TPDOs are CAN FD frames of up to 64 bytes; all other frames are classic.
    data_bitrate
        Bit rate of the data phase of CAN FD frames, bit/s; ``None`` on a virtual bus.
    """

    interface: Literal["socketcan", "udp_multicast"] = "socketcan"
    channel: str = "vcan0"
    bitrate: Annotated[int, Field(gt=0)] | None = None
    fd: bool = False
    data_bitrate: Annotated[int, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.data_bitrate is not None and not self.fd:
            raise ValueError(f"bus {self.channel}: data_bitrate: only a bus with fd: true has one")
        if self.fd and (self.bitrate is None) != (self.data_bitrate is None):
            raise ValueError(f"bus {self.channel}: bitrate and data_bitrate: a bus with fd: true has both or none")
        if self.fd and self.interface != "socketcan":
            raise ValueError(f"bus {self.channel}: fd: {self.interface} carries classic frames only")
        return self


class Sync(FrozenModel):
    """SYNC (CiA 301 section 7.2.5).

    Parameters
    ----------
    role
        ``producer`` if this machine sends SYNC, ``consumer`` if another node does.
    period_us
        SYNC period, us.
    counter
        Overflow of the SYNC counter (1019h), 2 to 240; 0: SYNC has no counter.
    source
        Timer of the producer: ``loop`` in this process, or ``kernel`` (CAN_BCM).
    """

    role: Literal["producer", "consumer"] = "producer"
    period_us: Annotated[int, Field(ge=100, le=1_000_000)] = 200
    counter: Annotated[int, Field(ge=0, le=240)] = 240
    source: Literal["loop", "kernel"] = "loop"

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.counter == 1:
            raise ValueError("counter: expected 0 (SYNC without a counter) or 2 to 240 (CiA 301, 1019h)")
        return self


class Temperature(FrozenModel):
    """Object of a drive that holds its temperature.

    Parameters
    ----------
    index, subindex, type
        The object and its data type.
    scale
        Degrees Celsius per unit.
    every_s
        Polling interval, s.
    """

    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    subindex: Annotated[int, Field(ge=0, le=255)] = 0
    type: Literal["int8", "uint8", "int16", "uint16", "int32", "uint32"] = "int16"
    scale: Positive = 1.0
    every_s: Annotated[float, Field(ge=1, le=3600)] = 10.0


class DriveNode(FrozenModel):
    """One CANopen node and the joint whose motor it drives.

    Parameters
    ----------
    joint
        Name of the joint.
    node_id
        CANopen node id.
    eds
        Electronic data sheet of the drive.
    bus
        Channel of the node's bus; required if there are several buses.
    temperature
        Object that holds the drive's temperature; ``None``: not polled.
    """

    joint: JointName
    node_id: Annotated[int, Field(ge=1, le=127)]
    eds: Path
    bus: str | None = None
    temperature: Temperature | None = None


class Stream(FrozenModel):
    """One TPDO of every drive, recorded as the topic of the stream's name.

    Parameters
    ----------
    tpdo
        Number of the TPDO.
    every
        Number of SYNCs between two TPDOs.
    pack
        Number of samples per TPDO: the drive samples at every SYNC and sends the last ``pack`` samples together.
    objects
        Objects mapped into the TPDO, in this order.
    """

    tpdo: Annotated[int, Field(ge=1, le=4)]
    every: Every = 1
    pack: Annotated[int, Field(ge=1, le=64)] = 1
    objects: Annotated[tuple[ObjectName, ...], Field(min_length=1)]

    @field_validator("objects")
    @classmethod
    def _each_once(cls, objects: tuple[ObjectName, ...]) -> tuple[ObjectName, ...]:
        if len(set(objects)) < len(objects):
            raise ValueError(f"each object once, found {', '.join(objects)}")
        return objects


class Setpoints(FrozenModel):
    """Position set points (607Ah) in cyclic synchronous position mode, interpolated by the drives (60C2h).

    Parameters
    ----------
    rpdo
        Number of the RPDO.
    every
        Number of SYNCs between two set points.
    trajectory
        File of the reference trajectory.
    repeat
        Number of runs of the trajectory.
    settle_s
        Time at rest before and after the trajectory, s.
    """

    rpdo: Annotated[int, Field(ge=1, le=4)] = 1
    every: Every = 5
    trajectory: Path
    repeat: Annotated[int, Field(ge=1)] = 1
    settle_s: Annotated[float, Field(ge=0)] = 0.5


TriggerName = Literal["emcy", "heartbeat_lost", "bus", "command"]


class Trigger(FrozenModel):
    """Triggered recording: only samples around events are written.

    Parameters
    ----------
    before_s, after_s
        Recorded time before and after an event, s.
    events
        Kinds of events that trigger.
    """

    before_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    after_s: Annotated[float, Field(gt=0, le=3600)] = 10.0
    events: Annotated[tuple[TriggerName, ...], Field(min_length=1)] = ("emcy", "heartbeat_lost", "command")


class RecordingOptions(FrozenModel):
    """Options of recordings: directory, rotation and retention.

    Parameters
    ----------
    directory
        Directory of the recordings.
    chunk_ms
        Duration of an MCAP chunk, ms.
    drain_ms
        Interval at which received frames are read, ms.
    rotate_mb, rotate_minutes
        Size (MB) and duration (min) after which a new file is begun; a capture without both (null) is one file.
    keep_days, min_free_gb
        Age (days) and free space (GB) that delete the oldest files; without both nothing is deleted.
    copied_to
        Folder to which files are copied before they may be deleted; ``None``: no copy is waited for.
    keep_results_days
        Age (days since the announcement) at which the worker deletes results; ``None``: never.
    preview_hz
        Rate of the preview channels in SI units for viewers, samples/s; 0: none.
    trigger
        Triggered recording; ``None``: everything is written.
    """

    directory: Path = Path("recordings")
    chunk_ms: Annotated[int, Field(ge=10, le=1000)] = 100
    drain_ms: Annotated[int, Field(ge=1, le=100)] = 20
    rotate_mb: Annotated[float, Field(ge=1)] | None = None
    rotate_minutes: Annotated[float, Field(gt=0)] | None = 30.0
    keep_days: Annotated[float, Field(gt=0)] | None = None
    min_free_gb: Annotated[float, Field(gt=0)] | None = None
    copied_to: Path | None = None
    keep_results_days: Annotated[float, Field(gt=0)] | None = None
    preview_hz: Annotated[float, Field(ge=0, le=1000)] = 50.0
    trigger: Trigger | None = None


class ZenohOptions(FrozenModel):
    """Options of Zenoh; by default a peer on loopback.

    Parameters
    ----------
    config
        Zenoh configuration file (JSON5).
    listen, connect
        Endpoints to listen on and to connect to.
    commands
        ``True`` if remote commands are accepted.
    queue_blocks
        Maximum number of blocks that wait for publication.
    cache_blocks
        Number of published blocks kept for subscribers that missed them.
    keys
        Folder of the plant's keys, in place of ``ARMIDENT_KEYS`` and ``/etc/armident/keys``.
    """

    config: Path | None = None
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    commands: bool = False
    queue_blocks: Annotated[int, Field(ge=16)] = 512
    cache_blocks: Annotated[int, Field(ge=0)] = 4096
    keys: Path | None = None


class MetricsOptions(FrozenModel):
    """Endpoint for Prometheus.

    Parameters
    ----------
    port
        TCP port; ``None``: no endpoint.
    address
        Address to listen on; loopback by default.
    """

    port: Annotated[int, Field(ge=0, le=65_535)] | None = None
    address: str = "127.0.0.1"


class SessionConfig(WithBlanks):
    """Session of one cell; relative paths are relative to the file that contains them.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the file format.
    cell
        Name of the cell, part of the Zenoh keys.
    robot
        Robot configuration.
    bus, buses
        The only bus, or all of several buses.
    sync
        SYNC producer and period.
    drives
        CANopen nodes, one per joint.
    emcy_texts
        Texts of vendor-specific emergency error codes.
    heartbeat_ms
        Heartbeat period of the drives (1017h), ms.
    sdo_timeout_s
        Longest wait for an SDO answer, s.
    boot_timeout_s
        Longest wait at the start of a capture for drives that do not answer yet, s.
    streams
        TPDOs by stream name; ``samples`` is required.
    setpoints
        Reference trajectory that is played; ``None``: none.
    recording, zenoh, metrics
        Options of recordings, Zenoh and Prometheus.
    identification
        Options of the worker by their names in ``armident.identify``, which checks them.
    blanks
        Keys that the file marks as blank.
    """

    schema_: Literal["armident/session/1"] = Field(alias="schema")
    cell: Name
    robot: Path
    bus: Bus = Bus()
    buses: tuple[Bus, ...] = ()
    sync: Sync = Sync()
    drives: Annotated[tuple[DriveNode, ...], Field(min_length=1)]
    emcy_texts: dict[Annotated[int, Field(ge=0, le=0xFFFF)], str] = Field(default_factory=dict)
    heartbeat_ms: Annotated[int, Field(ge=10, le=60_000)] = 100
    sdo_timeout_s: Positive = 1.0
    boot_timeout_s: Annotated[float, Field(ge=0, le=600)] = 5.0
    streams: dict[Name, Stream]
    setpoints: Setpoints | None = None
    recording: RecordingOptions = RecordingOptions()
    zenoh: ZenohOptions = ZenohOptions()
    metrics: MetricsOptions = MetricsOptions()
    identification: dict[str, bool | int | float | str | None] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        self._check_buses()
        if len({d.joint for d in self.drives}) != len(self.drives):
            raise ValueError("drives: each joint has one drive")
        tpdos = [s.tpdo for s in self.streams.values()]
        if len(set(tpdos)) != len(tpdos):
            raise ValueError("streams: each stream needs a tpdo of its own")
        if "samples" not in self.streams or self.streams["samples"].every != 1:
            raise ValueError("streams: a stream named 'samples' with every: 1 is required")
        intervals = {f"streams.{k}.every": s.every for k, s in self.streams.items()}
        intervals |= {f"streams.{k}.pack": s.pack for k, s in self.streams.items()}
        if self.setpoints is not None:
            intervals["setpoints.every"] = self.setpoints.every
        for label, interval in intervals.items():
            if self.sync.counter and self.sync.counter % interval:
                raise ValueError(f"{label}: {interval} does not divide sync.counter {self.sync.counter}")
        for name, stream in self.streams.items():
            if stream.pack > 1 and stream.every > 1:
                raise ValueError(f"streams.{name}: pack needs every: 1; a packed sample is taken at every SYNC")
        if self.sync.source == "kernel":
            self._check_kernel_sync()
        return self

    def _check_buses(self) -> None:
        channels = [bus.channel for bus in self.all_buses]
        if len(set(channels)) != len(channels):
            raise ValueError("buses: each needs a channel of its own")
        for k, drive in enumerate(self.drives):
            if drive.bus is None and len(channels) > 1:
                raise ValueError(f"drives[{k}].bus: expected one of {', '.join(channels)}; there are several buses")
            if drive.bus is not None and drive.bus not in channels:
                raise ValueError(f"drives[{k}].bus: {drive.bus!r} is not among the buses ({', '.join(channels)})")
        nodes = [(self.bus_of(drive).channel, drive.node_id) for drive in self.drives]
        if len(set(nodes)) != len(nodes):
            raise ValueError("drives: node_id must be unique on its bus")
        idle = sorted(set(channels) - {channel for channel, _ in nodes})
        if idle:
            raise ValueError(f"buses: no drive is on {', '.join(idle)}")
        if len(channels) > 1 and any(bus.interface != "socketcan" for bus in self.all_buses):
            raise ValueError("buses: several buses need interface socketcan; times of others cannot be compared")

    def _check_kernel_sync(self) -> None:
        if self.sync.role != "producer":
            raise ValueError("sync.source: only who sends SYNC (role producer) chooses its source")
        if len(self.all_buses) > 1:
            raise ValueError("sync.source: the kernel keeps a timer per bus, and they drift apart; expected loop")
        if self.bus_of(self.drives[0]).interface != "socketcan":
            raise ValueError("sync.source: kernel needs interface socketcan")
        if self.setpoints is not None:
            raise ValueError("sync.source: set points go out behind SYNC, which the kernel cannot do; expected loop")

    @property
    def all_buses(self) -> tuple[Bus, ...]:
        """All buses of the session."""
        return self.buses or (self.bus,)

    def bus_of(self, drive: DriveNode) -> Bus:
        """Bus of a drive.

        Parameters
        ----------
        drive
            A drive of the session.
        """
        return next((bus for bus in self.all_buses if bus.channel == drive.bus), self.all_buses[0])

    def drives_on(self, bus: Bus) -> tuple[DriveNode, ...]:
        """All drives on a bus.

        Parameters
        ----------
        bus
            A bus of the session.
        """
        return tuple(drive for drive in self.drives if self.bus_of(drive) == bus)

    @property
    def sync_period(self) -> float:
        """SYNC period, s."""
        return self.sync.period_us * 1e-6
