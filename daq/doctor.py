"""The command ``armident doctor``: checks session and machine before a command, and names the remedies."""

import json
import os
import shutil
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from armident.compiled import BASELINE, missing
from armident.configs import (
    ArmidentError,
    ConfigError,
    RobotConfig,
    SessionConfig,
    config_path,
    load_robot,
    load_session,
    load_trajectory,
)
from armident.configs.blanks import blank_lines, needed, pattern
from armident.configs.implausible import implausible_values
from armident.configs.loading import is_session, load_inertials
from armident.configs.schema.session import Bus
from armident.daq.capture.recording_files import chunk_duration_ns
from armident.daq.identity.plant import of_session
from armident.daq.matching.streams import captured_streams, unknown_phase
from armident.daq.recording.clock import clock_state
from armident.daq.streaming.zenoh_session import configuration, endpoints, unreadable_files
from armident.drivers.can.interface import SYSFS, is_can, is_up
from armident.drivers.can.socketcan import RECEIVE_BUFFER, RawSocket
from armident.drivers.can.timestamps import has_hardware_timestamps
from armident.drivers.canopen.bus_load import check_fits
from armident.drivers.canopen.eds import read_eds
from armident.drivers.canopen.objects import TPDO_COMMUNICATION
from armident.drivers.canopen.pdo_mapping import TIMERS
from armident.drivers.vcan.interfaces import have_socketcan

Verdict = Literal["ok", "warning", "failed"]
Command = Literal["capture", "import", "identify", "trajectory", "robot"]
"""Commands whose needs are checked."""

_LEAST_HOURS = 24.0
"""Recording time for which the disk should have space, h."""

_CHUNKS = 20
"""Number of chunks that are written to measure the speed of the disk."""


@dataclass(frozen=True)
class Check:
    """Result of one check; ``failed``: a capture would not run. The message has the findings and the remedy."""

    name: str
    verdict: Verdict
    message: str


def checks_for(config: str | Path, command: Command) -> list[Check]:
    """Check everything that a command needs of a robot or session configuration; ``capture`` needs a session."""
    if command == "capture":
        return run_checks(config)
    try:
        path = config_path(config)
        session = load_session(path, "") if is_session(path) else None
        robot = load_robot(path if session is None else session.robot, "")
    except ArmidentError as error:
        return [Check("configuration", "failed", str(error))]
    of_session = () if session is None else session.blanks
    missing = (*needed(of_session, command), *robot.blanks_for(command))
    checks = [Check("configuration", "ok", f"{config}: robot {robot.name}, {robot.n} joints")]
    checks += [Check("blank", "failed", line) for line in blank_lines(missing)]
    checks += _robot(path if session is None else session.robot, robot)
    if command == "trajectory" and not missing:
        try:
            robot.check_movable(str(path))
        except ConfigError as error:
            checks.append(Check("limits", "failed", str(error)))
    later = [key for key in (*of_session, *robot.blanks) if key not in missing]
    if later:
        checks.append(Check("not needed yet", "ok", ", ".join(dict.fromkeys(map(pattern, later)))))
    return checks


def run_checks(config: str | Path) -> list[Check]:
    """Check everything that a capture of a session needs; nothing is sent, and only a probe file is written."""
    try:
        session = load_session(config, "")
        robot = load_robot(session.robot, "")
        blanks = (*needed(session.blanks, "capture"), *robot.blanks_for("capture"))
    except ArmidentError as error:
        return [Check("configuration", "failed", str(error)), _installation(), _clock()]
    if blanks:
        return [*(Check("blank", "failed", line) for line in blank_lines(blanks)), _installation(), _clock()]
    try:
        captured_streams(session, robot)
        if session.setpoints is not None:
            trajectory = load_trajectory(session.setpoints.trajectory)
            trajectory.check(robot, str(session.setpoints.trajectory))
    except ArmidentError as error:
        return [Check("configuration", "failed", str(error)), *_data_sheets(session), _installation(), _clock()]
    checks = [Check("configuration", "ok", f"{config}: cell {session.cell}, robot {robot.name}")]
    checks += _robot(session.robot, robot)
    foreign = session.sync.role == "consumer" and not session.sync.counter
    phase = unknown_phase(session) if foreign else None
    if phase is not None:
        checks.append(Check("sync", "warning", phase))
    checks += [*_data_sheets(session), _bus_load(session, config)]
    for bus in session.all_buses:
        checks += _interface(bus)
    checks += [_installation(), _clock()]
    checks += [*_disk(session, robot), *_zenoh(session), *_metrics(session), *_keys(session)]
    return checks


