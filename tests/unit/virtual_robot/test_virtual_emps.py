"""Virtual EMPS (one axis, voltage, 1 kHz), and drives with velocity feedback on EMPS and TX40."""

import json
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal
from scipy.io import loadmat

from armident.configs import ConfigError, RobotConfig, Trajectory, load_robot, load_session, load_trajectory
from armident.configs.schema.trajectory import Move
from armident.daq.recording import Recording, read_recording
from armident.drivers.canopen.bus_load import check_fits
from armident.identify.estimators.methods import Method
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.signals.differentiate import differentiate
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot import noise, servo
from armident.virtual_robot.arm import Arm
from armident.virtual_robot.inertias import HERE, plant_parameters
from armident.virtual_robot.noise import Noise
from armident.virtual_robot.offline import simulate_recording
from armident.virtual_robot.plant import Plant
from armident.virtual_robot.run import record_robot

NAMES = ("m1", "fv1", "fc1", "off1")
PUBLISHED = (95.1089, 203.5034, 20.3935, -3.1648)
REPEAT = 6240
"""Period of the reference of the measured EMPS in samples."""


@cache
def emps() -> RobotConfig:
    return load_robot("emps")


@cache
def excitation() -> Trajectory:
    return load_trajectory("trajectories/emps_excitation.yaml")


@cache
def recorded(seed: int, level: float) -> Recording:
    return simulate_recording(emps(), excitation(), seed, level)


def experiment(recording: Recording) -> Experiment:
    (found,), notes = experiments_from_recording(recording, recording.robot)
    assert notes == []
    return found


@pytest.mark.slow
def test_recording_is_in_volts_and_metres_at_1_khz() -> None:
    recording = recorded(0, 1.0)
    fields = recording.samples.fields
    assert recording.sample_rate_hz == pytest.approx(1000.0)
    assert (fields["voltage"].unit, fields["position"].unit) == ("V", "m")
    assert fields["position"].scale == pytest.approx([50e-9])
    assert recording.samples.sync.size * 1e-3 == pytest.approx(excitation().duration, abs=1.0)


def test_resolution_is_that_of_the_measured_positions(shared_data: Path) -> None:
    file = shared_data / "emps" / "DATA_EMPS.mat"
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    per_metre = emps().joints[0].drive.counts_per_unit
    assert per_metre is not None
    counts = np.diff(loadmat(file)["qm"].ravel()) * per_metre
    assert np.abs(counts - np.round(counts)).max() < 1e-5
    assert np.gcd.reduce(np.round(counts).astype(np.int64)) == 1


def test_parameters_of_the_plant_are_the_published_ones() -> None:
    assert tuple(plant_parameters(emps())[name] for name in NAMES) == PUBLISHED


@pytest.mark.slow
def test_voltage_is_the_published_law_of_the_recorded_positions() -> None:
    found = experiment(recorded(0, 0.0))
    assert found.q_ref is not None
    voltage = found.tau[:, 0] / 35.15065
    q, error = found.q[:, 0], (found.q_ref - found.q)[:, 0]
    law = 243.45 * (160.18 * error[2:] - (q[2:] - q[:-2]) / 2e-3)
    # Reported in steps of 10 mV.
    assert np.abs(voltage[2:] - law).max() < 5.01e-3
    assert np.abs(voltage).max() > 3.0


def test_axis_moves_as_a_continuous_simulation_of_its_equation_says() -> None:
    """Newton's law with the recorded force held between samples reproduces the recorded positions."""
    found = experiment(recorded(0, 0.0))
    m, fv, fc, off = PUBLISHED
    q, qd, worst, steps = float(found.q[0, 0]), 0.0, 0.0, 50
    for k in range(1500):
        worst = max(worst, abs(q - float(found.q[k, 0])))
        for _ in range(steps):
            h = 1e-3 / steps
            force = found.tau[k, 0] - off - fv * qd - fc * 2 / np.pi * np.arctan(5000.0 * qd)
            # Friction is stiff: one implicit step on its slope.
            slope = fv + fc * 2 / np.pi * 5000.0 / (1 + (5000.0 * qd) ** 2)
            qd += h * force / (m + h * slope)
            q += h * qd
    # The voltage is rounded to 10 mV, 0.35 N: after a second and a half some tenths of a millimetre at most.
    assert worst < 5e-4
    assert abs(q) > 0.05


