"""Faults of recorded signals that are seen without a model, at random sizes, joints and times of random motions."""

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import signal

from armident.configs import DataError, RobotConfig, load_robot
from armident.daq.interchange.importing import recording_of_arrays
from armident.daq.recording.faults.repair import REASON, Repair, repair
from armident.daq.recording.faults.sign_bit import sign_bit

Array = NDArray[np.float64]
SEEDS = range(30)


@pytest.fixture(scope="module")
def tx40() -> RobotConfig:
    return load_robot("tx40")


def motion(rng: Generator, rate: float, seconds: float = 8.0) -> tuple[Array, Array, Array]:
    """Times (N,), positions and torques (N, 6) of a smooth motion between pauses, with encoder steps and noise."""
    t = np.arange(0.0, seconds, 1.0 / rate)
    phase, frequency = rng.uniform(0, 2 * np.pi, (2, 6, 3)), rng.uniform(0.2, 1.5, (6, 3))
    angle = 2 * np.pi * frequency * t[:, None, None] + phase[0]
    size, counts = rng.uniform(0.05, 0.4, (6, 3)), 10 ** rng.uniform(-6, -3.5)
    moving = np.clip(np.abs(np.sin(0.4 * t))[:, None] * 4 - 1, 0, 1)
    q = np.round((np.sum(size * np.sin(angle), axis=2) * moving + rng.uniform(-1, 1, 6)) / counts) * counts
    tau = np.sum(20 * np.cos(angle), axis=2) + 30.0 + rng.normal(0, rng.uniform(0.01, 1.0), (t.size, 6))
    return t, q, tau


def found(t: Array, q: Array, tau: Array, robot: RobotConfig) -> Repair:
    return repair(q, tau, None, t, robot, "joint")


@pytest.mark.slow
@pytest.mark.parametrize("rate", [200.0, 1000.0, 5000.0])
def test_nothing_is_said_about_smooth_motions_between_pauses(tx40: RobotConfig, rate: float) -> None:
    for seed in SEEDS:
        result = found(*motion(np.random.default_rng(seed), rate, 3.0), tx40)
        assert result.notes == ()
        assert not result.wrong.any()