def _robot(path: str | Path, robot: RobotConfig) -> Iterator[Check]:
    """Check the masses of the robot's URDF, and its values against those of known arms."""
    try:
        load_inertials(path)
    except ConfigError as error:
        yield Check("robot", "warning", str(error))
    yield from (Check("robot", "warning", line) for line in implausible_values(robot))


def _data_sheets(session: SessionConfig) -> Iterator[Check]:
    """Check that the EDS of every drive can be read, and repeat what it leaves out."""
    nodes: dict[Path, int] = {}
    for drive in session.drives:
        nodes.setdefault(drive.eds, drive.node_id)
    for file, node_id in nodes.items():
        try:
            sheet = read_eds(file, node_id)
        except ConfigError as error:
            yield Check("eds", "failed", str(error))
            continue
        fixed = [
            f"TPDO{stream.tpdo} keeps its {name} of {timer.default * unit_ms:g} ms, which is read-only: {effect}"
            for stream in session.streams.values()
            for sub, (name, unit_ms, effect) in TIMERS.items()
            if (timer := sheet.objects.get_variable(TPDO_COMMUNICATION + stream.tpdo - 1, sub)) is not None
            and timer.default
            and not timer.writable
        ]
        if sheet.remarks or fixed:
            yield Check("eds", "warning", f"{file}: {'; '.join([*sheet.remarks, *fixed])}")
        else:
            yield Check("eds", "ok", f"{file.name}: {len(sheet.objects)} objects")


def _bus_load(session: SessionConfig, config: str | Path) -> Check:
    speeds = [
        f"{bus.bitrate / 1e6:g}" + (f"/{bus.data_bitrate / 1e6:g}" if bus.data_bitrate else "")
        for bus in session.all_buses
        if bus.bitrate is not None
    ]
    if not speeds:
        return Check("bus load", "ok", "virtual bus, without a bit rate to exceed")
    try:
        check_fits(session, str(config))
    except ConfigError as error:
        return Check("bus load", "failed", str(error))
    return Check("bus load", "ok", f"fits {', '.join(speeds)} Mbit/s even in the worst case")


def _interface(bus: Bus) -> Iterator[Check]:
    """Check interface, state, bit rates, time stamps and receive buffer of a bus."""
    name = bus.channel
    if bus.interface == "udp_multicast":
        yield Check(
            "bus",
            "warning",
            "UDP multicast instead of CAN, which may lose frames and has no kernel times; use it for trials only",
        )
        return
    if not have_socketcan():
        yield Check("bus", "failed", "this kernel has no SocketCAN; try: sudo modprobe -a can_raw vcan")
        return
    if not (SYSFS / name).exists():
        have = ", ".join(sorted(path.name for path in SYSFS.iterdir() if is_can(path.name))) or "none"
        yield Check("bus", "failed", f"no interface {name}; CAN interfaces here: {have}")
        return
    if not is_up(name):
        yield Check("bus", "failed", f"{name} is down; try: sudo ip link set {name} up")
        return
    details = _link(name)
    for key, wanted in (("bittiming", bus.bitrate), ("data_bittiming", bus.data_bitrate)):
        timing = details.get(key)
        actual = timing.get("bitrate") if isinstance(timing, dict) else None
        if wanted is not None and actual is not None and actual != wanted:
            yield Check("bus", "failed", f"{name} runs at {actual} bit/s ({key}), the configuration has {wanted}")
            return
    state = details.get("state")
    if state not in (None, "ERROR-ACTIVE"):
        yield Check("bus", "warning", f"{name} is {state}: check its cabling and termination")
        return
    timing = details.get("bittiming")
    rate = f" at {timing['bitrate']} bit/s" if isinstance(timing, dict) and "bitrate" in timing else ""
    clock = "hardware" if has_hardware_timestamps(name) else "software"
    yield Check("bus", "ok", f"{name} is up{rate}, {clock} time stamps")
    yield _receive_buffer(bus)


