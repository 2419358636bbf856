"""Recursive estimator: any cutting of the stream gives the same bits, nothing is valid without motion."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from armident.configs import ConfigError, DataError, load_robot
from armident.configs.schema.robot import Effect
from armident.daq.recording import Recording, Stream
from armident.identify.monitoring.recursive import saved_state
from armident.identify.monitoring.recursive.change_detection import FrictionTest
from armident.identify.monitoring.recursive.equations import EARLIER, Instant, StreamEquations, acceleration_delay
from armident.identify.monitoring.recursive.estimator import RecursiveEstimator
from armident.identify.monitoring.recursive.kernels import solve, update
from armident.identify.monitoring.recursive.noise import RunningNoise
from armident.identify.monitoring.recursive.recorded_blocks import RecordedBlock, blocks_of
from armident.identify.monitoring.recursive.reference import torque_lead
from armident.identify.monitoring.recursive.saved_state import state_of
from armident.identify.monitoring.recursive.settings import RecursiveSettings
from armident.virtual_robot.noise import amplitudes
from tests.fixtures import arms
from tests.statistics.fresh_noise import FreshNoise, Motion, MotionRecorder, held, repeat
from tests.statistics.recursive_life import factors_at, healthy_life, seconds_to_alarm

RATE = 1 / arms.FAST
ROBOT = load_robot("tx40")


def estimator(**more: Any) -> RecursiveEstimator:
    return RecursiveEstimator(ROBOT, arms.tx40_baseline(), RATE, **more)


def recorded() -> Recording:
    return arms.recording("tx40", "tx40_1", 7, repeats=2, period=arms.FAST)


@cache
def uncut() -> RecursiveEstimator:
    """The estimator after the recording in one piece; no test may change it."""
    found = estimator()
    for block in blocks_of(recorded(), 100_000):
        found.handle(block)
    return found


def bits(found: RecursiveEstimator) -> dict[str, bytes]:
    """State without the rows that still wait, which depend on the cutting until they are complete."""
    return {name: value.tobytes() for name, value in state_of(found).items()}


@pytest.mark.parametrize("instruments", [False, True])
def test_the_update_is_that_of_filterpys_kalman_filter(instruments: bool) -> None:
    rng = np.random.default_rng(3)
    b, n = 5, 3
    state, root = rng.standard_normal(b), rng.standard_normal((b, b))
    covariance = root @ root.T + np.eye(b)
    make: Any = KalmanFilter
    oracle = make(b, n)
    oracle.x, oracle.P, oracle.F = state[:, None].copy(), covariance.copy(), np.eye(b)
    oracle.Q = np.diag(rng.uniform(0.0, 0.1, b))
    oracle.R = np.diag(rng.uniform(0.5, 2.0, n))
    for _ in range(40):
        x = rng.standard_normal((n, b))
        z = x + 0.3 * rng.standard_normal((n, b)) if instruments else x
        y = rng.standard_normal(n)
        oracle.predict()
        covariance += oracle.Q
        if not instruments:
            oracle.H = x
            oracle.update(y[:, None])
        else:
            # The innovation y - x theta with the instruments as measurement matrix, one equation after the other.
            for j in range(n):
                moved = y[j] + float(((z[j] - x[j]) @ oracle.x).item())
                oracle.update(np.array([[moved]]), R=oracle.R[j : j + 1, j : j + 1], H=z[j : j + 1])
        update(state, covariance, x, z, y, np.diag(oracle.R).copy(), np.ones(n, np.bool_))
    np.testing.assert_allclose(state, oracle.x[:, 0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(covariance, oracle.P, rtol=1e-9, atol=1e-9)


def test_elimination_solves_with_pivots_and_names_a_singular_matrix() -> None:
    rng = np.random.default_rng(1)
    matrix, right = rng.standard_normal((6, 6)), rng.standard_normal((6, 2))
    matrix[0, 0] = 0.0
    expected = np.linalg.solve(matrix, right)
    assert solve(matrix.copy(), right)
    np.testing.assert_allclose(right, expected, rtol=1e-9)
    assert not solve(np.ones((2, 2)) - np.ones((2, 2)), np.ones((2, 1)))


@pytest.mark.parametrize("nvr", [1e-6, 1e-3, 0.06])
def test_the_delay_of_the_acceleration_is_two_time_constants(nvr: float) -> None:
    # Butterworth poles at w0 = NVR^(1/6) rad per sample: delay 2 / w0, and half a sample or less by sampling.
    assert acceleration_delay(nvr) == pytest.approx(2 / nvr ** (1 / 6), abs=0.6)


def test_the_long_run_variance_allows_for_serial_correlation() -> None:
    rng = np.random.default_rng(5)
    noise = RunningNoise(2, 40.0, RecursiveSettings(noise_memory_s=500.0))
    last = 0.0
    for _ in range(40_000):
        last = 0.5 * last + rng.standard_normal()
        noise.add(np.array([rng.standard_normal(), last]), np.ones(2, np.bool_))
    # AR(1) with pole a: the long-run variance is 1 / (1 - a)^2 = 4, the variance 1 / (1 - a^2) = 1.33.
    assert noise.short_run == pytest.approx([1.0, 1.33], rel=0.1)
    assert noise.variance == pytest.approx([1.0, 4.0], rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "longest"), [(1, 900), *(pytest.param(k, 400 * k - 700, marks=pytest.mark.nightly) for k in range(2, 6))]
)
def test_the_cutting_into_blocks_does_not_change_a_bit(seed: int, longest: int) -> None:
    rng = np.random.default_rng(seed)
    cut = estimator()
    recording = recorded()
    queues = []
    for block in blocks_of(recording, 100_000):
        pieces, at = [], 0
        while at < block.sync.size:
            end = at + int(rng.integers(1, longest + 1))
            raw = {name: values[at:end] for name, values in block.raw.items()}
            pieces.append(RecordedBlock(block.layout, block.sync[at:end], block.t_ns[at:end], raw))
            at = end
        queues.append(pieces)
    # Streams arrive side by side: samples wait for the reference by a second at most.
    while any(queues):
        ready = [q for q in queues if q]
        first = min(int(q[0].sync[0]) for q in ready)
        near = [q for q in ready if int(q[0].sync[0]) <= first + 1000]
        cut.handle(near[int(rng.integers(len(near)))].pop(0))
    assert cut.result().motion_s > 5.0
    assert bits(cut) == bits(uncut())


@pytest.mark.slow
def test_a_saved_state_continues_with_the_same_bits(tmp_path: Path) -> None:
    blocks = list(blocks_of(recorded(), 370))
    first, second = estimator(), estimator()
    for block in blocks[: len(blocks) // 2]:
        first.handle(block)
    first.save(tmp_path / "state.npz")
    second.load(tmp_path / "state.npz")
    for block in blocks[len(blocks) // 2 :]:
        second.handle(block)
    assert bits(second) == bits(uncut())


@pytest.mark.slow
def test_a_state_of_another_version_robot_or_setting_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "state.npz"
    estimator().save(path)
    with pytest.raises(DataError, match="another setting"):
        estimator(settings=RecursiveSettings(window_s=4.0)).load(path)
    monkeypatch.setattr(saved_state, "SCHEMA", "armident/recursive-state/2")
    with pytest.raises(DataError, match="version 'armident/recursive-state/1', this program has") as raised:
        estimator().load(path)
    assert "\n" not in str(raised.value)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match="not a saved state"):
        estimator().load(path)
    with pytest.raises(ConfigError, match="no such file"):
        estimator().load(tmp_path / "absent.npz")


@pytest.mark.slow
def test_nothing_is_valid_before_there_was_enough_motion() -> None:
    found = estimator()
    for block in blocks_of(recorded(), 500):
        found.handle(block)
        result = found.result()
        enough = result.information >= result.needed_information
        assert (np.isfinite(result.valid) == enough).all()
        assert np.isfinite(result.parameters_valid).all() == enough.all()
        if result.motion_s < RecursiveSettings().window_s:
            assert np.isnan(result.valid).all()
            assert np.isnan(result.parameters_valid).all()
    assert result.motion_s > 5.0
    assert enough[:5].all()


@pytest.mark.slow
def test_an_arm_at_rest_and_a_joint_at_rest_never_become_valid() -> None:
    recording = recorded()
    samples = recording.streams["samples"]
    demand = recording.streams["demand"]
    # Motor 1 turns with joint 1 alone.
    still = {name: stream.raw[name].copy() for name, stream in (("position", samples), ("demand", demand))}
    for values in still.values():
        values[:, 0] = values[0, 0]
    streams = {
        "samples": _with(samples, position=still["position"]),
        "demand": _with(demand, demand=still["demand"]),
    }
    found = estimator()
    for block in blocks_of(Recording(None, ROBOT, None, RATE, streams), 500):
        found.handle(block)
    result = found.result()
    assert result.information[0] < 1.0
    assert np.isnan(result.valid[0])
    assert (result.information[1:] > result.needed_information).any()


def _with(stream: Stream, **fields: np.ndarray) -> Stream:
    return replace(stream, raw={**stream.raw, **fields})


@pytest.mark.slow
def test_a_gap_starts_the_filters_anew_and_repeated_rows_are_skipped() -> None:
    blocks = list(blocks_of(recorded(), 500))
    found = estimator()
    for k, block in enumerate(blocks):
        if k == len(blocks) // 2 - len(blocks) // 2 % 2:
            continue
        found.handle(block)
        found.handle(block)
    result = found.result()
    assert result.gaps == 1
    assert result.repeated > 1000
    assert np.isfinite(result.filtered).all()
    assert not result.alarm.any()


@pytest.mark.slow
def test_another_capture_begins_where_sync_numbers_begin_anew() -> None:
    found = estimator()
    recording = recorded()
    last = int(recording.samples.t_ns[-1])
    for later in (0, last + 1_000_000_000):
        for block in blocks_of(recording, 500):
            found.handle(RecordedBlock(block.layout, block.sync, block.t_ns + later, block.raw))
    assert found.result().repeated == 0
    assert found.result().motion_s == pytest.approx(2 * uncut().result().motion_s, rel=0.3)


def test_a_reference_of_another_robot_or_with_effects_is_refused() -> None:
    with pytest.raises(DataError, match="the reference is of robot 'tx40'"):
        RecursiveEstimator(load_robot("emps"), arms.tx40_baseline(), RATE)
    spring = Effect(effect="joint_spring", joint="joint_1")
    with pytest.raises(ConfigError, match="has effects"):
        RecursiveEstimator(ROBOT.model_copy(update={"effects": (spring,)}), arms.tx40_baseline(), RATE)
    with pytest.raises(DataError, match="samples/s are too few"):
        RecursiveEstimator(ROBOT, arms.tx40_baseline(), 50.0)


@pytest.mark.slow
def test_the_false_alarms_of_the_sequential_test_are_as_rare_as_wanted() -> None:
    # At the limit of what is tolerated, one false alarm in 0.5 h: Lorden's bound gives 0.1 in 50 runs of 0.001 h each.
    chosen = RecursiveSettings(false_alarm_hours=1.0, level_memory_s=1e12)
    rng = np.random.default_rng(2)
    alarms, windows = 0, 0
    for _ in range(20):
        test = FrictionTest(1, chosen)
        for k in range(720):
            test.add(np.array([chosen.tolerated + 0.02 * rng.standard_normal()]), np.array([0.02]), k, np.ones(1, bool))
            windows += 1
            if test.alarm[0] >= 0:
                break
        alarms += int(test.alarm[0] >= 0)
    # 20 hours of motion at one false alarm per hour, of which this direction has half: 10 expected at most.
    assert windows > 0.5 * 20 * 720
    assert alarms <= 16


def test_a_single_window_is_no_alarm_and_a_joint_without_excitation_has_none() -> None:
    test = FrictionTest(2, RecursiveSettings())
    valid = np.array([True, False])
    for k in range(3):
        assert (test.alarm < 0).all()
        test.add(np.full(2, 0.5), np.full(2, 0.001), k, valid)
    assert test.alarm.tolist() == [2, -1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joint", "motion", "period"),
    [
        pytest.param("joint_2", "tx40_1", 1e-3, marks=pytest.mark.nightly),
        pytest.param("joint_4", "tx40_2", 1e-3, marks=pytest.mark.nightly),
        pytest.param("joint_5", "tx40_3", 2e-4, marks=pytest.mark.nightly),
    ],
)
def test_ten_percent_more_friction_is_seen_within_a_minute(joint: str, motion: str, period: float) -> None:
    seconds = seconds_to_alarm(joint, motion, 3, period=period)
    assert seconds is not None
    assert seconds < 60.0


@pytest.mark.slow
@pytest.mark.nightly
def test_minutes_of_healthy_life_raise_no_alarm() -> None:
    life = healthy_life(0.05, 4, simulated=True)
    assert life.alarms == []
    assert life.windows > 20
    assert life.largest_evidence < 0.5 * life.threshold


@cache
def repeatable() -> tuple[MotionRecorder, Motion]:
    """The equations of `recorded`, in which the noise can be exchanged."""
    recorder = MotionRecorder(estimator(), ROBOT, arms.FAST)
    # After the first time the lags behind the reference are known.
    return recorder, [recorder.record(recorded(), 7) for _ in range(2)][1]


@pytest.mark.slow
def test_a_life_of_repeated_motions_raises_no_alarm() -> None:
    """A minute, with the friction of a slow temperature."""
    recorder, motion = repeatable()
    found, fresh = estimator(), FreshNoise(ROBOT, arms.FAST, np.random.default_rng(6))
    for _ in range(4):
        found.start_capture()
        noise = recorder.filtered(held(fresh.draw(motion.samples))[1:])
        repeat(found, motion, noise, np.array(list(factors_at(0.0).values())))
        assert not found.result().alarm.any()
    assert found.test.windows > 5
    assert found.result().evidence.max() < 0.5 * found.result().threshold


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(50 * 3600)
def test_hours_of_healthy_life_raise_no_alarm() -> None:
    life = healthy_life(float(os.environ.get("ARMIDENT_HEALTHY_HOURS", "50")), 5)
    assert life.alarms == []
    assert life.motion_h > 0.6 * life.hours


@pytest.mark.slow
def test_the_noise_of_a_simulation_can_be_exchanged_in_its_equations() -> None:
    """The rest without its own noise is the error of the live filter, a small part of the variance."""
    found, period = estimator(), arms.FAST
    recorder, motion = repeatable()
    theta = found.reference.theta
    residual = np.array([instant.y - instant.x @ theta for instant in motion.instants])
    moves = np.array([instant.moving for instant in motion.instants]) >= RecursiveSettings().moving_share
    drawn = FreshNoise(ROBOT, period, np.random.default_rng(1)).draw(40 * motion.samples)
    fresh = recorder.filtered(held(drawn))
    for j in range(ROBOT.n):
        left = (residual - motion.own_noise)[moves[:, j], j]
        assert np.var(left) < 0.1 * np.var(residual[moves[:, j], j])
    # White noise up to half the sampling rate, and half of a disturbance with a corner of 20 Hz, behind 20 Hz.
    white, slow = amplitudes(ROBOT, 2e-4)
    expected = white**2 @ ROBOT.transmission_matrix**2 * (20.0 / (0.5 / period)) + 0.5 * slow**2
    assert np.var(fresh, axis=0) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(
    ("leads", "expected"),
    [
        (None, 0.5),
        ([[0.1, 0.01]] * 6, 0.1),
        ([[0.1, 0.01]] * 5 + [[4.0, 0.01]], 0.1),
        ([[0.1, 0.01]] + [[0.1, 0.5]] * 5, 0.5),
        ([[0.55, 0.01]] * 6, 0.5),
        ([[0.7, 0.1]] * 6, 0.5),
        ([[-1.2, 0.01]] * 6, 0.5),
    ],
)
def test_a_lead_of_the_torque_is_aligned_if_the_joints_agree_on_one(
    leads: list[list[float]] | None, expected: float
) -> None:
    found = None if leads is None else dict(zip((joint.name for joint in ROBOT.joints), leads, strict=True))
    assert torque_lead(arms.tx40_baseline().model_copy(update={"torque_delay_samples": found})) == expected


@pytest.mark.slow
@pytest.mark.parametrize("lead", [-0.5, 0.0, 0.3, 0.5, 1.5])
def test_equations_take_the_torque_at_the_instants_of_the_positions(lead: float) -> None:
    """A torque that is linear in time shows the lead in every decimated equation."""
    instants: list[Instant] = []
    model = RecursiveEstimator(ROBOT, arms.tx40_baseline(), RATE).reference.model
    equations = StreamEquations(model, arms.FAST, 10.0, False, RecursiveSettings(), instants.append, lead)
    k = np.arange(2000)
    values = np.hstack([np.zeros((k.size, ROBOT.n)), np.tile(k[:, None], (1, ROBOT.n))]).astype(float)
    equations.add(k, values)
    y = np.array([instant.y[0] for instant in instants])
    begin = equations.piece.shape[0] - equations.history.shape[0] + EARLIER
    centre = begin + equations.decimation.margin + equations.decimation.factor * np.arange(y.size)
    np.testing.assert_allclose(y, centre - lead, rtol=1e-9)
