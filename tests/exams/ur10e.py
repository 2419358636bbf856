"""Motor currents of a UR10e: friction that grows with the load, and a load of known mass.

Published with the recordings (Mamedov and Mikhel, Frontiers in Robotics and AI 7, 2020): the masses, inertias, Coulomb
and viscous friction of ``UR10E_parameters.txt``, the torque constants with which currents become torques here too, and
the mass of the load. The program that came with them judges a model by the error of each joint's torque, relative to
the recorded torque without a filter; positions and their derivatives pass a filter. So are all models judged here.
"""

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio
from numpy.typing import NDArray

import armident
from armident.configs import ConfigError, DataError
from armident.configs.yaml_loader import is_file
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.signals.bandpass import butterworth, central_difference
from tests.tools.markdown import table

Floats = NDArray[np.float64]
Torques = Callable[[Floats, Floats, Floats], Floats]
"""Torques (N, n) of positions, velocities and accelerations (N, n)."""

REPOSITORY = "github.com/shamilmamedov/dynamic_calibration"
WHERE = f"clone {REPOSITORY} and repeat with --data FOLDER"
PARAMETERS, GEOMETRY, FOLDER = "UR10E_parameters.txt", "URe/urdf/ur10e.urdf", "dataset_ur10e"
ROBOT = "ur10e"
RATE_HZ = 94.0
"""Even clock of the samples; the recorder polled a clock of 500 Hz every 10 or 12 ms, 93.9 times a second."""
FILTER_HZ = 7.0
"""Cutoff of the published filter of velocities: 0.15 of half the rate."""
LOAD_KG = 2.805
MASS_FIRST = [9, 6, 7, 8, 0, 1, 3, 2, 4, 5]
"""Order of Pinocchio, as places in the published parameters of a link: inertia, first moments, mass."""


@dataclass(frozen=True)
class Stretch:
    """A file of the repository, and its rows in motion, first and last, as in the published programs, from 1."""

    title: str
    file: str
    first: int
    last: int


TRAINING = Stretch("30 s, 12 harmonics", "identification_data/ur-20_02_10-30sec_12harm.csv", 635, 3510)
HELD_OUT = (
    Stretch("10 points, held out", "validation_data/ur-20_01_17-ptp_10_points.csv", 700, 4200),
    Stretch("50 s, 14 harmonics, held out", "identification_data/ur-20_02_19_14harm50sec.csv", 195, 4966),
)
SECOND = Stretch("40 s, 12 harmonics", "identification_data/ur-20_02_12-40sec_12harm.csv", 500, 4460)
"""Of another motion: with the first recording alone, findings depend on the part that is held out."""
LOADED = Stretch("50 s, 14 harmonics, with the load", "identification_data/ur-20_02_19_14harm50secLoad.csv", 308, 5071)


@dataclass(frozen=True)
class Published:
    """Published parameters, SI: torque constants and rotors (6,); links (60,) in the order of Pinocchio.

    ``friction``: viscous, Coulomb and offset of each joint, (6, 3).
    """

    gains: Floats
    links: Floats
    rotors: Floats
    friction: Floats
    geometry: pinocchio.Model

    @classmethod
    def read(cls, folder: Path) -> "Published":
        """Read the parameters from a clone of the repository. Raises ConfigError if it is none."""
        for name in (PARAMETERS, GEOMETRY, *(f"{FOLDER}/{s.file}" for s in (TRAINING, SECOND, *HELD_OUT, LOADED))):
            if not is_file(folder / name):
                raise ConfigError(f"{folder / name} is missing: {WHERE}")
        text = (folder / PARAMETERS).read_text(encoding="utf-8")
        found = {name: np.array(row.split(), np.float64) for name, row in re.findall(r"(\w+) = \[([^\]]*)\]", text)}
        try:
            links = found["pi_rgd"].reshape(6, 10)[:, MASS_FIRST].ravel()
            friction = found["pi_frcn"].reshape(6, 3)
            geometry = pinocchio.buildModelFromUrdf(str(folder / GEOMETRY))
            return cls(found["drvGains"], links, found["pi_drvs"], friction, geometry)
        except (LookupError, ValueError) as error:
            raise DataError(f"{folder / PARAMETERS}: cannot be read: {error}") from error

    def torques(self, q: Floats, qd: Floats, qdd: Floats) -> Floats:
        """Return the torques (N, n) of a motion."""
        data = self.geometry.createData()
        motion = zip(q, qd, qdd, strict=True)
        links = [pinocchio.computeJointTorqueRegressor(self.geometry, data, *now) @ self.links for now in motion]
        viscous, coulomb, offset = self.friction.T
        torque: Floats = np.array(links) + self.rotors * qdd + viscous * qd + coulomb * np.sign(qd) + offset
        return torque


