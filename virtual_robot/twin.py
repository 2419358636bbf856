"""Virtual arm of any configuration: what the robot and the session leave open is assumed, and said."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from armident.configs import ConfigError, RobotConfig, SessionConfig, Trajectory, config_path, load_robot, load_session
from armident.configs.loading import is_session, load_inertials
from armident.configs.schema.session import Bus, MetricsOptions, ZenohOptions
from armident.configs.yaml_loader import read_yaml
from armident.virtual_robot.arm_parameters import ArmParameters, arm_parameters
from armident.virtual_robot.drawn_parameters import TORQUE_SHARE, needed_torque
from armident.virtual_robot.offline import effort_of
from armident.virtual_robot.plausible_motion import plausible_trajectory

ASSUMED_POSITION = {"revolute": (-float(np.pi), float(np.pi)), "prismatic": (-0.5, 0.5)}
"""Position limits where the configuration has none, rad or m."""
ASSUMED_VELOCITY = {"revolute": 2.0, "prismatic": 0.5}
"""Velocity limits where the configuration has none, rad/s or m/s: those of a common arm and of a linear axis."""
ASSUMED_RISE_PER_S = 5.0
"""Acceleration limit over the velocity limit where the configuration has none, 1/s; makers state 5 to 8."""
COUNTS_PER_TURN = 2**22
"""Encoder counts per turn of the joint where the configuration has none: 15 bits at the motor, gear of 128."""
COUNTS_PER_METRE = 2e7
"""The same per metre of a prismatic joint, as of the EMPS."""
RATED_SHARE = 0.25
"""Rated value of the drive's signal over that at the torque limit, where the configuration has none, as on the TX40."""
BUS_RANGE = 32.767
"""Largest value of a signal on the bus over the rated one: 16 bits in per mille (CiA 402, 6077h and 6078h)."""
SHARED_HEARTBEAT_MS = 1000
"""Shortest heartbeat period where drives and master share a machine, which may be busy, ms."""
SYNC_PERIOD_US = 1000
"""SYNC period of a session made for a robot, us."""


@dataclass(frozen=True)
class Twin:
    """Virtual arm of a configuration, and its assumptions; ``trajectory``: motion without set points in the session."""

    source: Path
    session: SessionConfig
    robot: RobotConfig
    parameters: ArmParameters
    assumed: tuple[str, ...]
    trajectory: Trajectory | None

    def with_session(self, session: SessionConfig) -> "Twin":
        """Return the same arm in another session."""
        return replace(self, session=session)


@dataclass(frozen=True)
class ParameterChoice:
    """Source of the parameters: a physically consistent identification, else drawn; ``draw_masses``: not the URDF's."""

    model: Path | None = None
    seed: int = 0
    draw_masses: bool = False


STANDARD = ParameterChoice()
"""Masses of the URDF, else those stored for the robot, else drawn."""


def load_twin(config: Path, choice: ParameterChoice = STANDARD) -> Twin:
    """Virtual arm of a session, or of a robot with a session made for it; raises ConfigError if a file is wrong."""
    path = config_path(config)
    session = load_session(path, "robot") if is_session(path) else None
    path = path if session is None else session.robot
    robot = load_robot(path, "robot")
    inertials = None if choice.draw_masses else load_inertials(path)
    robot, parameters, assumed = complete(robot, model=choice.model, inertials=inertials, seed=choice.seed)
    if session is None:
        session = _session_for(path, robot)
        made = f"session: bus {session.bus.channel}, SYNC every {SYNC_PERIOD_US} us, nodes 1 to {robot.n}"
        assumed = (*assumed, made)
    trajectory = None
    if session.setpoints is None and session.sync.role == "producer":
        trajectory = plausible_trajectory(robot, choice.seed)
    return Twin(path, session, robot, parameters, assumed, trajectory)


def at_period(session: SessionConfig, period_us: int) -> SessionConfig:
    """Session at another SYNC period, with all streams and set points on every SYNC."""
    return session.model_copy(
        update={
            "sync": session.sync.model_copy(update={"period_us": period_us}),
            "streams": {name: s.model_copy(update={"every": 1}) for name, s in session.streams.items()},
            "setpoints": session.setpoints and session.setpoints.model_copy(update={"every": 1}),
        }
    )