def _link(name: str) -> dict[str, object]:
    """Return state and bit timing of a CAN interface from `ip`; empty if that fails."""
    try:
        done = subprocess.run(
            ["ip", "-json", "-details", "link", "show", "dev", name],
            capture_output=True,
            text=True,
            check=True,
            timeout=5,
        )
        data = json.loads(done.stdout)[0].get("linkinfo", {}).get("info_data", {})
    except (OSError, subprocess.SubprocessError, ValueError, LookupError):
        return {}
    return dict(data)


def _receive_buffer(bus: Bus) -> Check:
    """Check the size of the receive buffer, which holds the frames while the capture does not run."""
    try:
        with RawSocket(bus.channel, fd=bus.fd) as receiver:
            given = receiver.receive_buffer
    except ArmidentError as error:
        return Check("receive buffer", "failed", str(error))
    if given >= RECEIVE_BUFFER:
        return Check("receive buffer", "ok", f"{given / 1e6:.1f} MB")
    return Check(
        "receive buffer",
        "warning",
        f"the kernel gives {given / 1e6:.1f} of {RECEIVE_BUFFER / 1e6:.1f} MB: frames may be dropped while the machine "
        f"is busy. Give the capture CAP_NET_ADMIN, or: sudo sysctl net.core.rmem_max={RECEIVE_BUFFER}",
    )


def _installation() -> Check:
    """Check that the kernels of a capture are compiled for this machine."""
    absent = missing("armident.daq.matching.pdo_matching", "armident.drivers.canopen.sync_loop")
    if absent:
        return Check(
            "installation",
            "warning",
            f"armident {version('armident')} has no machine code of {', '.join(absent)}: a wheel has it for processors "
            f"with the features of {BASELINE}. It is compiled at the first start, or now: "
            f"{sys.executable} -m armident.compiled",
        )
    return Check("installation", "ok", f"armident {version('armident')}, kernels are compiled")


def _clock() -> Check:
    """Check source and synchronisation of the system clock."""
    source = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    name = source.read_text().strip() if source.is_file() else "unknown"
    try:
        state = clock_state()
    except OSError as error:
        return Check("clock", "warning", f"source {name}; its state is unknown: {error.strerror}")
    if not state.synchronised:
        return Check(
            "clock", "warning", f"source {name}, not synchronised: times of several machines drift apart; run chrony"
        )
    error_ms, offset = state.error_us * 1e-3, state.offset_us
    return Check("clock", "ok", f"source {name}, synchronised, {offset:+.1f} us off, error about {error_ms:.3g} ms")


def _disk(session: SessionConfig, robot: RobotConfig) -> Iterator[Check]:
    """Check that recordings can be written, the speed of the disk, and its free space."""
    folder = session.recording.directory
    rate = (
        sum(s.layout.record[0].itemsize / s.layout.every for s in captured_streams(session, robot))
        / session.sync_period
    )
    span_s = chunk_duration_ns(session.recording) * 1e-9
    probe = folder / f".armident-doctor.{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            times = _write_times(probe, round(rate * span_s))
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        yield Check("recordings", "failed", f"{folder}: cannot be written: {error.strerror}")
        return
    yield _speed(times, span_s)
    free = shutil.disk_usage(folder).free
    hours = free / rate / 3600
    found = f"{folder}: {free / 1e9:.1f} GB free, at least {hours:.0f} h ({rate * 3.6e-6:.1f} GB/h before compression)"
    options = session.recording
    if hours < _LEAST_HOURS and options.keep_days is None and options.min_free_gb is None:
        yield Check(
            "recordings", "warning", f"{found}; set recording.min_free_gb or keep_days to delete old recordings"
        )
    elif options.min_free_gb is not None and free < options.min_free_gb * 1e9:
        yield Check(
            "recordings",
            "warning",
            f"{found}, less than min_free_gb {options.min_free_gb:g}: old captures will be deleted",
        )
    else:
        yield Check("recordings", "ok", found)
    if options.copied_to is not None and not options.copied_to.is_dir():
        yield Check("recordings", "warning", f"copied_to: {options.copied_to}: no such folder: nothing will be deleted")