def recording(folder: Path, stretch: Stretch, gains: Floats) -> armident.Recording:
    """Return a stretch as a recording of torques; columns: time, position, velocity and current of the joints."""
    file = folder / FOLDER / stretch.file
    try:
        rows = np.loadtxt(file, delimiter=",", usecols=range(19), ndmin=2)[stretch.first - 1 : stretch.last]
    except (OSError, ValueError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    return armident.Recording.from_arrays(rows[:, 0], rows[:, 1:7], rows[:, 13:] * gains, ROBOT, resample_hz=RATE_HZ)


def errors(torques: Torques, q: Floats, measured: Floats) -> Floats:
    """Return the errors of predicted torques by joint and of all joints, percent, (n + 1,)."""
    filtered = butterworth(q, 1 / RATE_HZ, FILTER_HZ)
    qd = central_difference(filtered, 1 / RATE_HZ)
    wrong = torques(filtered, qd, central_difference(qd, 1 / RATE_HZ)) - measured
    by_joint = np.linalg.norm(wrong, axis=0) / np.linalg.norm(measured, axis=0)
    return 100 * np.append(by_joint, np.linalg.norm(wrong) / np.linalg.norm(measured))


def of(result: armident.Identification) -> Torques:
    """Return the torques of an identified model."""
    return lambda q, qd, qdd: result.model.inverse_dynamics(q, qd, qdd, dt=1 / RATE_HZ)


def rows(models: Mapping[str, Torques], recordings: Mapping[Stretch, armident.Recording]) -> list[list[str]]:
    """Return the rows of the errors of some models on some recordings."""
    found = []
    for stretch, record in recordings.items():
        (measured,), _ = experiments_from_recording(record, record.robot)
        for title, torques in models.items():
            values = errors(torques, measured.q, measured.tau)
            found.append([stretch.title, title, *(f"{value:.1f}" for value in values)])
    return found


def report(folder: Path | None) -> str:
    """Return the tables of the exam. Raises ConfigError if there are no recordings."""
    if folder is None:
        raise ConfigError(f"no folder given: {WHERE}")
    published = Published.read(folder)
    seen = {stretch: recording(folder, stretch, published.gains) for stretch in (TRAINING, *HELD_OUT)}
    training, unloaded = seen[TRAINING], seen[HELD_OUT[-1]]
    second, loaded = (recording(folder, stretch, published.gains) for stretch in (SECOND, LOADED))
    begin = time.process_time()
    found = armident.diagnose([training, second])
    seconds = time.process_time() - begin
    changed = armident.diagnose(loaded, baseline=armident.identify(unloaded))
    models = {
        "published parameters": published.torques,
        "ours, rigid": of(armident.identify(training)),
        "ours, with the findings": of(armident.identify(training, robot=found.robot)),
    }
    return "\n\n".join([
        table(("torque error, %", "model", *(f"joint {j + 1}" for j in range(6)), "all"), rows(models, seen)),
        f"{TRAINING.title}, and {SECOND.title} ({seconds:.0f} s of processor time): {found!r}",
        f"{LOADED.title} of {LOAD_KG} kg, beside the recording without: {changed!r}",
    ])  # fmt: skip
