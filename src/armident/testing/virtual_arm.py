"""A virtual arm for a test, and its capture, by the commands that a real cell uses."""

import itertools
import json
import os
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from armident.configs import ArmidentError, RobotConfig, SessionConfig, load_robot, load_session
from armident.daq.recording import Recording, read_recording
from armident.processes import CommandProcess
from armident.virtual_robot.twin import ParameterChoice, at_period, load_twin, on_virtual_bus, write_twin

READY_S = 180.0
"""Longest start of a virtual arm, s: the compilation of its loops takes most of it."""
CAPTURE_S = 300.0
"""Longest capture after the motion and its preparation, s."""

_numbers = itertools.count()


@dataclass(frozen=True, eq=False)
class VirtualArm:
    """A running virtual arm.

    Parameters
    ----------
    config
        Session file of the arm on its bus: for ``armident capture``, or for the program under test.
    session, robot
        Its content, and that of its robot.
    truth
        True parameters of the arm by name, SI, joint side, and gains of the drives.
    process
        The process of the arm.
    """

    config: Path
    session: SessionConfig
    robot: RobotConfig
    truth: Mapping[str, float]
    process: CommandProcess

    @property
    def bus(self) -> str:
        """Name of the bus."""
        return self.session.all_buses[0].channel

    def stop(self) -> None:
        """Switch the arm off."""
        self.process.stop()


class VirtualArms:
    """Starts virtual arms on the bus of a test, one at a time.

    Parameters
    ----------
    bus
        Name of the vcan interface.
    folder
        Folder for configuration and log.
    """

    def __init__(self, bus: str, folder: Path) -> None:
        self._bus, self._folder = bus, folder
        self._arm: VirtualArm | None = None

    def __call__(
        self,
        config: str | Path,
        scenario: str | Path | Mapping[str, Any] | None = None,
        *,
        seed: int = 0,
        noise: float = 1.0,
        sync_period_us: int | None = None,
        model: str | Path | None = None,
        arm_seed: int = 0,
        draw_masses: bool = False,
    ) -> VirtualArm:
        """Start a virtual arm and wait until its drives answer.

        Raises ArmidentError if a configuration is wrong, an arm is running already, or the arm does not start.

        Parameters
        ----------
        config
            Configuration of a session or of a robot. All its drives come to the bus of the test. Zenoh and metrics are
            those of a test, not those of the cell.
        scenario
            Scenario file, or its keys: hidden effects, oddities of drives, controller, friction, noise.
        seed, noise
            Seed of the noise, and factor on its amplitude.
        sync_period_us
            SYNC period in place of the session's, us; all streams and set points are then on every SYNC.
        model, arm_seed, draw_masses
            Where masses and friction come from, as in ``armident robot``.
        """
        if self._arm is not None and self._arm.process.running:
            raise ArmidentError("virtual_arm: an arm is on this bus already; stop() it first")
        number = next(_numbers)
        folder = self._folder / f"arm_{number}"
        choice = ParameterChoice(None if model is None else Path(model), arm_seed, draw_masses)
        twin = load_twin(Path(config), choice)
        session = twin.session if sync_period_us is None else at_period(twin.session, sync_period_us)
        session = on_virtual_bus(session, self._bus, f"{session.cell[:40]}_test_{os.getpid()}_{number}")
        session = session.model_copy(
            update={"recording": session.recording.model_copy(update={"directory": folder / "recordings"})}
        )
        file = write_twin(twin.with_session(session), folder)
        words = ["robot", "--config", str(file), "--seed", str(seed), "--noise", str(noise)]
        words += ["--arm-seed", str(arm_seed), "--truth", str(folder / "truth.json")]
        words += [] if model is None else ["--model", str(Path(model).resolve())]
        words += [] if scenario is None else ["--scenario", str(_scenario_file(scenario, folder))]
        process = CommandProcess(words, name="virtual arm", log=folder / "arm.log").start()
        try:
            process.wait_for_line("ready", READY_S)
        except ArmidentError:
            process.stop()
            raise ArmidentError(f"the virtual arm did not start: {process.last_error()}") from None
        loaded = load_session(file)
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        self._arm = VirtualArm(file, loaded, load_robot(loaded.robot), truth, process)
        return self._arm

    def stop(self) -> None:
        """Switch the arm off, if there is one."""
        if self._arm is not None:
            self._arm.stop()


def _scenario_file(scenario: str | Path | Mapping[str, Any], folder: Path) -> Path | str:
    if not isinstance(scenario, Mapping):
        return Path(scenario).resolve() if Path(scenario).exists() else str(scenario)
    file = folder / "scenario.yaml"
    content = {"schema": "armident/scenario/1", **scenario}
    file.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return file


class Captures:
    """Records virtual arms with ``armident capture``.

    Parameters
    ----------
    folder
        Folder of recordings and logs.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(
        self, arm: VirtualArm | str | Path, *, duration_s: float | None = None, timeout_s: float = CAPTURE_S
    ) -> Recording:
        """Record to a file, and read it.

        ``arm``: a virtual arm, or a session file. ``duration_s``: length of the recording, s; ``None``: to the end of
        the trajectory of the session. ``timeout_s``: longest time, s. Raises ArmidentError if the capture fails or
        takes longer.
        """
        config = arm.config if isinstance(arm, VirtualArm) else Path(arm)
        number = next(_numbers)
        words = ["capture", "--config", str(config), "--out", str(self._folder / f"recordings_{number}"), "--json"]
        words += [] if duration_s is None else ["--duration", str(duration_s)]
        with CommandProcess(words, log=self._folder / f"capture_{number}.log") as process:
            try:
                process.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                raise ArmidentError(f"capture: did not end within {timeout_s:g} s: {process.last_error()}") from None
            if process.exit_code != 0:
                raise ArmidentError(f"capture: {process.last_error()}")
            result = next(line for line in process.output().splitlines() if line.startswith('{"recording"'))
        return read_recording(Path(json.loads(result)["recording"]))
