"""Contents of a view: curves, poses, colours and findings of a recording, thinned for the eye."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.daq.recording import Recording
from armident.identify.api.arguments import Progress
from armident.identify.api.prediction_api import TorquePrediction, predict
from armident.identify.documents.diagnosis import VERDICTS, DiagnosisDocument
from armident.identify.documents.files import load_document
from armident.identify.identification.from_recording import joint_positions, joint_torques
from armident.identify.monitoring.reidentify.summary import finding_lines
from armident.identify.report.plots import kept_points
from armident.identify.view.arm import FULL, Arm

Times = NDArray[np.int64]
Signals = Mapping[str, tuple[Times, Array]]

POINTS = 20_000
"""Most points of a curve, extremes kept, and most poses and colours of the arm: an hour is as large as a minute."""
POSE_S, COLOUR_S = 0.02, 0.1
"""Shortest times between two poses of the arm, and over which the unexplained torque is averaged for a colour, s."""


@dataclass(frozen=True, eq=False)
class Plot:
    """One quantity; ``curves``: by joint, or joint/kind, times (M,), ns UTC, and values (M,)."""

    path: str
    title: str
    curves: Signals


@dataclass(frozen=True, eq=False)
class Contents:
    """Everything that a viewer shows; times in ns UTC.

    ``poses``: times (P,) and positions (P, n). ``levels``: times (K,) and unexplained torques (K, n) in standard
    deviations, root mean square until the next; ``None`` without a model. ``findings``: Markdown.
    """

    robot: RobotConfig
    arm: Arm
    plots: tuple[Plot, ...]
    poses: tuple[Times, Array]
    levels: tuple[Times, Array] | None
    findings: str


def prediction_of(
    recording: Recording,
    model: Path | None,
    beside: Path,
    robot: RobotConfig | None,
    remarks: list[str],
    report: Progress,
) -> TorquePrediction | None:
    """Return the torques of a model, by default of the identification ``beside`` the recording, if it can be used."""
    if model is None and not (beside / "identification.json").is_file():
        remarks.append("no model, so only measured signals: give --model, or run armident identify first")
        return None
    try:
        prediction = predict(recording, model or beside, robot, progress=report)
    except DataError as error:
        if model is not None:
            raise
        remarks.append(f"only measured signals: {error}")
        return None
    remarks += prediction.document.warnings
    return prediction


def contents_of(
    recording: Recording, robot: RobotConfig, arm: Arm, prediction: TorquePrediction | None, diagnosis: Path
) -> Contents:
    """Return the contents of a recording with predicted torques; ``diagnosis``: file of findings, if any."""
    samples = recording.samples
    if samples.sync.size < 2:
        raise DataError(f"{recording.path}: has no samples")
    t_ns, q = samples.t_ns, joint_positions(samples, "position", robot)
    step = max(1, round(POSE_S * recording.sample_rate_hz), -(-len(q) // POINTS))
    poses, levels, lines = (t_ns[::step], q[::step]), None, ["No model: unexplained torques are not known."]
    if samples.named("velocity") is not None:
        velocity = t_ns, joint_positions(samples, "velocity", robot)
    else:
        apart = np.maximum(np.diff(poses[0]), 1)
        velocity = poses[0][:-1] + apart // 2, np.diff(poses[1], axis=0) / (1e-9 * apart[:, None])
    torques = {"/measured": (t_ns, joint_torques(samples, robot))}
    plots = [
        _plot(robot, "position", "Position, {}", ("rad", "m"), {"": (t_ns, q)}),
        _plot(robot, "velocity", "Velocity, {}", ("rad/s", "m/s"), {"": velocity}),
    ]
    if prediction is not None:
        at = np.interp(
            prediction.since_start * recording.sample_rate_hz, samples.sync - samples.sync[0], t_ns - t_ns[0]
        )
        when, deviations = t_ns[0] + np.round(at).astype(np.int64), standardised(prediction)
        torques["/predicted"] = when, prediction.predicted
        unexplained = {"": (when, prediction.measured - prediction.predicted)}
        plots += [
            _plot(robot, "unexplained", "Unexplained torque, {}", ("N m", "N"), unexplained),
            _plot(robot, "deviations", "Unexplained torque, standard deviations", ("", ""), {"": (when, deviations)}),
        ]
        levels, lines = _levels(when, deviations), _model_lines(prediction, deviations)
        if prediction.model.path.name == diagnosis.name:
            diagnosis = prediction.model.path
    plots.insert(2, _plot(robot, "torque", "Torque, {}", ("N m", "N"), torques))
    findings = "\n".join([*_heading(recording), *lines, *_diagnosis_lines(diagnosis)])
    return Contents(robot, arm, tuple(plots), poses, levels, findings)


def standardised(prediction: TorquePrediction) -> Array:
    """Return the unexplained torques (M, n) in units of their standard deviations."""
    model = prediction.model
    power = {each.joint: sum(each.band_power) for each in model.document.residual_statistics or ()}
    if len(power) < model.n:
        raise DataError(f"{model.path}: has no statistics of the residuals: identify again")
    noise = np.array([power[joint.name] for joint in model.robot.joints])
    variance = np.maximum(noise + prediction.std**2, np.finfo(float).tiny)
    return np.asarray((prediction.measured - prediction.predicted) / np.sqrt(variance))


def _plot(robot: RobotConfig, path: str, title: str, units: tuple[str, str], signals: Signals) -> Plot:
    """Return the plot of signals (N, n); ``units``: of joints that turn and of those that slide."""
    used = dict.fromkeys(units[joint.type == "prismatic"] for joint in robot.joints)
    curves = {}
    for kind, (t_ns, values) in signals.items():
        for joint, column in zip(robot.joints, values.T, strict=True):
            kept = kept_points([column], POINTS)
            curves[joint.name + kind] = t_ns[kept], column[kept]
    return Plot(path, title.format(" or ".join(used)), curves)


def _levels(t_ns: Times, deviations: Array) -> tuple[Times, Array]:
    width = max(round(1e9 * COLOUR_S), -(-int(t_ns[-1] - t_ns[0]) // POINTS))
    _, first, counts = np.unique((t_ns - t_ns[0]) // width, return_index=True, return_counts=True)
    return t_ns[first], np.sqrt(np.add.reduceat(deviations**2, first) / counts[:, None])


def _heading(recording: Recording) -> list[str]:
    samples, name = recording.samples, "" if recording.path is None else recording.path.name
    begin = datetime.fromtimestamp(int(samples.t_ns[0]) / 1e9, UTC)
    size = f"{samples.sync.size} samples at {recording.sample_rate_hz:g} Hz, {len(recording.gaps)} gaps"
    torn = "" if recording.missing is None else f" The recording is torn: {recording.missing}."
    return [f"# {recording.robot.name}: {name}", f"{size}, from {begin:%Y-%m-%d %H:%M:%S} UTC on.{torn}", ""]


def _model_lines(prediction: TorquePrediction, deviations: Array) -> list[str]:
    document = prediction.document
    rows = [
        f"| {joint} | {document.relative_error_pct_by_joint[joint]:.2f} | {document.error_rms[joint]:.3g} {unit} "
        f"| {size:.1f} |"
        for (joint, unit), size in zip(document.units.items(), np.sqrt(np.mean(deviations**2, axis=0)), strict=True)
    ]
    return [
        f"Model `{document.model}` ({document.method}): {prediction.model.document.sentence}. {document.sentence}\n",
        "| joint | error, % | unexplained, rms | in standard deviations |",
        "| --- | --- | --- | --- |",
        *rows,
        f"\nColours of the joints, root mean square over {COLOUR_S:g} s or more: dark blue 0, yellow {FULL:g} standard "
        "deviations or more. Noise alone has 1.\n",
    ]


def _diagnosis_lines(path: Path) -> list[str]:
    if not path.is_file():
        return []
    document = load_document(path, DiagnosisDocument)
    lines = [f"- {line}" for line in finding_lines(document)]
    return [f"## Diagnosis: {document.verdict.replace('_', ' ')}", f"{VERDICTS[document.verdict]}\n", *lines]
