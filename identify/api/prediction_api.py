"""Prediction of the torques of a recording by an identified model, and its error."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from threadpoolctl import threadpool_limits

from armident.arrays import Array
from armident.configs import DataError
from armident.daq.recording import Recording
from armident.identify.api.arguments import Progress, Recorded, Robot, recordings_of, robot_of
from armident.identify.api.identification_api import Identification
from armident.identify.api.result_base import Result
from armident.identify.api.result_tables import Table
from armident.identify.documents.base import reference, versions
from armident.identify.documents.prediction import PredictionDocument
from armident.identify.effects.recording_corrections import corrected_experiments
from armident.identify.identification.equations import equations, least_rows, published_equations
from armident.identify.identification.from_recording import NO_REFERENCE, experiments_of
from armident.identify.identification.identification_result import relative_torque_errors
from armident.identify.identification.judgement import Notes
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import (
    has_published_filters,
    shifted_experiments,
    smoothed_derivatives,
)
from armident.identify.identification.residual_statistics import SPEED_QUANTILE
from armident.identify.identification.robot_model import RobotModel
from armident.identify.identification.saved_model import load_model, model_of
from armident.identify.identification.solvers import decimation_of
from armident.identify.regression.equations import ExperimentEquations
from armident.identify.setup.check import check_setup
from armident.identify.setup.result import SetupCheck
from armident.identify.signals.bandwidth import motion_bandwidth
from armident.identify.signals.differentiate import Derivatives
from armident.identify.signals.experiments import Experiment

BEYOND = 0.1
"""Share of the identified range by which a motion may leave it without a warning (as for equal motions)."""


@dataclass(frozen=True, repr=False, eq=False)
class TorquePrediction(Result):
    """Torques that a model predicts along a recording, beside those measured.

    Parameters
    ----------
    document
        Everything that ``prediction.json`` holds: errors in total and by joint.
    model
        The model that predicts.
    t
        Decimated instants (M,), s; a step back begins another experiment.
    measured, predicted
        Torques (M, n), N m or N, with the same filter.
    std
        Standard deviations of the predicted torques due to those of the parameters, (M, n), N m or N.
    since_start
        The instants since the recording began (M,), s.
    """

    document: PredictionDocument
    model: RobotModel
    t: Array
    measured: Array
    predicted: Array
    std: Array
    since_start: Array
    file = "prediction.json"

    @property
    def relative_error_pct(self) -> float:
        """Norm of the torque error relative to that of the torque, percent."""
        return self.document.relative_error_pct

    @property
    def errors(self) -> Table:
        """Table of the errors by joint: percent, on the data of the identification, and root mean squares."""
        document = self.document
        rows = [
            (
                joint,
                document.relative_error_pct_by_joint[joint],
                document.identification_error_pct_by_joint.get(joint),
                document.error_rms[joint],
                document.torque_rms[joint],
                unit,
            )
            for joint, unit in document.units.items()
        ]
        return Table(("joint", "error_pct", "own_data_pct", "error_rms", "torque_rms", "unit"), rows)

    def csv(self) -> str:
        """Return the torques as CSV: ``t``, and for each joint ``measured``, ``predicted`` and ``std``."""
        joints = self.document.units
        heads = [f"{name}_{what}" for name in joints for what in ("measured", "predicted", "std")]
        values = np.stack([self.measured, self.predicted, self.std], axis=2).reshape(self.t.size, -1)
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["t", *heads])
        writer.writerows([[f"{v:.9g}" for v in row] for row in np.column_stack([self.t, values])])
        return stream.getvalue()

    def _for_folder(self, folder: Path) -> tuple[Self, dict[Path, str]]:
        return self, {folder / "torques.csv": self.csv()}

    def _html(self) -> str:
        from armident.identify.report.prediction_report import prediction_report

        return prediction_report(self.document, self.model, self.t, self.measured, self.predicted)

    def _summary(self) -> str:
        return f"{self.document.robot}: {self.document.sentence}"

    def _table(self) -> Table:
        return self.errors


def predict(
    recording: Recorded,
    model: Identification | RobotModel | str | Path,
    robot: Robot | None = None,
    *,
    progress: Progress | None = None,
) -> TorquePrediction:
    """Predict the torques of a recording with an identified model, filtered as in its identification.

    Parameters
    ----------
    recording
        A recording, or the path of one; best one that the model was not identified from.
    model
        An identification, its model, or the path of ``identification.json``, ``diagnosis.json`` or the folder of one.
    robot
        Configuration of the model, or the path or shipped name of one; by default that of the result.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    TorquePrediction
        Measured and predicted torques (M, n), N m or N, and the ``document`` with the errors.

    Raises
    ------
    ConfigError
        If a file does not exist.
    DataError
        If the model is unusable, or the recording is of another robot or too short.

    Examples
    --------
    >>> import armident
    >>> seen, unseen = (armident.simulate_recording("emps", name, seed=1) for name in ("emps_1", "emps_2"))
    >>> found = armident.predict(unseen, armident.identify(seen, method="idim-ls"))
    >>> found.document.held_out, found.predicted.shape == found.measured.shape
    (True, True)
    """
    (read,) = recordings_of(recording)
    config = None if robot is None else robot_of(robot, ())
    if isinstance(model, Identification):
        model = model.model
    if isinstance(model, RobotModel):
        model = model if config is None else model_of(model.document, model.path, config)
    else:
        model = load_model(Path(model), config, default=read.robot, progress=progress)
    show = progress or (lambda stage, share: None)
    notes, configured = Notes(), model.robot
    show("set-up", 0.0)
    experiments, remarks = experiments_of([read], configured, name_files=False)
    setup = _setup(experiments, model, notes)
    starts = [experiment.start for experiment in experiments]
    options = _options(model.document.options)
    experiments = shifted_experiments(corrected_experiments(experiments, configured), configured, options, setup, notes)
    show("torques", 0.5)
    with threadpool_limits(1):
        signals, blocks = _equations(model, experiments, options)
    if not any(block.t.size for block in blocks):
        raise DataError(f"{read.path}: too short to predict: the filters leave no sample. Next: record longer")
    # A prediction needs no reference.
    remarks = [remark for remark in remarks if remark != NO_REFERENCE]
    document = _document(read, model, blocks, [*remarks, *_beyond(signals, model), *notes.warnings])
    show("done", 1.0)
    theta, covariance = model.theta, model.covariance
    variance = [np.einsum("kjb,bc,kjc->kj", block.x, covariance, block.x, optimize=True) for block in blocks]
    return TorquePrediction(
        document,
        model,
        np.concatenate([block.t for block in blocks]),
        np.concatenate([block.y for block in blocks]),
        np.concatenate([block.x @ theta for block in blocks]),
        np.sqrt(np.maximum(np.concatenate(variance), 0.0)),
        np.concatenate([block.t + start for block, start in zip(blocks, starts, strict=True)]),
    )


def _setup(experiments: Sequence[Experiment], model: RobotModel, notes: Notes) -> SetupCheck | None:
    """Check the set-up of the recording; decisive findings become warnings."""
    try:
        found = check_setup(experiments, model.robot)
    except DataError as error:
        notes.warnings.append(f"the set-up was not checked: {error}")
        return None
    notes.warnings += [f"{each.message}; correct it by: {each.remedy}" for each in found.findings if each.decisive]
    return found


def _options(written: dict[str, Any]) -> Options:
    """Return the options of the identification that still exist."""
    known = {field.name for field in fields(Options)}
    return Options(**{name: value for name, value in written.items() if name in known})


def _equations(
    model: RobotModel, experiments: Sequence[Experiment], options: Options
) -> tuple[Sequence[Derivatives], Sequence[ExperimentEquations]]:
    """Return the derivatives, and the equations after the filters of IDIM-LS as in an identification."""
    robot, arm = model.robot, model.arm
    dt, lengths = experiments[0].dt, [e.q.shape[0] for e in experiments]
    bandwidth = options.bandwidth_hz or robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], dt)
    signals = smoothed_derivatives(experiments, robot, options, bandwidth)
    if has_published_filters(robot, options) and robot.preprocessing is not None:
        return signals, published_equations(arm, experiments, robot.preprocessing)
    decimation = decimation_of("idim-ls", dt, bandwidth, None, samples=lengths, rows=least_rows(arm))
    return signals, equations(arm, experiments, signals, decimation)


def _document(
    recording: Recording, model: RobotModel, blocks: Sequence[ExperimentEquations], warnings: Sequence[str]
) -> PredictionDocument:
    names = [joint.name for joint in model.robot.joints]
    overall, by_joint = relative_torque_errors(blocks, model.theta)
    torque = np.concatenate([np.where(block.keep, block.y, 0.0) for block in blocks])
    kept = np.maximum(np.concatenate([block.keep for block in blocks]).sum(axis=0), 1)
    torque_rms = np.sqrt(np.sum(torque**2, axis=0) / kept)

    def named(values: Array) -> dict[str, float]:
        return {name: float(value) for name, value in zip(names, values, strict=True)}

    used, known = reference(recording), model.document
    return PredictionDocument(
        robot=model.robot.name,
        model=str(model.path),
        method=known.method,
        recording=used,
        held_out=all(used.sha256 != own.sha256 for own in (known.recording, *(known.further_recordings or ()))),
        relative_error_pct=overall,
        relative_error_pct_by_joint=named(by_joint),
        identification_error_pct=known.relative_error_pct,
        identification_error_pct_by_joint=known.relative_error_pct_by_joint,
        error_rms=named(torque_rms * by_joint / 100),
        torque_rms=named(torque_rms),
        units={joint.name: "N m" if joint.type == "revolute" else "N" for joint in model.robot.joints},
        samples=sum(block.t.size for block in blocks),
        rate_hz=_rate(blocks),
        warnings=list(dict.fromkeys(warnings)),
        versions=versions(),
    )


def _rate(blocks: Sequence[ExperimentEquations]) -> float:
    t = max((block.t for block in blocks), key=len)
    return float(1.0 / (t[1] - t[0])) if t.size > 1 else 0.0


def _beyond(signals: Sequence[Derivatives], model: RobotModel) -> list[str]:
    """Return a warning for every joint that leaves the range over which the model was identified."""
    found = []
    q = np.concatenate([s.q for s in signals])
    speed = np.quantile(np.abs(np.concatenate([s.qd for s in signals])), SPEED_QUANTILE, axis=0)
    names = [joint.name for joint in model.robot.joints]
    for each in model.document.residual_statistics or []:
        k = names.index(each.joint)
        unit = "rad" if model.robot.joints[k].type == "revolute" else "m"
        (low, high), (least, most) = each.position_range, (float(q[:, k].min()), float(q[:, k].max()))
        if least < low - BEYOND * (high - low) or most > high + BEYOND * (high - low):
            found.append(
                f"{each.joint} moves over [{least:.3g}, {most:.3g}] {unit}; the model was identified over "
                f"[{low:.3g}, {high:.3g}] {unit}"
            )
        if speed[k] > (1 + BEYOND) * each.velocity_limit:
            found.append(
                f"{each.joint} moves at {speed[k]:.3g} {unit}/s; the model was identified up to "
                f"{each.velocity_limit:.3g} {unit}/s"
            )
    return found
