"""Torques of an exported file, computed by the program that reads it, beside those of the identified model."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armident.configs import load_trajectory
from armident.daq.recording import read_recording
from armident.identify.documents.base import reference
from armident.identify.identification.from_recording import experiments_of
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import smoothed_derivatives
from armident.identify.model_export import consumers
from armident.identify.model_export.consumers import GivenMotion, NoProgramError, ProgramRun
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.sheet import Measured
from armident.identify.robot.chain import Floats
from armident.identify.signals.bandpass import butterworth
from armident.identify.signals.bandwidth import motion_bandwidth

DURATION_S, PERIOD_S = 2.5, 0.001
"""Duration and sampling period of the motion that is made here, s."""

RANGE = 0.8
"""Share of the identified range of positions and velocities that it uses."""

SETTLED_S = 0.5
"""Time in which elastic joints and bristles come from rest to the motion; its torques are not compared, s."""

MOST_SAMPLES = 10_000
"""Samples of a recording that are used: the slowest program, Python, takes some seconds for them."""

IMPACT_BAND_HZ = 50.0
"""Band in which torques of an arm with backlash are compared: an impact is one sample of the model, and filters of an
identification leave nothing above, Hz."""

ANGLE, SPEED = 1.0, 2.0
"""Half a range of positions (rad or m), and a velocity per s, of a joint without known ones."""

Runner = Callable[[ExportedModel, Sequence[Path], GivenMotion], ProgramRun]

RUNNERS: dict[str, Runner] = {
    "urdf": consumers.run_urdf,
    "mjcf": consumers.run_mjcf,
    "sdf": consumers.run_sdf,
    "python": consumers.run_python,
    "c": consumers.run_c,
    "fmu": lambda model, files, motion: consumers.run_fmu(model, files, motion, identified_torque(model, motion)),
    "pinocchio": consumers.run_pinocchio,
    "lerobot": consumers.run_lerobot,
}
"""Program that reads each format; no program reads the tables."""


def measure(model: ExportedModel, format_name: str, files: Sequence[Path], motion: GivenMotion) -> Measured:
    """Return the difference of the torques of a file from those of the identified model along a motion."""
    try:
        run = RUNNERS[format_name](model, files, motion)
    except NoProgramError as error:
        return Measured(missing=str(error))
    expected = identified_torque(model, motion)[:: run.every]
    settled = min(round(SETTLED_S / motion.dt / run.every), len(expected) // 5)
    supplement = next((file for file in files if file.name.endswith("_supplement.py")), None)
    added = 0.0 if supplement is None else consumers.module_torque(supplement, motion) - run.dry
    compared, title = [expected, run.torque - expected, run.torque + added - expected], motion.title
    period = motion.dt * run.every
    if any(effect.effect == "backlash" for effect in model.effects) and period < 0.5 / IMPACT_BAND_HZ:
        compared = [butterworth(torque, period, IMPACT_BAND_HZ) for torque in compared]
        title += f", below {IMPACT_BAND_HZ:g} Hz"
    sizes, errors, remaining = (np.linalg.norm(torque[settled:], axis=0) for torque in compared)
    size = max(float(np.linalg.norm(sizes)), 1e-300)
    moved = identified_torque(model, motion, model.theta)[:: run.every] - expected
    physical = 100.0 * float(np.linalg.norm(moved) / max(float(np.linalg.norm(expected)), 1e-300))
    remarks = [run.remark, f"the step to a physical arm alone changes them by {physical:.2g} %"]
    if motion.recorded is not None:
        recorded = motion.recorded[:: run.every]
        own, of_file = (
            100.0 * float(np.linalg.norm(each[settled:]) / max(float(np.linalg.norm(recorded[settled:])), 1e-300))
            for each in (expected - recorded, run.torque + added - recorded)
        )
        completed = "" if supplement is None else " with the supplement"
        remarks.append(
            f"the recorded torques differ by {own:.2g} % from those of the identified model, and by {of_file:.2g} % "
            f"from those of the file{completed}"
        )
    by_joint = 100.0 * errors / np.maximum(sizes, 1e-300)
    return Measured(
        run.program,
        title,
        float(100.0 * np.linalg.norm(errors) / size),
        {joint.name: float(value) for joint, value in zip(model.joints, by_joint, strict=True)},
        [remark for remark in remarks if remark],
        supplement="" if supplement is None else supplement.name,
        error_pct_with_supplement=None if supplement is None else float(100.0 * np.linalg.norm(remaining) / size),
    )


def identified_torque(model: ExportedModel, motion: GivenMotion, theta: Floats | None = None) -> Floats:
    """Return the torques (N, n) of the identified model with its effects, N m or N.

    ``theta``: parameters, by default those before the arm was made physical.
    """
    theta = model.theta_base if theta is None else theta
    arm = model.arm.anchored(theta)
    torque = arm.inverse_dynamics(theta, motion.q, motion.qd, motion.qdd)
    if arm.e == 0:
        return torque
    moved = replace(arm.motion(motion.q, motion.qd, motion.qdd, motion.dt), duration=model.recorded_s)
    return torque + arm.term_torque(moved, theta[theta.size - arm.e :])


def motion_of(model: ExportedModel, file: Path | None = None) -> GivenMotion:
    """Return the motion of a recording or trajectory, or one within the range of the identification.

    Raises ConfigError or DataError if the file cannot be read or is of another robot.
    """
    if file is None:
        return _own_motion(model)
    if file.suffix in (".yaml", ".yml"):
        trajectory = load_trajectory(file)
        trajectory.check(model.robot, str(file))
        q = trajectory.sample(PERIOD_S)
        qd = np.gradient(q, PERIOD_S, axis=0)
        return GivenMotion(q, qd, np.gradient(qd, PERIOD_S, axis=0), PERIOD_S, f"the trajectory {file.name}")
    recording = read_recording(file)
    experiments, _ = experiments_of([recording], model.robot, name_files=False)
    robot = model.robot
    bandwidth = robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], experiments[0].dt)
    every = zip(smoothed_derivatives(experiments, robot, Options(), bandwidth), experiments, strict=True)
    signals, experiment = max(every, key=lambda pair: pair[0].q.shape[0])
    used = (model.document.recording, *(model.document.further_recordings or ()))
    held_out = all(reference(recording).sha256 != each.sha256 for each in used)
    title = f"{file.name} ({'held out' if held_out else 'a recording of the identification'})"
    if signals.q.shape[0] > MOST_SAMPLES:
        title = f"the first {MOST_SAMPLES} samples of {title}"
    q, qd, qdd = (x[:MOST_SAMPLES] for x in (signals.q, signals.qd, signals.qdd))
    return GivenMotion(q, qd, qdd, experiment.dt, title, experiment.tau[:MOST_SAMPLES])


def _own_motion(model: ExportedModel) -> GivenMotion:
    """Return three sines for each joint within 80 % of the identified positions and velocities, beginning at rest."""
    rng, t = np.random.default_rng(0), np.arange(0.0, DURATION_S, PERIOD_S)
    known = {each.joint: each for each in model.document.residual_statistics or ()}
    columns = []
    for k, joint in enumerate(model.robot.joints):
        low, high = model.position_limits(k) or (-ANGLE, ANGLE)
        speed = min(joint.limits.velocity, SPEED)
        if joint.name in known:
            (low, high), speed = known[joint.name].position_range, known[joint.name].velocity_limit
        waves = 2.0 * np.pi * rng.uniform(0.3, 1.5, 3)
        shape = (np.sin(t[:, None] * waves + rng.uniform(0.0, 2.0 * np.pi, 3)) / waves).sum(axis=1)
        fade = np.minimum(t / SETTLED_S, 1.0)
        shape *= fade**3 * (10.0 - 15.0 * fade + 6.0 * fade**2)
        rates = np.gradient(shape, PERIOD_S)
        scale = RANGE * min(0.5 * (high - low) / np.abs(shape).max(), speed / np.abs(rates).max())
        columns.append((scale * shape + 0.5 * (low + high), scale * rates, scale * np.gradient(rates, PERIOD_S)))
    q, qd, qdd = (np.stack(list(each), axis=1) for each in zip(*columns, strict=True))
    return GivenMotion(q, qd, qdd, PERIOD_S, f"a motion of {DURATION_S:g} s within the identified range")