def on_virtual_bus(session: SessionConfig, channel: str, cell: str) -> SessionConfig:
    """Session on one vcan bus, without the cell's Zenoh, metrics and triggers: real drives and services stay apart."""
    nodes = [drive.node_id for drive in session.drives]
    if len(set(nodes)) < len(nodes):
        raise ConfigError(
            f"session of cell {session.cell!r}: drives of several buses share node ids; a virtual bus needs unique ones"
        )
    fd = any(bus.fd for bus in session.all_buses)
    return session.model_copy(
        update={
            "cell": cell,
            "blanks": (),
            "bus": Bus(channel=channel, fd=fd),
            "buses": (),
            "drives": tuple(drive.model_copy(update={"bus": None}) for drive in session.drives),
            "heartbeat_ms": max(session.heartbeat_ms, SHARED_HEARTBEAT_MS),
            "recording": session.recording.model_copy(update={"trigger": None}),
            "zenoh": ZenohOptions(commands=session.zenoh.commands),
            "metrics": MetricsOptions(),
        }
    )


def complete(robot: RobotConfig, **choice: Any) -> tuple[RobotConfig, ArmParameters, tuple[str, ...]]:
    """Robot with limits, transmission and drives, parameters of its virtual arm (`arm_parameters`), and assumptions."""
    robot, limits = with_limits(robot)
    parameters = arm_parameters(robot, **choice)
    robot, drives = _with_drives(robot, parameters)
    robot = robot.model_copy(update={"blanks": ()})
    return robot, parameters, (*limits, *drives)


def with_limits(robot: RobotConfig) -> tuple[RobotConfig, tuple[str, ...]]:
    """Robot with limits of position, velocity and acceleration, and a remark on each that was assumed."""
    assumed: dict[str, list[str]] = {}
    joints = []
    for joint in robot.joints:
        found, missing = joint.limits, joint.limits.missing()
        values: dict[str, Any] = {}
        if "position" in missing:
            low, high = ASSUMED_POSITION[joint.type]
            ends = found.position
            values["position"] = (
                (
                    ends[0] if np.isfinite(ends[0]) else min(low, ends[1] - (high - low)),
                    ends[1] if np.isfinite(ends[1]) else max(high, ends[0] + (high - low)),
                )
                if any(map(np.isfinite, ends))
                else (low, high)
            )
        if "velocity" in missing:
            values["velocity"] = ASSUMED_VELOCITY[joint.type]
        if "acceleration" in missing:
            values["acceleration"] = ASSUMED_RISE_PER_S * values.get("velocity", found.velocity)
        for quantity, value in values.items():
            text = f"{value[0]:g} to {value[1]:g}" if isinstance(value, tuple) else f"{value:g}"
            assumed.setdefault(f"limits.{quantity}", []).append(f"{joint.name} {text}")
        joints.append(joint.model_copy(update={"limits": found.model_copy(update=values)}))
    return robot.model_copy(update={"joints": tuple(joints)}), _sentences(assumed)