def _write_times(probe: Path, size: int) -> list[float]:
    """Return the times in which chunks of ``size`` bytes are written and synced, s."""
    times, content = [], os.urandom(size)
    with probe.open("xb", buffering=0) as file:
        for _ in range(_CHUNKS):
            begun = time.monotonic()
            file.write(content)
            os.fdatasync(file.fileno())
            times.append(time.monotonic() - begun)
    return times


def _speed(times: list[float], span_s: float) -> Check:
    """Check the times of writing chunks (s) against the time span of a chunk (s)."""
    median, worst = statistics.median(times), max(times)
    found = (
        f"{1e3 * span_s:.0f} ms of rows are written and synced in {1e3 * median:.2g} ms, {1e3 * worst:.2g} ms at worst"
    )
    if median > 0.5 * span_s:
        return Check("disk", "warning", f"{found}: too slow; try a larger recording.chunk_ms (a crash loses more then)")
    return Check("disk", "ok", found)


def _zenoh(session: SessionConfig) -> Iterator[Check]:
    """Check the configuration of Zenoh, and that the ports on which the capture listens are free."""
    try:
        config = configuration(session, "capture")
        unreadable = unreadable_files(config)
    except ConfigError as error:
        yield Check("zenoh", "failed", str(error))
        return
    if unreadable:
        where = session.zenoh.config or "keys"
        yield Check("zenoh", "failed", f"{where}: cannot be read: {', '.join(unreadable)}")
        return
    if session.zenoh.config is not None:
        yield Check("zenoh", "ok", "configured by the session")
        return
    if config.get_json("mode") == '"client"':
        yield Check("zenoh", "ok", f"client of {', '.join(session.zenoh.connect)} by mutual TLS")
        return
    places = session.zenoh.listen or (endpoints(session)["capture"],)
    addresses = [place.partition("/")[2] for place in places if place.startswith(("tcp/", "tls/"))]
    taken = {address: reason for address in addresses if (reason := _taken(address)) is not None}
    for address, reason in taken.items():
        yield Check("zenoh", "warning", f"{address}: {reason}; is a capture of this cell running?")
    if not taken:
        default = f"peers on loopback, port {addresses[0].rpartition(':')[2]}" if not session.zenoh.listen else None
        yield Check("zenoh", "ok", default or f"listens at {', '.join(places)}")


def _metrics(session: SessionConfig) -> Iterator[Check]:
    """Check that the port of the metrics is free, and another than that of Zenoh."""
    options = session.metrics
    address = f"{options.address}:{options.port}"
    same = {address, f"0.0.0.0:{options.port}", f"[::]:{options.port}"}
    both = [place for place in session.zenoh.listen if place.partition("/")[2] in same]
    if options.port and both:
        yield Check("metrics", "failed", f"metrics.port and zenoh.listen: both would listen at {both[0]}")
    elif options.port and (reason := _taken(address)) is not None:
        yield Check("metrics", "failed", f"{address}: {reason}; is a capture running? metrics.port chooses another")


def _taken(address: str) -> str | None:
    """Return the reason why no program can listen on a TCP port, ``HOST:PORT``; ``None`` if it is free."""
    host, _, port = address.rpartition(":")
    try:
        family, kind, _, _, place = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except OSError as error:
        return error.strerror or str(error)
    return None


def _keys(session: SessionConfig) -> Iterator[Check]:
    """Check the keys of the plant: a capture records without them, hence an expired certificate is a warning."""
    for each in of_session(session, datetime.now(UTC)):
        yield Check("keys", "ok" if each.verdict == "ok" else "warning", each.message)


def doctor(config: str, as_json: bool, command: Command = "capture") -> None:
    """Run ``armident doctor``: print the checks; ConfigError if one failed, as the command would not run."""
    checks = checks_for(config, command)
    if as_json:
        print(json.dumps([{"what": c.name, "verdict": c.verdict, "found": c.message} for c in checks]))
    else:
        for check in checks:
            print(f"{check.verdict:8} {check.name}: {check.message}")
    failed = dict.fromkeys(check.name for check in checks if check.verdict == "failed")
    if failed:
        what = "a capture" if command == "capture" else command
        raise ConfigError(f"{config}: {what} would not run: {', '.join(failed)}")
