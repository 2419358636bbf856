"""Monitor of a moving arm: checks every frame on its buses against the limits, in compiled code."""

from dataclasses import dataclass

import numpy as np

from armident.compiled import compiled
from armident.configs import ConfigError, RobotConfig, SessionConfig
from armident.configs.schema.session import Stream
from armident.configs.units import counts_per_si
from armident.daq.guard.motion_limits import (
    HEARTBEAT_MARGIN_S,
    HEARTBEATS_MISSED,
    TORQUE_PEAK,
    TORQUE_S,
    TORQUE_SAMPLES,
    VELOCITY_S,
    MotionLimits,
)
from armident.daq.matching.streams import bus_numbers, node_ids
from armident.drivers.can.frames import Frames
from armident.drivers.canopen.emcy import emcy_text
from armident.drivers.canopen.objects import (
    COB_EMCY,
    COB_HEARTBEAT,
    COB_NMT,
    COB_SYNC,
    NmtState,
    TpdoLayout,
    rpdo_cob,
    tpdo_cob,
)

IDENTIFIERS = 2048
"""Number of 11-bit identifiers."""
SYNC, SAMPLE, DEMAND, SETPOINT, EMCY, HEARTBEAT, NMT = range(7)
"""Kinds of frames: DEMAND is a TPDO with the demand of a drive, SETPOINT an RPDO with its target."""

NO_ALARM, POSITION, VELOCITY, TORQUE, FOLLOWING, EMERGENCY, STATE, SILENT, NO_SYNC = range(9)
"""Causes of an alarm."""

ARMED, JOINT, FRAME = range(3)
"""Indices of the state: 1 while set points are played; joint and frame of an alarm."""

LAST, SINCE = range(2)
"""Rows of the state of SYNC on every bus: time of the last one (ns), and number since a set point."""

ARMED_STATE = int(NmtState.OPERATIONAL)


@dataclass(frozen=True)
class Alarm:
    """Reason to stop the drives; ``frame`` is an index in its batch, -1 for missing frames."""

    text: str
    frame: int


