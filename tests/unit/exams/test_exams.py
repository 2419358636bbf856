"""Public exams: the command without recordings, models that are known, and the figures of the EMPS."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import savemat
from typer.testing import CliRunner

from armident.configs import load_robot
from armident.identify.effects.terms import arm_model
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.simulation import simulate
from armident.identify.signals.bandpass import butterworth
from tests.exams import emps, friction, kr300, tx40, ur10e
from tests.reproduction.recordings import EMPS_FILE, EMPS_PERIOD
from tests.tools.command_line import NAME, laboratory

Floats = NDArray[np.float64]

KNOWN = {"mass": 95.0, "viscous_up": 200.0, "viscous_down": 200.0, "coulomb_up": 20.0, "coulomb_down": 20.0}
SWITCHING = 1e7
"""Sign smoothing, s/m, that reverses dry friction within 0.1 um/s."""


@pytest.mark.parametrize(
    ("arguments", "place"),
    [
        (["emps", "--data", "{folder}"], "nonlinearbenchmark.org"),
        (["tx40", "--data", "{folder}"], "figaroh-examples"),
        (["friction", "--data", "{folder}"], friction.REPOSITORY),
        (["friction"], friction.REPOSITORY),
        (["kr300", "--data", "{folder}"], kr300.REPOSITORY),
        (["kr300"], kr300.REPOSITORY),
        (["ur10e", "--data", "{folder}"], ur10e.REPOSITORY),
        (["ur10e"], ur10e.REPOSITORY),
    ],
)
def test_without_recordings_one_line_says_where_to_get_them(arguments: list[str], place: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(
        laboratory("tests.exams.command:exam"), [NAME, *(word.format(folder=tmp_path) for word in arguments)]
    )
    assert result.exit_code == 2
    assert place in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def known_axis(seconds: float = 6.0) -> emps.Axis:
    """A virtual EMPS in its closed loop, by the simulation of the package, which smooths the sign of the friction."""
    robot = load_robot("emps")
    robot = robot.model_copy(update={"friction": robot.friction.model_copy(update={"sign_smoothing": SWITCHING})})
    t = np.arange(round(seconds / EMPS_PERIOD)) * EMPS_PERIOD
    reference = (0.1 * (1.0 - np.cos(2.0 * t)) + 0.01 * np.sin(9.0 * t) ** 2)[:, None]
    gain = robot.joints[0].drive.gain
    loop = DiscreteController.cascade(emps.KP, emps.KV, gain, EMPS_PERIOD, saturation=10 * gain, velocity_samples=2)
    run = simulate(arm_model(robot), [95.0, 200.0, 20.0, 0.0], loop, reference, EMPS_PERIOD)
    assert run.diverged_at is None
    return emps.Axis(run.q[:, 0], run.qd[:, 0], reference[:, 0], run.tau[:, 0], np.zeros(t.size))


@pytest.mark.slow
def test_a_fit_of_the_simulated_position_recovers_a_known_axis() -> None:
    axis = known_axis()
    assert emps.rmse_mm(KNOWN, axis) < 0.1  # two integrators; the least error on the real axis is 1.7 mm
    found = emps.fitted(emps.PUBLISHED, [axis])
    assert found == pytest.approx(KNOWN, rel=5e-3)


@pytest.mark.slow
def test_an_axis_moves_in_its_closed_loop_as_in_the_simulation_of_the_package() -> None:
    axis = known_axis()
    assert emps.closed_loop_error_pct(KNOWN, axis) < 1.0
    assert emps.closed_loop_error_pct({**KNOWN, "coulomb_up": 24.0, "coulomb_down": 24.0}, axis) > 3.0


@pytest.mark.slow
def test_the_emps_has_the_figures_of_the_results_page(shared_data: Path) -> None:
    if not (shared_data / "emps" / emps.PULSES_FILE).is_file():
        pytest.skip("the EMPS is not in the measured data")
    training, held = (emps.load(shared_data, name) for name in (EMPS_FILE, emps.PULSES_FILE))
    plain = emps.fitted(emps.PUBLISHED, [training])
    assert (emps.rmse_mm(plain, training), emps.rmse_mm(plain, held)) == pytest.approx((1.71, 8.55), abs=0.05)
    assert emps.closed_loop_error_pct(plain, held) == pytest.approx(4.59, abs=0.02)
    level = emps.level_on(plain, held)
    assert level["coulomb_up"] == pytest.approx(1.019 * plain["coulomb_up"], rel=2e-3)
    assert emps.rmse_mm(level, held) < 1.3


def known_record(frequency_hz: float, zero: float) -> friction.Record:
    """A joint of known friction, inertia and error of the gravity model, at one speed, at rest at both ends."""
    t = np.arange(10_000) * 1e-3
    q = 0.3 * np.sin(2.0 * np.pi * frequency_hz * t) * np.sin(np.pi * t / 10.0) ** 2
    qd = np.gradient(q, 1e-3)
    dry = friction.bristles(q, friction.PRESLIDING_RAD[1])
    target = 0.3 * dry + 0.5 * qd + 0.2 * np.gradient(qd, 1e-3) + 0.4 * np.cos(q) + zero
    return friction.Record(q, qd, target, 1e-3, 1e-3, None)


@pytest.mark.slow
def test_a_known_joint_is_predicted_at_the_speed_left_out_but_for_its_zero() -> None:
    records = [known_record(frequency, zero) for frequency, zero in ((0.2, 0.2), (0.3, -0.1))]
    held = known_record(0.5, 0.5)
    choice = friction.chosen(records)
    model = friction.fit(choice, records)
    other, _, own, _ = friction.errors(model, held)
    assert own < 0.05 * np.std(held.target)  # of the filter of the acceleration
    assert other == pytest.approx(0.45, abs=0.03)  # 0.5 of its own less 0.05 of the others
    assert friction.errors(friction.fit(choice, records, rigid=False), held)[2] > 3 * own


def test_the_forearm_follows_the_programmed_path_from_the_start_posture() -> None:
    upper, fore = friction.tilts(np.zeros(1), np.zeros(1))
    assert (upper[0], fore[0]) == pytest.approx(friction.START_RAD)
    t = np.arange(0.0, 20.0, 2e-3)
    moving = friction.forearm_tilt(t, np.full(t.size, upper[0]), 0.16)
    assert np.ptp(moving) > 0.3
    record = replace(known_record(0.1, 0.0), forearm=np.zeros(10_000))
    assert record.rigid.shape == (10_000, 8)


def known_recording(seed: int, model: ArmModel, theta: Floats) -> tuple[Floats, Floats]:
    """Positions, degrees, and motor torques, N m, (3636, 6), of a known arm, filtered and sampled as the benchmark."""
    rng = np.random.default_rng(seed)
    n, dt = kr300.PIECE * kr300.PIECES, kr300.PERIOD / kr300.FINER
    t = np.arange(n * kr300.FINER) * dt
    envelope = np.sin(np.pi * t / (kr300.PIECE * kr300.PERIOD)) ** 4
    rates = rng.uniform(0.2, 0.8, (3, 6))
    q = envelope[:, None] * sum(0.2 * np.sin(np.outer(t, rate) + rng.uniform(0, 6, 6)) for rate in rates)
    qd = np.gradient(q, dt, axis=0)
    tau = model.inverse_dynamics(theta, q, qd, np.gradient(qd, dt, axis=0))
    sampled = (butterworth(x, dt, kr300.FILTER_HZ)[:: kr300.FINER] for x in (np.rad2deg(q), tau / kr300.RATIOS))
    position, torque = sampled
    return position, torque


@pytest.mark.slow
def test_the_torques_of_a_known_arm_are_predicted_from_another_recording_in_pieces(tmp_path: Path) -> None:
    model = ArmModel.from_config(load_robot(kr300.ROBOT))
    theta = np.random.default_rng(0).uniform(50.0, 200.0, model.base.b)
    recordings = [known_recording(seed, model, theta) for seed in (1, 2)]
    contents: dict[str, Floats] = {"u_val": np.zeros((6, 0)), "y_val": np.zeros((6, 0))}
    for part, (y, u) in zip(("train", "test"), recordings, strict=True):
        torque, position = (x.reshape(kr300.PIECES, kr300.PIECE, 6) for x in (u, y))
        contents[f"u_{part}"] = torque[:, :-1].reshape(-1, 6).T
        contents[f"y_{part}"] = position[:, 1:].reshape(-1, 6).T
    (tmp_path / kr300.FILE).parent.mkdir(parents=True)
    savemat(tmp_path / kr300.FILE, contents)
    training, test = kr300.load(tmp_path)
    known = np.isfinite(training.position)
    np.testing.assert_allclose(training.position[known], np.deg2rad(recordings[0][0])[known])
    np.testing.assert_allclose(training.torque[training.rows], recordings[0][1][training.rows])
    found = kr300.fitted([training], [])
    error = kr300.percent(test.measured - test.predicted([], found), test.measured)
    late = replace(test, torque=np.roll(test.torque, 1, axis=0))
    assert error < 0.2
    assert kr300.percent(late.measured - late.predicted([], found), late.measured) > 5 * error


@pytest.mark.slow
def test_the_tx40_has_the_parameters_of_both_published_estimates(shared_data: Path) -> None:
    if not (shared_data / "tx40").is_dir():
        pytest.skip("no tx40 folder in the measured data")
    assert "45 of 45 published values agree" in tx40.report(shared_data)


def test_the_published_model_of_the_ur10e_explains_a_recording_of_itself(tmp_path: Path) -> None:
    """An arm of six joints about one horizontal axis, whose last link alone has mass; rows around the stretch."""
    joints = "".join(
        f'<link name="l{k + 1}"/><joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        '<axis xyz="0 1 0"/><limit lower="-6" upper="6" effort="9" velocity="9"/></joint>'
        for k in range(6)
    )
    (tmp_path / ur10e.GEOMETRY).parent.mkdir(parents=True)
    (tmp_path / ur10e.GEOMETRY).write_text(f'<robot name="arm"><link name="l0"/>{joints}</robot>')
    last = [0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.7, 0.0, 0.0, 2.0]  # inertia about y, first moment along x, mass
    values = {
        "drvGains": [10.0] * 6, "pi_drvs": [0.1] * 6, "pi_frcn": [3.0, 2.0, 0.5] * 6, "pi_rgd": [0.0] * 50 + last,
    }  # fmt: skip
    text = "\n".join(f"{name} = [{' '.join(map(str, row))}]" for name, row in values.items())
    (tmp_path / ur10e.PARAMETERS).write_text(text)
    t = np.arange(ur10e.TRAINING.last + 50) / ur10e.RATE_HZ
    w = np.linspace(0.5, 1.0, 6)
    q, qd, qdd = np.sin(np.outer(t, w)), w * np.cos(np.outer(t, w)), -(w**2) * np.sin(np.outer(t, w))
    for stretch in (ur10e.TRAINING, ur10e.SECOND, *ur10e.HELD_OUT, ur10e.LOADED):
        (tmp_path / ur10e.FOLDER / stretch.file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / ur10e.FOLDER / stretch.file).touch()
    published = ur10e.Published.read(tmp_path)
    torque = published.torques(q, qd, qdd)
    own = 0.1 * qdd + 3.0 * qd + 2.0 * np.sign(qd) + 0.5
    load = 0.5 * qdd.sum(axis=1) - 0.7 * 9.81 * np.cos(q.sum(axis=1))
    assert torque == pytest.approx(own + load[:, None], abs=1e-9)
    torque[: ur10e.TRAINING.first - 1] += 1e3  # rows before the stretch count for nothing
    np.savetxt(tmp_path / ur10e.FOLDER / ur10e.TRAINING.file, np.column_stack([t, q, qd, torque / 10.0]), delimiter=",")
    seen = {ur10e.TRAINING: ur10e.recording(tmp_path, ur10e.TRAINING, published.gains)}
    ((_, _, *errors),) = ur10e.rows({"itself": published.torques}, seen)
    assert max(map(float, errors)) < 3.0  # a sample of the wrong sign of Coulomb friction at a reversal
