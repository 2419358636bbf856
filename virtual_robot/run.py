"""``armident robot``: the virtual arm, or the replay of a recording, on the bus of a session."""

import json
import logging
import math
import signal
import zlib
from pathlib import Path
from types import FrameType
from typing import Any

from numpy.typing import ArrayLike

from armident.configs import (
    ConfigError,
    RobotConfig,
    Scenario,
    SessionConfig,
    Trajectory,
    load_robot,
    load_session,
    load_trajectory,
)
from armident.configs.loading import load_scenario
from armident.daq.recording import read_recording, write_recording
from armident.virtual_robot import servo
from armident.virtual_robot.arm import Arm, DriveBackend, design_drives
from armident.virtual_robot.arm_parameters import with_scenario
from armident.virtual_robot.inertias import base_parameters, has_stored_parameters
from armident.virtual_robot.oddities import drive_oddities
from armident.virtual_robot.offline import ReferenceTable, simulate_recording, with_encoder_counts
from armident.virtual_robot.plant import Plant
from armident.virtual_robot.replay import Replay
from armident.virtual_robot.server import Server
from armident.virtual_robot.twin import STANDARD, ParameterChoice, Twin, load_twin, write_twin

log = logging.getLogger(__name__)


def run_robot(
    config: Path,
    scenario: Path | None = None,
    replay: Path | None = None,
    seed: int = 0,
    noise: float = 1.0,
    duration: float | None = None,
    truth: Path | None = None,
    velocity_feedback: bool | None = None,
    choice: ParameterChoice = STANDARD,
    write_config: Path | None = None,
) -> None:
    """Serve the drives of a session, or of a robot, until SIGINT or SIGTERM, or for a given time, s.

    ``truth``: JSON file of true parameters (standard, base, of the drives): ``kp`` (1/s), ``kv`` (units of the signal
    per rad/s or m/s at the motor), ``velocity_samples``, ``velocity_filter_hz`` if any, ``velocity_feedback`` (0 or 1).
    ``write_config``: folder for the completed robot and session. Raises ConfigError, DataError (replay) or BusDown.
    """
    hidden = load_scenario(scenario) if scenario is not None else None
    if replay is not None:
        session = load_session(config, "robot")
        robot = load_robot(session.robot, "robot")
        motion = _replay(session, robot, replay)
    else:
        twin = load_twin(config, choice)
        session, robot = twin.session, twin.robot
        _describe(twin, config, write_config)
        arguments = (seed, noise, hidden, velocity_feedback, twin.parameters)
        motion = Arm(robot, twin.parameters.rest, session.sync_period, *arguments)
        # Compile the loops before the first SYNC.
        Arm(robot, twin.parameters.rest, session.sync_period, parameters=twin.parameters).advance()
        if truth is not None:
            _write_truth(twin, twin.parameters.rest, truth, velocity_feedback, hidden)
    oddities = drive_oddities(hidden, robot, str(scenario))
    stop = _Stop()
    with Server(session, robot, motion, oddities) as server:
        nodes = ", ".join(str(drive.node_id) for drive in server.drives)
        buses = ", ".join(bus.channel for bus in session.all_buses)
        # On stdout: programs that start the arm wait for this line.
        print(f"ready: {robot.name} on {buses}, nodes {nodes}", flush=True)
        report = server.run(lambda: stop.requested, duration)
    log.info("%s", report)


def record_robot(
    config: Path,
    out: Path,
    scenario: Path | None = None,
    seed: int = 0,
    noise: float = 1.0,
    trajectory: Path | None = None,
    encoder_counts: int | None = None,
    truth: Path | None = None,
    velocity_feedback: bool | None = None,
    choice: ParameterChoice = STANDARD,
) -> None:
    """Write a simulated recording of one trajectory of the virtual arm, without a bus; options as for ``run_robot``.

    ``trajectory``: a trajectory, or a table of references (.csv), whose rate is that of the recording; each table has
    noise of its own. ``encoder_counts``: per motor turn in place of the robot's, also for the control loops.
    """
    if out.exists():
        raise ConfigError(f"{out}: the file exists already")
    twin = load_twin(config, choice)
    session, robot, setpoints = twin.session, twin.robot, twin.session.setpoints
    _describe(twin, config, None)
    file = trajectory if trajectory is not None or setpoints is None else setpoints.trajectory
    motion: Trajectory | ReferenceTable
    period = session.sync_period
    if file is not None and Path(file).suffix == ".csv":
        motion = ReferenceTable.read(Path(file))
        seed, period = seed + zlib.crc32(motion.q.tobytes()), motion.period
    elif file is not None:
        motion = load_trajectory(file)
    elif twin.trajectory is not None:
        motion = twin.trajectory
    else:
        raise ConfigError(f"{config}: setpoints: --to-file needs a trajectory for the motion of the arm (--trajectory)")
    if encoder_counts is not None:
        robot = with_encoder_counts(robot, encoder_counts)
    hidden = None if scenario is None else load_scenario(scenario)
    if hidden is not None and hidden.drives:
        raise ConfigError(f"{scenario}: drives: --to-file has no bus, on which drives could be odd")
    times: dict[str, Any] = {}
    if setpoints is not None:
        times = {"setpoint_every": setpoints.every, "settle": setpoints.settle_s}
    recording = simulate_recording(
        robot, motion, seed, noise, hidden, period,
        velocity_feedback=velocity_feedback, parameters=twin.parameters, **times,
    )  # fmt: skip
    if truth is not None:
        _write_truth(twin, motion.start, truth, velocity_feedback, hidden)
    write_recording(recording, out)
    log.info("%d samples of %s in %s", recording.samples.sync.size, robot.name, out)


def _describe(twin: Twin, config: Path, write_config: Path | None) -> None:
    """Log where the parameters come from and what was assumed, and write the completed configuration."""
    for source in twin.parameters.sources:
        log.info("%s", source)
    for assumption in twin.assumed:
        log.info("assumed: %s", assumption)
    if write_config is not None:
        log.info("armident capture --config %s records this arm", write_twin(twin, write_config))
    elif twin.assumed:
        log.info("%s leaves this open; armident capture needs it too: --write-config DIR writes files with it", config)


def _write_truth(
    twin: Twin, q: ArrayLike, path: Path, velocity_feedback: bool | None, scenario: Scenario | None
) -> None:
    """Write the parameters of the plant, and of the drives tuned at posture ``q`` (n,)."""
    robot = twin.robot
    chosen = with_scenario(twin.parameters, robot, scenario)
    mass = Plant(robot, q, None, twin.parameters).mass_matrix()
    period = servo.control_period(robot, twin.session.sync_period)
    drives = design_drives(robot, mass, velocity_feedback, period, scenario, chosen)
    values = dict(chosen.standard)
    if robot.name == "tx40" and has_stored_parameters(robot):
        values |= base_parameters(values)
    values["velocity_feedback"] = float(drives.velocity_feedback)
    values["velocity_samples"] = float(drives.velocity_samples)
    if math.isfinite(drives.filter_hz):
        values["velocity_filter_hz"] = drives.filter_hz
    for j in range(robot.n):
        values |= {f"kp{j + 1}": float(drives.kp[j]), f"kv{j + 1}": float(drives.kv[j])}
    path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def _replay(session: SessionConfig, robot: RobotConfig, path: Path) -> DriveBackend:
    names = [joint.name for joint in robot.joints]
    joints = tuple(names.index(node.joint) for node in session.drives)
    return Replay(read_recording(path), robot, session.sync_period, joints)


class _Stop:
    """Flag that SIGINT or SIGTERM sets."""

    def __init__(self) -> None:
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