def test_noise_has_the_size_given_in_all_and_below_20_hz() -> None:
    source, count = Noise(emps(), 1e-3, seed=2), 200_000
    force = np.empty(count)
    for k in range(count):
        current, disturbance = source.next()
        force[k] = current[0] * emps().joints[0].drive.gain + disturbance[0]
    frequency, density = signal.welch(force, fs=1000.0, nperseg=4096)
    size = noise.SIZES["emps"]
    assert np.var(force) == pytest.approx(size.sampled[0], rel=0.05)
    low = float(np.sum(density[frequency <= 20.0]) * frequency[1])
    assert low == pytest.approx(size.decimated[0], rel=0.1)


def test_noise_is_what_the_measured_axis_does_not_repeat(shared_data: Path) -> None:
    file = shared_data / "emps" / "DATA_EMPS.mat"
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    data = {key: loadmat(file)[key].ravel() for key in ("qm", "qg", "vir")}
    assert np.abs(data["qg"][REPEAT:] - data["qg"][:-REPEAT]).max() < 1e-14
    motion = differentiate(data["qm"][:, None], 1e-3)
    qd, qdd = motion.qd[:, 0], motion.qdd[:, 0]
    m, fv, fc, off = PUBLISHED
    residual = 35.15065 * data["vir"] - (m * qdd + fv * qd + fc * 2 / np.pi * np.arctan(5000 * qd) + off)
    passes = residual[: 3 * REPEAT].reshape(3, REPEAT)
    alone = (passes - passes.mean(axis=0)) * np.sqrt(3 / 2)
    low = signal.sosfiltfilt(signal.butter(4, 20.0, fs=1000.0, output="sos"), alone, axis=1)[:, 200:-200]
    size = noise.SIZES["emps"]
    assert np.var(alone) == pytest.approx(size.sampled[0], rel=0.05)
    assert np.var(low) == pytest.approx(size.decimated[0], rel=0.05)


def test_every_virtual_arm_has_a_noise_and_a_name() -> None:
    assert set(noise.SIZES) == {path.name.removesuffix("_inertias.yaml") for path in HERE.glob("*_inertias.yaml")}
    assert set(servo.OWN_PERIODS) <= set(noise.SIZES)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "seed"),
    [
        ("idim-piv", 1),
        *(
            pytest.param(method, seed, marks=pytest.mark.nightly)
            for method, seed in (("idim-piv", 2), *product(("idim-iv", "didim"), (1, 2)))
        ),
    ],
)
def test_identification_recovers_the_published_parameters(method: Method, seed: int) -> None:
    result = identify_experiment([experiment(recorded(seed, 1.0))], emps(), Options(method=method))
    assert result.converged
    assert result.names == NAMES
    assert (np.abs(result.theta - PUBLISHED) < 3 * result.std).all(), (result.theta - PUBLISHED) / result.std
    assert (result.std < 0.01 * np.abs(PUBLISHED)).all()


@pytest.mark.slow
def test_session_of_the_axis_records_and_tells_the_truth(tmp_path: Path) -> None:
    record_robot(Path("emps_cell.yaml"), tmp_path / "a.mcap", seed=5, truth=tmp_path / "truth.json")
    read = read_recording(tmp_path / "a.mcap")
    expected = simulate_recording(emps(), excitation(), seed=5, settle=0.5)
    for name in ("position", "voltage"):
        np.testing.assert_array_equal(read.samples.raw[name], expected.samples.raw[name])
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert [truth[name] for name in NAMES] == list(PUBLISHED)
    assert (truth["kp1"], truth["kv1"], truth["velocity_samples"]) == (160.18, 243.45, 2.0)
    assert truth["velocity_feedback"] == 1.0
    assert "velocity_filter_hz" not in truth


