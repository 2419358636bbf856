"""``armident robot``: the virtual arm, or a measured recording, on the bus of a session."""

import json
import signal
import sys
from pathlib import Path
from types import FrameType

from configs import RobotConfig, SessionConfig, load_robot, load_session
from daq.recording import read_recording
from virtual_robot.arm import Arm, Motion
from virtual_robot.inertias import base_parameters, plant_parameters, rest_posture
from virtual_robot.replay import Replay
from virtual_robot.scenario import load_scenario
from virtual_robot.server import Server


def run_robot(
    config: Path,
    scenario: Path | None = None,
    replay: Path | None = None,
    seed: int = 0,
    noise: float = 1.0,
    duration: float | None = None,
    truth: Path | None = None,
) -> None:
    """Serve the drives of a session until SIGINT or SIGTERM, or for ``duration`` seconds.

    ``truth`` names a file for the plant's own parameters: standard ones, and base ones where several act as one.

    Raises
    ------
    ConfigError
        If a file is wrong, the bus is missing, or the recording is of another robot.
    DataError
        If the recording cannot be replayed.
    BusDown
        If the bus goes down.
    """
    session = load_session(config)
    robot = load_robot(session.robot)
    if replay is not None:
        motion = _replay(session, robot, replay)
    else:
        hidden = load_scenario(scenario) if scenario is not None else None
        motion = Arm(robot, rest_posture(robot), session.sync_period, seed, noise, hidden)
        _warm_up(robot, session)
        if truth is not None:
            parameters = plant_parameters(robot)
            truth.write_text(json.dumps(parameters | base_parameters(parameters), indent=1) + "\n", encoding="utf-8")
    stop = _Stop()
    with Server(session, robot, motion) as server:
        nodes = ", ".join(str(drive.node_id) for drive in server.drives)
        print(f"ready: {robot.name} on {session.bus.channel}, nodes {nodes}", flush=True)
        report = server.run(lambda: stop.asked, duration)
    print(report, file=sys.stderr, flush=True)


def _replay(session: SessionConfig, robot: RobotConfig, path: Path) -> Motion:
    names = [joint.name for joint in robot.joints]
    joints = tuple(names.index(node.joint) for node in session.drives)
    return Replay(read_recording(path), robot, session.sync_period, joints)


def _warm_up(robot: RobotConfig, session: SessionConfig) -> None:
    """Compile the loops before anybody waits for an answer."""
    Arm(robot, rest_posture(robot), session.sync_period).advance()


class _Stop:
    """Whether SIGINT or SIGTERM asked to stop."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