def _with_drives(robot: RobotConfig, parameters: ArmParameters) -> tuple[RobotConfig, tuple[str, ...]]:
    """Robot with torque limits, transmission, encoder counts and rated values, and remarks on what was assumed."""
    assumed: dict[str, list[str]] = {}
    remarks: list[str] = []
    if robot.transmission is None:
        identity = tuple(tuple(float(i == j) for j in range(robot.n)) for i in range(robot.n))
        robot = robot.model_copy(update={"transmission": identity})
        remarks.append("transmission: the identity, counts and signals are those of the joints")
    if robot.friction.sign_smoothing is None:
        smoothing = parameters.sign_smoothing or tuple(float(g) for g in robot.sign_smoothing)
        friction = robot.friction.model_copy(update={"sign_smoothing": smoothing})
        robot = robot.model_copy(update={"friction": friction})
        entries = [f"{joint.name} {g:g}" for joint, g in zip(robot.joints, smoothing, strict=True)]
        assumed["friction.sign_smoothing"] = entries if parameters.sign_smoothing is None else []
    lacks_torque = any("torque" in joint.limits.missing() for joint in robot.joints)
    needed = needed_torque(robot, parameters.standard) if lacks_torque else np.zeros(robot.n)
    ratio = np.abs(np.diag(robot.transmission_matrix))
    joints = []
    for j, joint in enumerate(robot.joints):
        drive, limits, values = joint.drive, joint.limits, {}
        if "torque" in limits.missing():
            limits = limits.model_copy(update={"torque": float(needed[j]) / TORQUE_SHARE})
            assumed.setdefault("limits.torque", []).append(f"{joint.name} {limits.torque:.3g}")
        geared = float(ratio[j]) or 1.0
        if drive.counts_per_unit is None:
            counts = COUNTS_PER_TURN if joint.type == "revolute" else COUNTS_PER_METRE
            values["counts_per_unit"] = float(round(counts / geared))
            assumed.setdefault("drive.counts_per_unit", []).append(f"{joint.name} {values['counts_per_unit']:.0f}")
        most = limits.torque / (geared * abs(drive.gain))
        if "rated" not in drive.model_fields_set or f"joints[{joint.name}].drive.rated" in robot.blanks:
            values["rated"] = _three_digits(RATED_SHARE * most)
            assumed.setdefault("drive.rated", []).append(f"{joint.name} {values['rated']:g}")
        elif most > BUS_RANGE * drive.rated:
            remarks.append(
                f"drive.rated of {joint.name}: the bus holds {BUS_RANGE * drive.rated:.3g} of the {most:.3g} that the "
                "torque limit needs; larger signals are clipped"
            )
        if drive.saturation is None:
            values["saturation"] = _three_digits(BUS_RANGE * values.get("rated", drive.rated))
            assumed.setdefault("drive.saturation", []).append(f"{joint.name} {values['saturation']:g}")
        joints.append(joint.model_copy(update={"limits": limits, "drive": drive.model_copy(update=values)}))
    return robot.model_copy(update={"joints": tuple(joints)}), (*remarks, *_sentences(assumed))


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def _sentences(assumed: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    return tuple(f"{key}: {', '.join(entries)}" for key, entries in assumed.items() if entries)


def _session_for(path: Path, robot: RobotConfig) -> SessionConfig:
    """Session of a robot on one virtual bus."""
    eds = config_path("eds/cia402_servo.eds", listed=("eds",))
    effort = "torque" if effort_of(robot) == "torque" else "current"
    return SessionConfig.model_validate(
        {
            "schema": "armident/session/1",
            "cell": "twin",
            "robot": path.resolve(),
            "bus": {"channel": "vcan0"},
            "sync": {"period_us": SYNC_PERIOD_US},
            "drives": [{"joint": j.name, "node_id": k, "eds": eds} for k, j in enumerate(robot.joints, start=1)],
            "streams": {
                "samples": {"tpdo": 1, "objects": ["position", effort, "status"]},
                "demand": {"tpdo": 2, "every": 5, "objects": ["demand"]},
            },
        }
    )


def write_twin(twin: Twin, folder: Path) -> Path:
    """Write ``robot.yaml``, ``cell.yaml`` and, without set points, ``trajectory.yaml`` for ``armident capture``."""
    try:
        return _write_files(twin, folder)
    except OSError as error:
        raise ConfigError(
            f"{folder}: the configuration cannot be written: {error.strerror or 'output error'}"
        ) from error


def _write_files(twin: Twin, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    robot, session = folder / "robot.yaml", twin.session.model_dump(mode="json", by_alias=True)
    head = ["For a virtual arm. Assumed, to be measured before a real arm is moved:", *twin.assumed]
    _write(robot, _robot_content(twin), head)
    session["robot"] = robot.name
    if twin.trajectory is not None:
        file = folder / "trajectory.yaml"
        remark = "Within the limits of the joints; collisions are not checked: for a virtual arm only."
        _write(file, twin.trajectory.model_dump(mode="json", by_alias=True, exclude_none=True), [remark])
        every = 1 if twin.session.sync.counter % 5 else 5
        session["setpoints"] = {"rpdo": 1, "every": every, "trajectory": file.name}
    path = folder / "cell.yaml"
    _write(path, session, [f"Session of the virtual arm of {twin.robot.name}."])
    return path


def _robot_content(twin: Twin) -> dict[str, Any]:
    """Content of the robot's file; a URDF stays the source of geometry and masses."""
    content = twin.robot.model_dump(mode="json", by_alias=True, exclude_none=True)
    source = read_yaml(twin.source.read_text(encoding="utf-8"), str(twin.source))
    if not isinstance(source, dict) or "urdf" not in source:
        return content
    file = (twin.source.resolve().parent / source["urdf"]["file"]).resolve()
    joints = [{key: joint[key] for key in ("name", "limits", "drive", "rotor_inertia")} for joint in content["joints"]]
    own = {"urdf": {**source["urdf"], "file": str(file)}, "joints": joints}
    gravity = {"gravity": source["gravity"]} if "gravity" in source else {}
    return {key: value for key, value in content.items() if key not in ("joints", "gravity")} | own | gravity


def _write(path: Path, content: dict[str, Any], comments: Sequence[str]) -> None:
    text = "".join(f"# {line}\n" for line in comments)
    path.write_text(text + yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