@pytest.mark.parametrize("seed", SEEDS)
def test_single_wrong_rows_are_found_and_no_others(tx40: RobotConfig, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, q, tau = motion(rng, float(rng.choice([200, 500, 1000])))
    j, count, length = int(rng.integers(6)), int(rng.integers(1, 20)), int(rng.integers(1, 4))
    first = rng.choice(np.arange(2, t.size // 10 - 2), count, replace=False) * 10
    rows = np.sort((first[:, None] + np.arange(length)).ravel())
    q[rows, j] += np.repeat(rng.choice([-1, 1], count) * rng.uniform(0.2, 1.5, count), length)
    result = found(t, q, tau, tx40)
    assert np.flatnonzero(result.wrong).tolist() == rows.tolist()
    assert all(tx40.joints[j].name in note for note in result.notes)


@pytest.mark.parametrize("seed", SEEDS)
def test_rows_of_zeros_and_old_rows_are_found_at_all_joints(tx40: RobotConfig, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, q, tau = motion(rng, 500.0)
    rows = np.sort(rng.choice(np.arange(5, t.size // 25 - 5), 6, replace=False) * 25)
    before = q.copy()
    q[rows[:3]], q[rows[3:]] = 0.0, before[(rows[3:] + t.size // 2) % t.size]
    rows = rows[np.abs(q - before)[rows].max(axis=1) > 0.1]
    result = found(t, q, tau, tx40)
    assert set(rows) <= set(np.flatnonzero(result.wrong))


@pytest.mark.parametrize("seed", SEEDS)
def test_turns_are_unwrapped_and_the_demand_with_them(tx40: RobotConfig, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, q, tau = motion(rng, float(rng.choice([200, 1000])))
    j = int(rng.integers(6))
    q[:, j] += np.pi - np.median(q[:, j])
    wrapped, demand = q.copy(), q.copy()
    wrapped[:, j] = np.angle(np.exp(1j * q[:, j]))
    demand[:, j] = np.angle(np.exp(1j * (q[:, j] + 0.01)))
    result = repair(wrapped, tau, demand, t, tx40, "joint")
    assert np.any(wrapped != q)
    assert not result.wrong.any()
    assert result.demand is not None
    apart = (result.position - q)[:, j] / (2 * np.pi)
    assert np.ptp(apart) == pytest.approx(0.0, abs=1e-9)
    assert apart[0] == pytest.approx(round(apart[0]), abs=1e-9)
    assert result.demand[:, j] - result.position[:, j] == pytest.approx(0.01, abs=1e-9)


def test_a_row_between_both_ends_of_a_turn_is_left_out(tx40: RobotConfig) -> None:
    t, q, tau = motion(np.random.default_rng(1), 1000.0)
    q[:, 0] = np.pi + 0.5 * np.sin(3.0 * t)
    wrapped = q.copy()
    wrapped[:, 0] = np.angle(np.exp(1j * q[:, 0]))
    rows = np.flatnonzero(np.abs(np.diff(wrapped[:, 0])) > 3.0) + 1
    wrapped[rows, 0] = 0.3
    result = found(t, wrapped, tau, tx40)
    assert np.flatnonzero(result.wrong).tolist() == rows.tolist()
    assert np.ptp((result.position - q)[~result.wrong, 0]) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("joint", [None, 2])
def test_torques_of_zero_between_others_are_left_out(tx40: RobotConfig, joint: int | None) -> None:
    rng = np.random.default_rng(3)
    t, q, tau = motion(rng, 1000.0)
    tau = 0.1 * tau + 100.0
    rows = np.sort(rng.choice(np.arange(5, t.size - 5), t.size // 50, replace=False))
    tau[rows, slice(None) if joint is None else joint] = 0.0
    result = found(t, q, tau, tx40)
    assert np.flatnonzero(result.wrong).tolist() == rows.tolist()
    assert len(result.notes) == 1


@pytest.mark.parametrize("value", [300.0, -9999.0, 65535.0])
def test_values_of_a_sensor_that_fails_are_left_out(tx40: RobotConfig, value: float) -> None:
    rng = np.random.default_rng(4)
    t, q, tau = motion(rng, 500.0)
    tau = np.round(tau, 0)  # coarse steps are flat, and are no frozen torque for the sake of a spike
    rows = np.sort(rng.choice(np.arange(5, t.size - 5), 6, replace=False))
    spiked = tau.copy()
    spiked[rows, 3] = value
    result = found(t, q, spiked, tx40)
    assert np.flatnonzero(result.wrong).tolist() == rows.tolist()
    assert "joint_4 is beyond its limit in 6 rows" in result.notes[0]
    lasting = tau.copy()
    lasting[1000:1011, 3] = value  # eleven rows are no spike
    others = found(t, q, lasting, tx40), repair(q, spiked, None, t, tx40, "motor")  # limits are those of joints
    assert not any("beyond" in note for result in others for note in result.notes)


@pytest.mark.parametrize("seed", SEEDS)
def test_signals_that_are_not_renewed_are_left_out_while_they_are(tx40: RobotConfig, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, q, tau = motion(rng, 1000.0)
    # full motion: sin(0.4 t) is above a half from 1.4 to 6.4 s
    begin, length, j = int(rng.integers(1500, 5000)), int(rng.integers(30, 800)), int(rng.integers(6))
    rows = np.arange(begin, begin + length)
    signals = [(q, tau), (q,), (tau,)][int(rng.integers(3))]
    joints = slice(None) if len(signals) == 2 or rng.random() < 0.5 else j
    for values in signals:
        values[rows, joints] = values[begin - 1, joints]
    result = found(t, q, tau, tx40)
    assert result.wrong[rows].all()
    assert result.wrong.sum() <= length + 10  # the joint is back on its way soon after a freeze
    assert any("renewed" in note or "is the same" in note for note in result.notes)


@pytest.mark.slow
def test_torques_in_coarse_steps_are_no_fault(tx40: RobotConfig) -> None:
    notes: list[str] = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        t, q, tau = motion(rng, 250.0)
        step, noise = rng.uniform(2.0, 20.0, 6), rng.uniform(0.02, 1.0, 6)
        notes += found(t, q, np.rint(tau / step + rng.normal(0, noise, tau.shape)) * step, tx40).notes
    # a run of equal values is called a fault in one recording of a thousand, for each joint
    assert len(notes) <= 1


@pytest.mark.parametrize("seed", SEEDS)
def test_torques_without_noise_that_rest_between_two_counts_of_an_encoder_are_no_fault(
    tx40: RobotConfig, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    t, q, _ = motion(rng, 5000.0, 4.0)
    at_counts = np.zeros((t.size, 6))
    for effort, seconds in zip(at_counts.T, 10 ** rng.uniform(-4, -3, 6), strict=True):
        ticks = rng.random(t.size) < 0.1
        effort[ticks] = rng.choice([-1.0, 1.0], ticks.sum())
        effort[:] = signal.lfilter([1.0], [1.0, -np.exp(-2e-4 / seconds)], effort)
    tau = np.rint((4.0 + np.sin(t)[:, None] + at_counts) / 2e-3) * 2e-3
    assert found(t, q, tau, tx40).notes == ()


@pytest.mark.parametrize("seed", range(5))
def test_a_torque_that_freezes_until_the_end_is_left_out_from_there(tx40: RobotConfig, seed: int) -> None:
    t, q, tau = motion(np.random.default_rng(seed), 1000.0, 6.0)
    tau[4000:, 3] = tau[3999, 3]
    result = found(t, q, tau, tx40)
    assert np.flatnonzero(result.wrong).tolist() == list(range(4000, t.size))


@pytest.mark.parametrize("seed", range(5))
def test_torques_that_repeat_earlier_ones_are_left_out(tx40: RobotConfig, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, q, tau = motion(rng, 1000.0)
    begin, length = int(rng.integers(3000, 5000)), int(rng.integers(100, 1000))
    rows = np.arange(begin, begin + length)
    tau[rows] = tau[rows - 1100]
    result = found(t, q, tau, tx40)
    assert np.flatnonzero(result.wrong).tolist() == rows.tolist()
    assert "repeat earlier ones" in result.notes[0]


def test_a_motion_that_repeats_itself_exactly_is_no_fault(tx40: RobotConfig) -> None:
    t, q, tau = motion(np.random.default_rng(5), 1000.0)
    part = slice(1500, 3500)
    q[part] += np.linspace(0, 1, 2000)[:, None] * (q[part.start] - q[part.stop])
    twice = np.concatenate([q[part], q[part]]), np.concatenate([tau[part], tau[part]])
    assert found(t[:4000], *twice, tx40).notes == ()


def test_impossible_rows_are_gaps_of_the_recording_and_are_interpolated(tx40: RobotConfig) -> None:
    from armident.identify.identification.from_recording import experiments_from_recording

    t, q, tau = motion(np.random.default_rng(4), 500.0)
    broken = q.copy()
    broken[[1000, 1001, 2500]] += 0.4
    recording = recording_of_arrays(t, broken, tau, tx40)
    assert [(gap.first, gap.last) for gap in recording.gaps] == [(1000, 1001), (2500, 2500)]
    (experiment,), _ = experiments_from_recording(recording, tx40)
    assert np.abs(experiment.q - q).max() < 1e-3
    # A recording whose rows were not left out by an import has the same gaps for those who read it.
    samples = recording_of_arrays(t, q, tau, tx40).samples
    samples.raw["position"][[1000, 1001, 2500]] += 0.4
    from armident.daq.recording.faults.repair import repaired
    from armident.daq.recording.model import Recording

    again, notes = repaired(Recording(None, tx40, None, 500.0, {"samples": samples}))
    assert len(notes) == 1
    assert [(gap.first, gap.reason) for gap in again.gaps] == [(1000, REASON), (2500, REASON)]


@pytest.mark.parametrize("bit", [7, 9, 10, 11, 14, 15])
def test_a_sign_in_a_bit_is_refused_with_the_way_to_decode_it(tx40: RobotConfig, bit: int) -> None:
    t, q, tau = motion(np.random.default_rng(bit), 500.0)
    size = np.rint(0.8 * (1 << bit) * (tau - tau.mean(axis=0)) / np.abs(tau - tau.mean(axis=0)).max(axis=0))
    with pytest.raises(DataError, match=f"bit {bit} is the sign"):
        recording_of_arrays(t, q, np.where(size < 0, (1 << bit) - size, size), tx40)
    assert sign_bit(size[:, 0]) is None
    assert sign_bit(np.abs(size[:, 0])) is None


@pytest.mark.parametrize("bits", [8, 16, 32])
def test_negative_efforts_in_unsigned_numbers_are_refused_with_the_way_to_decode_them(
    tx40: RobotConfig, bits: int
) -> None:
    t, q, tau = motion(np.random.default_rng(bits), 500.0)
    size = np.rint(100 * (tau - tau.mean(axis=0)) / np.abs(tau - tau.mean(axis=0)).max(axis=0))
    top = 1 << bits
    with pytest.raises(DataError, match=f"negative numbers of {bits} bits.* x if x < {top // 2} else x - {top}$"):
        recording_of_arrays(t, q, np.where(size < 0, size + top, size), tx40)


@pytest.mark.parametrize("scale", [0.1, 0.00313])
def test_a_sign_bit_is_found_in_numbers_that_were_scaled(tx40: RobotConfig, scale: float) -> None:
    t, q, tau = motion(np.random.default_rng(3), 500.0)
    size = np.rint(800 * (tau - tau.mean(axis=0)) / np.abs(tau - tau.mean(axis=0)).max(axis=0))
    with pytest.raises(DataError, match=rf"bit 10 is the sign.* x if x < {1024 * scale:g}"):
        recording_of_arrays(t, q, scale * np.where(size < 0, 1024 - size, size), tx40)
    assert sign_bit(np.abs(scale * tau[:, 0])) is None
    assert sign_bit(np.round(300 + 200 * np.sin(t), 2)) is None


def test_drives_that_were_off_are_not_used(tx40: RobotConfig) -> None:
    t, q, tau = motion(np.random.default_rng(5), 500.0)
    tau[1000:2000] = 0.0
    result = found(t, q, tau, tx40)
    assert np.flatnonzero(result.off).tolist() == list(range(1000, 2000))
    assert not result.wrong.any()


def test_all_joints_that_step_at_once_are_cut_there(tx40: RobotConfig) -> None:
    t, q, tau = motion(np.random.default_rng(6), 1000.0)
    q[4000:] += [0.1, -0.2, 0.15, 0.3, -0.4, 0.2]
    result = found(t, q, tau, tx40)
    assert np.flatnonzero(result.wrong).tolist() == [3998, 3999, 4000, 4001]


@pytest.mark.parametrize("offset", [0, 17])
def test_a_sign_bit_is_found_in_the_noise_of_the_load(offset: int) -> None:
    rng = np.random.default_rng(1)
    load = np.rint(600.0 * np.sin(np.arange(4000) / 400.0) + rng.normal(0.0, 100.0, 4000))
    found = sign_bit(np.where(load < 0, 1024 - load, load) + offset)
    assert found is not None
    assert found.how == "bit 10 is the sign"
    assert sign_bit(np.abs(load) + offset) is None
    assert sign_bit(load + 1024) is None


def test_an_effort_without_sign_is_not_advised_to_be_in_mnm(tx40: RobotConfig) -> None:
    t, q, tau = motion(np.random.default_rng(2), 500.0)
    raw = np.rint(900.0 * tau / np.abs(tau).max(axis=0))
    with pytest.raises(DataError, match="never negative: counts with another zero or sign") as refused:
        recording_of_arrays(t, q, raw + 2048, tx40)
    assert "mnm" not in str(refused.value)