def test_known_controller_cannot_be_run_without_its_velocity_feedback() -> None:
    with pytest.raises(ConfigError, match=r"'emps': its controller .* feeds back the velocity"):
        Arm(emps(), [0.0], velocity_feedback=False)


def test_sync_must_be_a_multiple_of_the_drives_own_period() -> None:
    with pytest.raises(ConfigError, match=r"SYNC period 1500 us: .* a multiple of 1000 us"):
        Arm(emps(), [0.0], sync_period=1.5e-3)


def test_drives_that_report_different_efforts_are_refused() -> None:
    tx40 = load_robot("tx40")
    odd = tx40.joints[0].model_copy(update={"drive": tx40.joints[0].drive.model_copy(update={"signal": "torque"})})
    mixed = tx40.model_copy(update={"joints": (odd, *tx40.joints[1:])})
    with pytest.raises(ConfigError, match="its drives report current and torque"):
        simulate_recording(mixed, short(), seed=0)


# Velocity feedback on the TX40


def short() -> Trajectory:
    move = Move(to=(0.4, 0.3, 1.2, 0.5, 0.5, -0.6), duration=0.5)
    return Trajectory(schema="armident/trajectory/1", start=(0.0, 0.0, 1.57, 0.0, 0.0, 0.0), moves=(move,))


def motor_side(recording: Recording) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Position rad, demand rad and current A of the motors; the demand at every sample."""
    samples, demand = recording.samples, recording.streams["demand"]
    knots = demand.si("demand")
    wanted = np.stack([np.interp(samples.sync, demand.sync, knots[:, j]) for j in range(knots.shape[1])], axis=1)
    return samples.si("position"), wanted, samples.si("current")


@pytest.mark.parametrize("feedback", [True, False])
def test_current_of_the_tx40s_drives_is_the_law_of_figure_b_1(feedback: bool) -> None:
    robot = load_robot("tx40")
    recording = simulate_recording(robot, short(), seed=0, noise=0.0, settle=0.1, velocity_feedback=feedback)
    q, wanted, current = motor_side(recording)
    kp, kv = servo.cascade_gains(robot, Plant(robot, short().start).mass_matrix())
    error = wanted - q
    keep = np.exp(-2 * np.pi * servo.VELOCITY_FILTER_HZ * servo.CONTROL_PERIOD)
    change = np.diff(-q if feedback else error, axis=0, prepend=(-q if feedback else error)[:1])
    velocity = signal.lfilter([1 - keep], [1.0, -keep], change, axis=0) / servo.CONTROL_PERIOD
    law = kv * (kp * error + velocity)
    inside = slice(20, 3000)
    rated = np.array([joint.drive.rated for joint in robot.joints])
    # Demands at the set points are whole counts, and between them on a straight line: only the report is rounded.
    slack = 5.001e-4 * rated
    assert (np.abs(current - law)[inside] < slack).all()
    assert (np.abs(current).max(axis=0) > 20 * slack).all()


def test_velocity_feedback_lags_behind_by_the_velocity_over_kp() -> None:
    """In the middle of the move friction and gravity require the same ``kp e`` of both kinds of drives."""
    robot, errors = load_robot("tx40"), []
    middle = slice(1500, 1750)
    for feedback in (True, False):
        recording = simulate_recording(robot, short(), seed=0, noise=0.0, settle=0.1, velocity_feedback=feedback)
        q, wanted, _ = motor_side(recording)
        errors.append((wanted - q)[middle].mean(axis=0))
    kp, _ = servo.cascade_gains(robot, Plant(robot, short().start).mass_matrix())
    qd = (wanted[middle.stop] - wanted[middle.start]) / (250 * servo.CONTROL_PERIOD)
    np.testing.assert_allclose(errors[0] - errors[1], qd / kp, rtol=0.1, atol=0.05)


def test_session_of_the_axis_fits_a_bus_of_1_mbit() -> None:
    session = load_session("emps_cell.yaml")
    assert session.sync_period == pytest.approx(servo.control_period(emps()))
    check_fits(session.model_copy(update={"bus": session.bus.model_copy(update={"bitrate": 1_000_000})}))
    assert session.setpoints is not None
    load_trajectory(session.setpoints.trajectory).check(emps())
