"""Recordings of the tables: virtual TX40 and EMPS, measured TX40 and EMPS."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from armident.configs import ArmidentError, ConfigError, DataError, RobotConfig, config_path, load_robot, load_session
from armident.configs.yaml_loader import is_file
from armident.daq.recording import read_recording
from armident.identify.controller.nominal import saturation
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.robot.controller import DiscreteController
from armident.identify.signals.experiments import Experiment

SESSION = "tx40_cell.yaml"
EMPS_SESSION = "emps_cell.yaml"
COMMAND = (sys.executable, "-m", "armident.daq.cli", "robot")

MEASURED_POSITIONS, MEASURED_TORQUES = "pos_read_data.csv", "curr_data.csv"
MEASURED_PERIOD = 2e-4
MEASURED_END_S = 7.5
"""End of the motion of the measured arm, s."""
EMPS_FILE, EMPS_PERIOD = "DATA_EMPS.mat", 1e-3


@dataclass(frozen=True)
class Recorded:
    """Recording of an arm, with the true parameters of a virtual one.

    ``experiment``: positions, torques, and the reference of the virtual arm. ``truth``: standard and base parameters of
    the virtual arm by name, and gains of its drives; empty for a measured one.
    """

    robot: RobotConfig
    experiment: Experiment
    truth: dict[str, float]

    def coarsened(self, points: int) -> Self:
        """Return the recording with joint positions rounded to a number of points per turn.

        Rounded after recording, so that the drives had their own encoders.
        """
        step = 2 * np.pi / points
        return replace(self, experiment=replace(self.experiment, q=np.round(self.experiment.q / step) * step))

    def controller(self) -> DiscreteController:
        """Return the controller of the drives: position and velocity loop (thesis figure B.1).

        ``nu = kv (kp eps + s)``. Here ``s`` is the derivative of ``eps``, or of ``-q`` where the drives feed back the
        velocity. A first-order low-pass acts on ``s`` if the drives have one.
        """
        n, dt, samples = self.robot.n, self.experiment.dt, int(self.truth["velocity_samples"])
        kp, kv = (np.array([self.truth[f"{gain}{j + 1}"] for j in range(n)]) for gain in ("kp", "kv"))
        loop = kv * np.array([joint.drive.gain for joint in self.robot.joints])
        corner = self.truth.get("velocity_filter_hz", np.inf)
        keep = float(np.exp(-2 * np.pi * corner * dt))
        proportional, derivative = np.zeros((2, n, samples + 1))
        proportional[:, 0], proportional[:, 1] = loop * kp, -keep * loop * kp
        derivative[:, 0] = loop * (1 - keep) / (samples * dt)
        derivative[:, -1] = -derivative[:, 0]
        feedback = bool(self.truth["velocity_feedback"])
        return DiscreteController(
            error_taps=proportional if feedback else proportional + derivative,
            position_taps=-derivative if feedback else np.zeros((n, 1)),
            output_taps=np.full((n, 1), keep),
            saturation=saturation(self.robot),
            dt=dt,
        )


def virtual_recording(folder: Path, seed: int = 0, velocity_feedback: bool = False, session: str = SESSION) -> Recorded:
    """Record the virtual arm of a session in a separate process, or read the recording from ``folder``.

    ``folder``: folder of recordings, named by a digest of their inputs. ``seed``: seed of the noise, which has the
    measured size (TX40: table 6.3). ``velocity_feedback``: True: the drives feed back the velocity. False: their
    velocity loop acts on the tracking error. ``session``: session of the virtual cell. Raises ConfigError if the folder
    cannot be written; ArmidentError if the virtual arm fails.
    """
    arguments = ["--config", session, "--seed", str(seed)]
    arguments.append("--velocity-feedback" if velocity_feedback else "--velocity-error")
    name = _digest(session, arguments)
    recording, truth = folder / f"{name}.mcap", folder / f"{name}.json"
    if not (is_file(recording) and is_file(truth)):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be created: {error.strerror}") from error
        _record(arguments, recording, truth)
    read = read_recording(recording)
    (experiment,), _ = experiments_from_recording(read, read.robot)
    return Recorded(read.robot, experiment, json.loads(truth.read_text(encoding="utf-8")))


def _digest(session: str, arguments: list[str]) -> str:
    """Return a digest of the arguments, their files, and the version of the program."""
    cell = load_session(session)
    digest = hashlib.sha256("\0".join([version("armident"), *arguments]).encode())
    files = [config_path(session), cell.robot]
    if cell.setpoints is not None:
        files.append(cell.setpoints.trajectory)
    for file in files:
        digest.update(Path(file).read_bytes())
    return digest.hexdigest()[:16]


def _record(arguments: list[str], recording: Path, truth: Path) -> None:
    scratch = recording.with_name(f"{recording.stem}.{os.getpid()}.mcap")
    command = [*COMMAND, *arguments, "--to-file", str(scratch), "--truth", str(truth)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        reason = lines[-1] if lines else f"exit code {done.returncode}"
        raise ArmidentError(f"the virtual arm did not record: {reason}")
    scratch.replace(recording)


def measured_recording(folder: Path) -> Recorded:
    """Read the measured TX40: motor positions and torques at 5 kHz, no reference.

    ``folder``: folder with ``pos_read_data.csv`` (rad at the motors) and ``curr_data.csv`` (N m at the motors), or its
    parent, where they are in ``tx40``. Raises DataError if a file is missing or has no numbers, or the lengths differ.
    """
    folder = folder / "tx40" if (folder / "tx40").is_dir() else folder
    robot = load_robot("tx40")
    rows = round(MEASURED_END_S / MEASURED_PERIOD)
    position, torque = (_columns(folder / name, robot.n)[:rows] for name in (MEASURED_POSITIONS, MEASURED_TORQUES))
    if position.shape != torque.shape:
        raise DataError(f"{folder}: {len(position)} rows of positions, {len(torque)} of torques")
    ratios = robot.transmission_matrix
    q = np.ascontiguousarray(np.linalg.solve(ratios, position.T).T, dtype=np.float64)
    return Recorded(robot, Experiment(q=q, tau=torque @ ratios, q_ref=None, dt=MEASURED_PERIOD), {})


def measured_emps(folder: Path, name: str = EMPS_FILE) -> Recorded | None:
    """Read the measured EMPS, an axis with reference; ``None`` if ``folder/emps/name`` is absent.

    A file that cannot be read is a DataError.
    """
    file = folder / "emps" / name
    if not is_file(file):
        return None
    robot = load_robot("emps")
    try:
        found = loadmat(file, variable_names=("qm", "qg", "vir"))
        q, reference, voltage = (
            np.asarray(found[name], dtype=np.float64).reshape(-1, 1) for name in ("qm", "qg", "vir")
        )
    except (OSError, LookupError, ValueError, TypeError, NotImplementedError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    torque = robot.joints[0].drive.gain * voltage
    return Recorded(robot, Experiment(q=q, tau=torque, q_ref=reference, dt=EMPS_PERIOD), {})


def _columns(file: Path, n: int) -> NDArray[np.float64]:
    try:
        values = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    except ValueError as error:
        raise DataError(f"{file}: {error}") from error
    if values.shape[1] != n or not np.isfinite(values).all():
        raise DataError(f"{file}: expected {n} columns of finite numbers, found {values.shape[1]}")
    return np.asarray(values, dtype=np.float64)