class MotionMonitor:
    """Checks all frames on a moving arm's buses, from the first set point to the NMT command that ends the motion."""

    def __init__(self, session: SessionConfig, robot: RobotConfig, limits: MotionLimits) -> None:
        if session.setpoints is None:
            raise ConfigError("setpoints: missing, so the arm does not move; the guard needs a session with set points")
        self._robot, self._limits, n = robot, limits, robot.n
        shape = len(session.all_buses), IDENTIFIERS
        self._kind, self._joint = np.full(shape, -1, np.int64), np.zeros(shape, np.int64)
        self._offsets = np.full(3, -1, np.int64)
        self._identify(session, robot)
        # The newest sample of a packed TPDO is checked.
        pack = session.streams["samples"].pack
        period = session.sync_period * pack
        self._per_count = np.linalg.inv(robot.transmission_matrix) / counts_per_si(robot)
        torque = np.array([joint.drive.gain * joint.drive.rated / 1000.0 for joint in robot.joints])
        self._per_mille = np.ascontiguousarray(robot.transmission_matrix.T * torque)
        velocity, mean = max(1, round(VELOCITY_S / period)), max(TORQUE_SAMPLES // pack, round(TORQUE_S / period), 1)
        self._positions, self._efforts = np.zeros((velocity + 1, n), np.int64), np.zeros((mean, n))
        self._samples = np.zeros(n, np.int64)
        self._velocity_s = velocity * period
        self._every = session.setpoints.every
        self._raw, self._seen = np.zeros((3, n), np.int64), np.zeros(n, np.bool_)
        self._demanded = np.zeros(n, np.bool_)
        self._beat = np.zeros(n, np.int64)
        self._state, self._sync = np.zeros(3, np.int64), np.zeros((2, len(session.all_buses)), np.int64)
        self._vendor = session.emcy_texts
        self._value = np.zeros(2)
        heartbeat = HEARTBEATS_MISSED * session.heartbeat_ms * 1e-3 + HEARTBEAT_MARGIN_S
        self._silence = round(heartbeat * 1e9)

    def _identify(self, session: SessionConfig, robot: RobotConfig) -> None:
        """Set kind and joint of every identifier; the demand is that of the drives if they send it, else the target."""
        nodes = node_ids(session, robot)
        samples = session.streams["samples"]
        at = _byte_offsets(samples)
        if "position" not in at:
            raise ConfigError("streams.samples.objects: the guard needs the position of every drive")
        self._offsets[:] = at["position"], at.get("current", at.get("torque", -1)), 0
        self._kind[:, [COB_SYNC, COB_NMT]] = SYNC, NMT
        assert session.setpoints is not None
        stream_of_demand = None
        for stream in session.streams.values():
            if "demand" in stream.objects and stream is not samples:
                stream_of_demand = stream
        for j, (node, bus) in enumerate(zip(nodes, bus_numbers(session, robot), strict=True)):
            kinds = {
                tpdo_cob(samples.tpdo, node): SAMPLE,
                rpdo_cob(session.setpoints.rpdo, node): SETPOINT,
                COB_EMCY + node: EMCY,
                COB_HEARTBEAT + node: HEARTBEAT,
            }
            if stream_of_demand is not None:
                kinds[tpdo_cob(stream_of_demand.tpdo, node)] = DEMAND
            for identifier, kind in kinds.items():
                self._kind[bus, identifier], self._joint[bus, identifier] = kind, j
        self._own_demand = stream_of_demand is not None
        if stream_of_demand is not None:
            self._offsets[2] = _byte_offsets(stream_of_demand)["demand"]

    def identifiers(self, bus: int) -> list[int]:
        """Return the COB-IDs of a bus that are checked. ``bus``: number of the bus, in the order of the session."""
        return [int(k) for k in np.flatnonzero(self._kind[bus] >= 0)]

    @property
    def armed(self) -> bool:
        """True while set points are played."""
        return bool(self._state[ARMED])

    def check(self, frames: Frames, now_ns: int, bus: int = 0) -> Alarm | None:
        """Check frames (N,), N >= 0, received after ``now_ns`` (monotonic); return the first reason to stop."""
        limits = self._limits
        code = check_batch(
            frames["can_id"], frames["length"], frames["data"], now_ns, bus,
            self._kind[bus], self._joint[bus], self._offsets, self._own_demand, self._every,
            self._raw, self._seen, self._demanded, self._beat, self._silence,
            self._per_count, self._per_mille, self._positions, self._efforts, self._samples, self._velocity_s,
            limits.low, limits.high, limits.velocity, limits.torque, limits.following,
            self._state, self._sync, self._value,
        )  # fmt: skip
        return None if code == NO_ALARM else Alarm(self._text(code), int(self._state[FRAME]))

    def _text(self, code: int) -> str:
        joint = self._robot.joints[int(self._state[JOINT])]
        found, allowed = (float(value) for value in self._value)
        unit, force = ("rad", "N m") if joint.type == "revolute" else ("m", "N")
        if code == POSITION:
            low, high = joint.limits.position
            return f"{joint.name}: position {found:.4f} {unit}, allowed is {low:g} to {high:g}"
        if code == VELOCITY:
            return f"{joint.name}: velocity {found:.3f} {unit}/s, allowed is {allowed:g}"
        if code == TORQUE:
            return f"{joint.name}: torque {found:.1f} {force}, allowed is {allowed:g}"
        if code == FOLLOWING:
            return f"{joint.name}: following error {found:.4f} {unit}, allowed is {allowed:g}"
        if code == EMERGENCY:
            return f"{joint.name}: EMCY {int(found):04X}h, {emcy_text(int(found), self._vendor)}"
        if code == STATE:
            return f"{joint.name}: its drive has left the NMT state operational (state {int(found)})"
        if code == SILENT:
            return f"{joint.name}: no heartbeat for {found:.2f} s"
        return f"no SYNC for {found:.2f} s during the motion; check the capture"


def _byte_offsets(stream: Stream) -> dict[str, int]:
    """Return the first byte of each object in the TPDO of a stream, of the newest sample if it is packed."""
    layout = TpdoLayout.of(stream.objects, "streams", stream.pack, fd=True)
    offset, offsets = layout.size * (stream.pack - 1), {}
    for mapped in layout.objects:
        offsets[mapped.name] = offset
        offset += mapped.bits // 8
    return offsets


@compiled(nogil=False)
def _number(data, k, at, size):  # type: ignore[no-untyped-def]
    """Return the signed little-endian number of ``size`` bytes."""
    value = np.int64(0)
    for b in range(size):
        value |= np.int64(data[k, at + b]) << (8 * b)
    top = np.int64(1) << (8 * size - 1)
    return value - 2 * top if value & top else value


@compiled(
    "i8, i8[:, ::1], b1[::1], b1[::1], f8[:, ::1], f8[:, ::1], i8[:, ::1], f8[:, ::1], i8[::1], f8, f8[::1], "
    "f8[::1], f8[::1], f8[::1], f8[::1], i8[::1], f8[::1]",
    nogil=False,
)
def check_limits(  # type: ignore[no-untyped-def]
    moved, raw, seen, demanded, per_count, per_mille, positions, efforts, samples, velocity_s,
    low, high, velocity, torque, following, state, value,
):  # fmt: skip
    """Check the joints that motor ``moved`` drives; return the cause of an alarm or ``NO_ALARM``.

    ``raw`` int64 (3, n): newest position (counts), effort (per mille of rated) and demand (counts) of each motor.
    ``seen``, ``demanded`` (n,): motors with a position, and a demand. ``per_count``, ``per_mille`` (n, n): joint
    position and torque per count and per mille of the motors. ``positions`` (P, n), ``efforts`` (E, n): rings of the
    last ones, of which ``positions`` span ``velocity_s``. ``samples`` (n,): since the motion began. Limits (n,) as in
    `MotionLimits`. On an alarm, ``state[JOINT]`` is set, and ``value`` (2,) is measured value and limit.
    """
    n, ring = low.size, positions.shape[0]
    for j in range(n):
        if per_count[j, moved] == 0.0 and per_mille[j, moved] == 0.0:
            continue
        q, speed, tau, peak, lag, known = 0.0, 0.0, 0.0, 0.0, 0.0, True
        for m in range(n):
            if per_count[j, m] != 0.0:
                known = known and seen[m]
                q += per_count[j, m] * raw[0, m]
                if samples[m] >= ring:
                    # The oldest sample follows the newest one in the ring.
                    speed += per_count[j, m] * (raw[0, m] - positions[(samples[m] + 1) % ring, m]) / velocity_s
                if demanded[m]:
                    lag += per_count[j, m] * (raw[2, m] - raw[0, m])
            if per_mille[j, m] != 0.0:
                tau += per_mille[j, m] * efforts[:, m].mean()
                peak += per_mille[j, m] * raw[1, m]
        if not known:
            continue
        code = NO_ALARM
        if q < low[j] or q > high[j]:
            code, value[0], value[1] = POSITION, q, 0.0
        elif abs(speed) > velocity[j]:
            code, value[0], value[1] = VELOCITY, speed, velocity[j]
        elif abs(tau) > torque[j] or abs(peak) > TORQUE_PEAK * torque[j]:
            code, value[0], value[1] = TORQUE, tau if abs(tau) > torque[j] else peak, torque[j]
        elif abs(lag) > following[j]:
            code, value[0], value[1] = FOLLOWING, lag, following[j]
        if code != NO_ALARM:
            state[JOINT] = j
            return code
    return NO_ALARM


@compiled(
    "u4[:], u1[:], u1[:, :], i8, i8, i8[::1], i8[::1], i8[::1], b1, i8, i8[:, ::1], b1[::1], b1[::1], i8[::1], "
    "i8, f8[:, ::1], f8[:, ::1], i8[:, ::1], f8[:, ::1], i8[::1], f8, f8[::1], f8[::1], f8[::1], f8[::1], "
    "f8[::1], i8[::1], i8[:, ::1], f8[::1]",
    "u4[::1], u1[::1], u1[:, ::1], i8, i8, i8[::1], i8[::1], i8[::1], b1, i8, i8[:, ::1], b1[::1], b1[::1], "
    "i8[::1], i8, f8[:, ::1], f8[:, ::1], i8[:, ::1], f8[:, ::1], i8[::1], f8, f8[::1], f8[::1], f8[::1], "
    "f8[::1], f8[::1], i8[::1], i8[:, ::1], f8[::1]",
    nogil=False,
)
def check_batch(  # type: ignore[no-untyped-def]
    ids, lengths, data, now, bus, kinds, joints, at, own_demand, every, raw, seen, demanded, beat, silence,
    per_count, per_mille, positions, efforts, samples, velocity_s,
    low, high, velocity, torque, following, state, sync, value,
):  # fmt: skip
    """Check all frames of a batch, then for missing heartbeats and SYNC; return the cause of an alarm.

    ``ids``, ``lengths`` (N,), ``data`` (N, 8) or (N, 64): fields of the frames. ``now``: monotonic ns before they were
    received. ``kinds``, ``joints`` (IDENTIFIERS,): of the frames of each identifier on this bus; kind -1: not checked.
    ``at`` (3,): first byte of position, effort and demand in their TPDOs; -1: absent. ``own_demand``: the drives send
    their demand; else the set points are it. ``every``: SYNCs between set points. ``beat`` (n,): monotonic ns of the
    last heartbeats; lost after ``silence`` ns. ``state`` (3,): 1 while set points are played, joint and frame of an
    alarm (-1: none). ``sync`` (2, B): monotonic ns of the last SYNC, and SYNCs since a set point. Others as in
    `check_limits`.
    """
    for k in range(ids.size):
        if ids[k] >= IDENTIFIERS or kinds[ids[k]] < 0:
            continue
        kind, j = kinds[ids[k]], joints[ids[k]]
        state[JOINT], state[FRAME] = j, k
        updated = False
        if kind == NMT:
            state[ARMED] = 0
        elif kind == SYNC:
            sync[LAST, bus] = now
            sync[SINCE, bus] += 1
        elif kind == HEARTBEAT and lengths[k] >= 1:
            beat[j] = now
            # The highest bit alternates in the answers of node guarding.
            if state[ARMED] and data[k, 0] & 0x7F != ARMED_STATE:
                value[0] = data[k, 0] & 0x7F
                return STATE
        elif kind == EMCY and lengths[k] >= 2:
            error = np.int64(data[k, 0]) | np.int64(data[k, 1]) << 8
            if state[ARMED] and error:
                value[0] = error
                return EMERGENCY
        elif kind == SETPOINT and lengths[k] >= 4:
            if not state[ARMED]:
                state[ARMED] = 1
                sync[LAST, :] = now
                # SYNC is not checked on a bus before its first set point.
                sync[SINCE, :] = every + 2
                beat[:] = now
                demanded[:] = False
                samples[:] = 0
                efforts[:] = 0.0
            sync[SINCE, bus] = 0
            if not own_demand:
                raw[2, j], demanded[j] = _number(data, k, 0, 4), True
        elif kind == DEMAND and lengths[k] >= at[2] + 4:
            raw[2, j], demanded[j], updated = _number(data, k, at[2], 4), True, True
        elif kind == SAMPLE and lengths[k] >= at[0] + 4:
            raw[0, j] = _number(data, k, at[0], 4)
            if at[1] >= 0 and lengths[k] >= at[1] + 2:
                raw[1, j] = _number(data, k, at[1], 2)
            seen[j] = True
            if not state[ARMED]:
                continue
            efforts[samples[j] % efforts.shape[0], j] = raw[1, j]
            samples[j] += 1
            positions[samples[j] % positions.shape[0], j] = raw[0, j]
            updated = True
        if updated and state[ARMED]:
            code = check_limits(
                j, raw, seen, demanded, per_count, per_mille, positions, efforts, samples, velocity_s,
                low, high, velocity, torque, following, state, value,
            )  # fmt: skip
            if code != NO_ALARM:
                return code
    state[FRAME] = -1
    if state[ARMED]:
        for j in range(beat.size):
            if now - beat[j] > silence:
                state[JOINT], value[0] = j, (now - beat[j]) * 1e-9
                return SILENT
        # A master that ends a motion regularly sends SYNC for some time after the last set point.
        for b in range(sync.shape[1]):
            if sync[SINCE, b] <= every + 1 and now - sync[LAST, b] > silence:
                value[0] = (now - sync[LAST, b]) * 1e-9
                return NO_SYNC
    return NO_ALARM
