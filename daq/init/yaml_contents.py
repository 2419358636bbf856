"""Contents of ``robot.yaml`` and ``session.yaml``, with remarks and blanks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from armident.configs.blanks import MARK, NEEDS
from armident.configs.schema.robot import RobotConfig
from armident.daq.init.geometry import UPRIGHT, Geometry
from armident.daq.init.recorded_facts import RecordedFacts, moved
from armident.daq.init.yaml_text import Noted
from armident.daq.interchange.si_checks import PASSED

SYNC_US = (100, 1_000_000)
"""Shortest and longest SYNC period of a session, us."""


@dataclass(frozen=True)
class CellFacts:
    """Facts of a cell with CANopen drives, base to tip; ``None`` is left blank, bit rate 0 is a virtual bus."""

    cell: str
    channel: str | None = None
    bitrate: int | None = None
    node_ids: Sequence[int] | None = None
    eds: str | None = None


def robot_content(
    geometry: Geometry,
    facts: RecordedFacts | None,
    signal: str | None = None,
    gravity: tuple[float, float, float] | None = None,
    link_torques: bool = False,
) -> dict[str, Any]:
    """Return the content of ``robot.yaml``; arguments that are ``None`` are taken from recording and geometry."""
    robot = geometry.robot
    content = dict(geometry.content)
    if gravity is not None:
        content["gravity"] = list(gravity)
    elif "gravity" not in content:
        content["gravity"] = Noted(list(UPRIGHT), "assumed: base upright; m/s^2 in the frame of the base")
    hinted: set[str] = set()
    content["joints"] = [
        _joint(entry, robot, k, facts, signal or (facts.signal if facts is not None else None), hinted)
        for k, entry in enumerate(geometry.content["joints"])
    ]
    if link_torques:
        for entry in content["joints"]:
            (entry.value if isinstance(entry, Noted) else entry)["rotor_inertia"] = False
    if robot.transmission is None:
        identity = [[float(i == j) for j in range(robot.n)] for i in range(robot.n)]
        content["transmission"] = Noted(
            identity, "assumed: drives in units of the joints; with gear ratios here, they are in units of the motors"
        )
    order = ("schema", "name", "description", "urdf", "gravity", "joints", "transmission")
    return {key: content[key] for key in (*order, *content) if key in content}


def _joint(
    entry: dict[str, Any], robot: RobotConfig, k: int, facts: RecordedFacts | None, signal: str | None, hinted: set[str]
) -> Any:
    joint = robot.joints[k]
    made = {key: _blank(f"joints[].{key}", hinted) if value == MARK else value for key, value in entry.items()}
    if joint.limits.missing():
        own = dict(made.get("limits", {}))
        for key in joint.limits.missing():
            own[key] = _blank(f"joints[].limits.{key}", hinted)
        if "acceleration" in own and facts is not None and moved(facts, robot)[k]:
            note = "reached in the recording; the arm's own limit is higher"
            own["acceleration"] = Noted(float(f"{facts.acceleration[k]:.3g}"), _once(hinted, note, note))
        made["limits"] = own
    if facts is not None:
        reached = {"velocity": facts.velocity[k], "torque": facts.effort[k] if facts.signal == "torque" else 0.0}
        passed = {key: value for key, value in reached.items() if value > PASSED * getattr(joint.limits, key)}
        for key, value in passed.items():
            source = robot.limit_places[k] or "the source"
            note = f"reached in the recording; {source} has {getattr(joint.limits, key):.4g}"
            made["limits"] = {**made.get("limits", {}), key: Noted(float(f"{value:.3g}"), note)}
    known = entry.get("drive", {})
    if signal is not None and known.get("signal", "current") != signal:
        # Scales of another effort do not hold; the encoder is the same.
        known = {key: value for key, value in known.items() if key == "counts_per_unit"}
    drive: dict[str, Any] = {**known, "signal": signal or known.get("signal", "torque")}
    if drive["signal"] != "torque" and "gain" not in known:
        drive["gain"] = _blank("joints[].drive.gain", hinted)
    for key in ("rated", "counts_per_unit"):
        if key not in known:
            drive[key] = _blank(f"joints[].drive.{key}", hinted)
    made["drive"] = drive
    return made if facts is None else Noted(made, _moved(facts, joint.type, k))


def _blank(key: str, hinted: set[str]) -> Any:
    """Return a blank, with the way to find its value at its first place."""
    return Noted(MARK, _once(hinted, key, NEEDS[key].how))


def _once(hinted: set[str], key: str, note: str) -> str:
    if key in hinted:
        return ""
    hinted.add(key)
    return note


def _moved(facts: RecordedFacts, kind: str, k: int) -> str:
    """Remark on the motion of a joint in the recording."""
    unit, effort = ("rad", "N m") if kind == "revolute" else ("m", "N")
    effort = {"current": "A", "voltage": "V"}.get(facts.signal, effort)
    low, high = facts.position[k]
    return (
        f"in {facts.path.name}: {low:.3g} to {high:.3g} {unit}, {facts.velocity[k]:.3g} {unit}/s, "
        f"{facts.acceleration[k]:.3g} {unit}/s^2, {facts.effort[k]:.3g} {effort}"
    )


def session_content(robot: RobotConfig, signal: str, facts: RecordedFacts | None, cell: CellFacts) -> dict[str, Any]:
    """Return the content of ``session.yaml``; ``signal``: kind of effort that the drives report."""
    hinted: set[str] = set()
    ids = cell.node_ids
    period = round(1e6 / facts.rate_hz) if facts is not None else 0
    known = SYNC_US[0] <= period <= SYNC_US[1]
    sync = {
        "role": "producer",
        "period_us": Noted(period, f"rate of {facts.path.name}, {facts.rate_hz:.6g} Hz")
        if known and facts is not None
        else _blank("sync.period_us", hinted),
        "counter": 240,
    }
    virtual = cell.bitrate == 0
    bus = {
        "interface": "socketcan",
        "channel": cell.channel if cell.channel is not None else _blank("bus.channel", hinted),
        "bitrate": None if virtual else cell.bitrate if cell.bitrate is not None else _blank("bus.bitrate", hinted),
    }
    drives = [
        {
            "joint": joint.name,
            "node_id": ids[k] if ids is not None else _blank("drives[].node_id", hinted),
            "eds": cell.eds if cell.eds is not None else _blank("drives[].eds", hinted),
        }
        for k, joint in enumerate(robot.joints)
    ]
    measured = "torque" if signal == "torque" else "current"
    streams = {
        "samples": {"tpdo": 1, "every": 1, "objects": ["position", measured, "status"]},
        "demand": {"tpdo": 2, "every": 5, "objects": ["demand"]},
    }
    motion = "for a capture that moves the arm: setpoints: {rpdo: 1, every: 5, trajectory: trajectory.yaml}"
    return {
        "schema": "armident/session/1",
        "cell": cell.cell,
        "robot": "robot.yaml",
        "bus": bus,
        "sync": sync,
        "drives": drives,
        "streams": Noted(streams, motion),
    }
