"""Feed-forward terms in the units of the drives: a table of constants, and torques along a motion."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from armident.identify.documents.files import write_atomically
from armident.identify.identification.checks.excitation import workspace_postures
from armident.identify.model_export.code_writer import EVERY_PART
from armident.identify.model_export.consumers import GivenMotion
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.sheet import LimitationSheet, limitation_sheet
from armident.identify.robot.chain import Floats

COLUMNS = ("motor", "term", "joint", "value", "unit", "least", "most")
"""Heads of the table of constants; ``least`` and ``most``: over the workspace, of terms that depend on the posture."""

TERMS = ("gravity", "inertia", "friction", "total")
"""Parts of the torque along a motion; inertia includes Coriolis and centrifugal torques, friction all effects."""

NOTHING = 1e-9
"""Values below are rounding errors, per mille."""


def write_drives(model: ExportedModel, path: Path, motion: GivenMotion) -> tuple[list[Path], LimitationSheet]:
    """Write constants of each motor, and beside them the torques along a motion, per mille of the rated effort."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(_constants(model))
    write_atomically(path, stream.getvalue())
    terms = [np.rint(1e3 * part @ per_mille(model)) / 1e3 for part in torque_terms(model, motion)]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["t", *(f"{joint.name}_{term}" for term in TERMS for joint in model.joints)])
    writer.writerows(np.column_stack([motion.dt * np.arange(len(motion.q)), *terms]).tolist())
    along = path.with_name(f"{path.stem}_torque.csv")
    write_atomically(along, stream.getvalue())
    effects = [effect for effect in model.effects if not effect.of_recording]
    remarks = (
        "values are per mille of the rated effort of each drive (6075h or 6076h), as 6071h and 60B2h take them",
        "velocities and accelerations are in counts of the motor per s and s^2, where the configuration has "
        "counts_per_unit and the motor moves one joint, otherwise in units of the joint",
        f"{along.name}: torques of the motors along {motion.title}",
        "gravity depends on the posture: the constant is that of all joints at zero",
    )
    return [path, along], limitation_sheet(model, "drives", EVERY_PART, effects=effects, remarks=remarks)


def per_mille(model: ExportedModel) -> Floats:
    """Return the factors (n, n) from joint torques, a row, to efforts of the motors in per mille of the rated ones."""
    drives = [joint.drive for joint in model.robot.joints]
    rated = np.array([drive.gain * drive.rated for drive in drives]) / 1000.0
    factors: Floats = np.linalg.inv(model.robot.transmission_matrix) / rated
    return factors


def torque_terms(model: ExportedModel, motion: GivenMotion) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the joint torques (N, n) by gravity, by inertia, by all else, and in total, N m or N."""
    names = np.array([name.startswith("ia") for name in model.arm.names])
    rigid = np.where(model.arm.of_links | names, model.theta, 0.0)
    still = np.zeros_like(motion.q)
    gravity = model.arm.inverse_dynamics(rigid, motion.q, still, still)
    inertia = model.arm.inverse_dynamics(rigid, motion.q, motion.qd, motion.qdd) - gravity
    total = model.model.inverse_dynamics(motion.q, motion.qd, motion.qdd, dt=motion.dt)
    return gravity, inertia, total - gravity - inertia, total


def _constants(model: ExportedModel) -> Iterator[tuple[str, ...]]:
    """Yield a row for each term and each joint that a motor moves."""
    factors, turns = per_mille(model), np.full((2, model.arm.n), np.pi) * [[-1.0], [1.0]]
    masses = model.arm.mass_matrix(model.theta, workspace_postures(model.robot, turns))
    matrix, zero = model.robot.transmission_matrix, np.zeros((1, model.arm.n))
    weight = model.arm.inverse_dynamics(np.where(model.arm.of_links, model.theta, 0.0), zero, zero, zero)[0]
    for m, motor in enumerate(model.robot.joints):
        for j, joint in enumerate(model.joints):
            factor = float(factors[j, m])
            if factor == 0.0:
                continue
            unit, ratio = "rad" if joint.type == "revolute" else "m", factor
            if matrix[m, j] and np.count_nonzero(matrix[m]) == np.count_nonzero(matrix[:, j]) == 1:
                per_turn = motor.drive.counts_per_unit or np.nan
                per_unit = per_turn / (2.0 * np.pi if motor.type == "revolute" else 1.0)
                unit, per_unit = ("counts", per_unit) if np.isfinite(per_unit) else (f"{unit} of the motor", 1.0)
                # In the direction of the motor, which dry friction opposes.
                ratio, factor = factor / float(matrix[m, j]) / per_unit, abs(factor)
            own = ratio * masses[:, j, j]
            yield (motor.name, "Coulomb friction", joint.name, *_row(factor * joint.coulomb, "per mille"))
            yield (motor.name, "viscous friction", joint.name, *_row(ratio * joint.viscous, f"per mille s/{unit}"))
            yield (motor.name, "offset", joint.name, *_row(float(factors[j, m]) * joint.offset, "per mille"))
            yield (motor.name, "gravity", joint.name, *_row(float(factors[j, m] * weight[j]), "per mille"))
            yield (motor.name, "inertia", joint.name, *_row(float(own.mean()), f"per mille s^2/{unit}", own))


def _row(value: float, unit: str, over: Floats | None = None) -> tuple[str, ...]:
    """Return the last columns of a row; ``over``: values over the workspace."""
    bounds = ("", "") if over is None else (f"{over.min():.6g}", f"{over.max():.6g}")
    return (f"{value if abs(value) > NOTHING else 0.0:.6g}", unit, *bounds)
