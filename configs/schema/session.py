"""The session: which buses, which drives, what is streamed, recorded, published and identified."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from armident.configs.schema.base import FrozenModel
from armident.configs.schema.robot import Name, Positive

ObjectName = Literal["position", "velocity", "current", "torque", "demand", "status"]
Every = Annotated[int, Field(ge=1, le=240)]


class Bus(FrozenModel):
    """A CAN bus. ``bitrate`` is ``None`` on a virtual bus, which has none.

    With ``fd`` TPDOs are CAN FD frames of up to 64 bytes, whose data go at ``data_bitrate``; all else stays classic.
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
    """SYNC (CiA 301 section 7.2.5): who sends it, how often, and the overflow of its counter (1019h).

    ``source``: who keeps the time where we send it, a loop of our own or the kernel (CAN_BCM).
    """

    role: Literal["producer", "consumer"] = "producer"
    period_us: Annotated[int, Field(ge=100, le=1_000_000)] = 200
    counter: Annotated[int, Field(ge=2, le=240)] = 240
    source: Literal["loop", "kernel"] = "loop"


class Temperature(FrozenModel):
    """Where a drive has its temperature: an object, its type, degrees Celsius per unit; asked every ``every_s``."""

    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    subindex: Annotated[int, Field(ge=0, le=255)] = 0
    type: Literal["int8", "uint8", "int16", "uint16", "int32", "uint32"] = "int16"
    scale: Positive = 1.0
    every_s: Annotated[float, Field(ge=1, le=3600)] = 10.0


class DriveNode(FrozenModel):
    """One CANopen node and the joint whose motor it drives; ``bus`` is its channel, where there are several."""

    joint: Name
    node_id: Annotated[int, Field(ge=1, le=127)]
    eds: Path
    bus: str | None = None
    temperature: Temperature | None = None


class Stream(FrozenModel):
    """One TPDO of every drive, sent on every ``every``-th SYNC, recorded as the topic of this name.

    With ``pack`` the drive takes a sample at every SYNC and sends the last ``pack`` of them in one TPDO.
    """

    tpdo: Annotated[int, Field(ge=1, le=4)]
    every: Every = 1
    pack: Annotated[int, Field(ge=1, le=64)] = 1
    objects: Annotated[tuple[ObjectName, ...], Field(min_length=1)]


class Setpoints(FrozenModel):
    """Position set points (607Ah) in cyclic synchronous position mode, interpolated by the drives."""

    rpdo: Annotated[int, Field(ge=1, le=4)] = 1
    every: Every = 5
    trajectory: Path
    repeat: Annotated[int, Field(ge=1)] = 1
    settle_s: Annotated[float, Field(ge=0)] = 0.5


TriggerName = Literal["emcy", "heartbeat_lost", "bus", "command"]


class Trigger(FrozenModel):
    """Write only around events: what happened up to ``before_s`` before one, and until ``after_s`` after it."""

    before_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    after_s: Annotated[float, Field(gt=0, le=3600)] = 10.0
    events: Annotated[tuple[TriggerName, ...], Field(min_length=1)] = ("emcy", "heartbeat_lost", "command")


class RecordingOptions(FrozenModel):
    """Where and how recordings are written, when a new file is begun, and how long files are kept.

    ``look_hz`` samples per second are there in SI units too, for viewers (0: none). With ``trigger`` only events are
    written. Without ``rotate_mb`` and ``rotate_minutes`` a capture is one file; without ``keep_days`` and
    ``min_free_gb`` nothing is ever deleted.
    """

    directory: Path = Path("recordings")
    chunk_ms: Annotated[int, Field(ge=10, le=1000)] = 100
    drain_ms: Annotated[int, Field(ge=1, le=100)] = 20
    rotate_mb: Annotated[float, Field(ge=1)] | None = None
    rotate_minutes: Annotated[float, Field(gt=0)] | None = None
    keep_days: Annotated[float, Field(gt=0)] | None = None
    min_free_gb: Annotated[float, Field(gt=0)] | None = None
    look_hz: Annotated[float, Field(ge=0, le=1000)] = 50.0
    trigger: Trigger | None = None


class ZenohOptions(FrozenModel):
    """Zenoh: peers on loopback unless ``config`` names a Zenoh configuration file (JSON5)."""

    config: Path | None = None
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    commands: bool = False
    queue_blocks: Annotated[int, Field(ge=16)] = 512
    cache_blocks: Annotated[int, Field(ge=0)] = 4096


class MetricsOptions(FrozenModel):
    """An endpoint for Prometheus; off unless it has a port, and on loopback unless it has another address."""

    port: Annotated[int, Field(ge=0, le=65_535)] | None = None
    address: str = "127.0.0.1"


class IdentificationOptions(FrozenModel):
    """What the worker runs on an experiment; the same names as the options of ``armident identify``."""

    method: Literal["idim-piv", "idim-iv", "idim-ls", "didim", "clie", "cloe", "sep-pem"] = "idim-piv"
    derivatives: Literal["irwsm", "irwsm2", "bandpass"] = "irwsm"
    controller: Literal["crc", "parametric", "known"] = "crc"
    nvr: Positive | Literal["automatic", "cross-validation", "likelihood", "tracking-error"] = "automatic"
    noise_model: Literal["black-box", "grey-box"] = "black-box"
    physical: bool = False


class SessionConfig(FrozenModel):
    """Everything one cell needs; relative paths are relative to the file they stand in."""

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
    streams: dict[Name, Stream]
    setpoints: Setpoints | None = None
    recording: RecordingOptions = RecordingOptions()
    zenoh: ZenohOptions = ZenohOptions()
    metrics: MetricsOptions = MetricsOptions()
    identification: IdentificationOptions = IdentificationOptions()

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
            if self.sync.counter % interval:
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
        """The buses of the session, one or several."""
        return self.buses or (self.bus,)

    def bus_of(self, drive: DriveNode) -> Bus:
        """The bus that a drive is on."""
        return next((bus for bus in self.all_buses if bus.channel == drive.bus), self.all_buses[0])

    def drives_on(self, bus: Bus) -> tuple[DriveNode, ...]:
        """The drives on a bus."""
        return tuple(drive for drive in self.drives if self.bus_of(drive) == bus)

    @property
    def sync_period(self) -> float:
        """Time between two SYNC, s."""
        return self.sync.period_us * 1e-6
