"""Torques that no recorded motion explains: lines, slow signals and bursts beside noise."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from armident.identify.diagnosis.excess import away_from_reversals, bursts, larger_errors, spectral_excess, together
from armident.identify.diagnosis.spectral_lines import has_line

Array = NDArray[np.float64]

DT, ROWS = 0.02, 600
T: Array = DT * np.arange(ROWS, dtype=np.float64)
SPEED: Array = np.asarray(np.sin(2 * np.pi * 0.3 * T + 0.1), dtype=np.float64)


def noise(seed: int, constant_s: float = 0.0) -> Array:
    """White noise of unit variance, or noise of first order with a time constant."""
    white = np.random.default_rng(seed).normal(size=ROWS + 200)
    if constant_s == 0.0:
        return white[:ROWS]
    pole = np.exp(-DT / constant_s)
    return np.asarray(signal.lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], white)[200:])


@pytest.mark.slow
@pytest.mark.parametrize("constant_s", [0.0, 0.01, 0.03])
def test_noise_of_drives_has_no_excess(constant_s: float) -> None:
    lowest = []
    for seed in range(60):
        one = noise(seed, constant_s)
        spectral, moments = spectral_excess([one], [SPEED], DT), bursts([one], [T], [SPEED])
        lowest.append(min(part.p_value for part in (spectral, moments) if part is not None))
    # Of 120 p-values 1.2 are below 0.01; ten or more have a probability of 1e-6.
    assert np.sum(np.array(lowest) < 0.01) < 10
    assert min(lowest) > 1e-6


def without_slow_parts(e: Array) -> tuple[Array, Array]:
    """Residual without what parameters of a short part take: all below 2.5 Hz; and these directions (M, k)."""
    t = DT * np.arange(e.size)
    waves = [fun(np.pi * k * t / t[-1]) for k in range(1, round(2 * 2.5 * t[-1])) for fun in (np.sin, np.cos)]
    directions, _ = np.linalg.qr(np.stack(waves, axis=1))
    return np.asarray(e - directions @ (directions.T @ e)), np.asarray(directions)


@pytest.mark.slow
def test_noise_that_a_refit_has_left_is_no_signal_beside_what_it_took() -> None:
    known: list[float] = []
    unknown: list[float] = []
    for seed in range(30):
        left, taken = without_slow_parts(noise(seed, 0.03)[:300])
        for p_values, out in ((known, [taken]), (unknown, [])):
            found = spectral_excess([left], [SPEED[:300]], DT, taken=out)
            assert found is not None
            p_values.append(found.p_value)
    # Of 30 p-values 0.3 are below 0.01; five or more have a probability of 2e-5.
    assert np.sum(np.array(known) < 0.01) < 5 <= np.sum(np.array(unknown) < 0.01)


def test_a_vibration_beside_a_refit_has_its_frequency() -> None:
    left, taken = without_slow_parts((noise(1, 0.03) + 1.5 * np.sin(2 * np.pi * 8.3 * T))[:300])
    found = spectral_excess([left], [SPEED[:300]], DT, taken=[taken])
    assert found is not None
    assert found.where[0] == pytest.approx(8.3, abs=0.2)
    assert found.p_value < 1e-6


def test_a_vibration_has_its_frequency() -> None:
    found = spectral_excess([noise(0) + 2.0 * np.sin(2 * np.pi * 3.7 * T)], [SPEED], DT)
    assert found is not None
    assert found.kind == "frequency"
    assert found.where[0] == pytest.approx(3.7, abs=0.1)
    assert found.p_value < 1e-6
    # It has twice the power of the noise.
    assert found.share == pytest.approx(2.0 / 3.0, abs=0.1)


def test_a_vibration_beside_errors_of_the_motion_is_a_line_of_both_parts() -> None:
    motion = sum(np.sin(2 * np.pi * f * T) for f in (0.5, 0.9, 1.3))
    parts = [spectral_excess([noise(k) + 3.0 * np.sin(2 * np.pi * 3.7 * T + k) + motion], [SPEED], DT) for k in (0, 1)]
    assert all(part is not None and part.kind == "unrecorded signal" for part in parts)
    assert all(part is not None and part.kind == "frequency" for part in together(*parts))
    moved = spectral_excess([noise(2) + 3.0 * np.sin(2 * np.pi * 4.4 * T) + motion], [SPEED], DT)
    assert together(parts[0], moved) == (parts[0], moved)


def test_a_weak_signal_at_one_frequency_of_both_parts_is_more_evidence_than_either() -> None:
    parts = [spectral_excess([noise(k) + 0.45 * np.sin(2 * np.pi * 3.7 * T + k)], [SPEED], DT) for k in (3, 4)]
    both = together(*parts)
    for part, joint in zip(parts, both, strict=True):
        assert part is not None
        assert joint is not None
        assert joint.p_value < 0.1 * part.p_value


def test_a_signal_need_not_be_in_every_recording() -> None:
    quiet, other = noise(5), noise(6) + 0.55 * np.where(T > 7.0, 1.0, -1.0)
    found = spectral_excess([quiet, other], [SPEED, SPEED], DT)
    alone = spectral_excess([other], [SPEED], DT)
    assert found is not None
    assert alone is not None
    assert (found.where, found.share) == (alone.where, alone.share)
    assert found.p_value < 1e-3
    both = spectral_excess([other, other], [SPEED, SPEED], DT)
    assert both is not None
    assert both.p_value < 0.1 * alone.p_value


def test_errors_that_are_larger_in_the_report_part_count_beyond_twice_the_expected() -> None:
    usual = [noise(0)]
    assert larger_errors(usual, [1.8 * noise(1)], 0.0, [T], 2.0) is None
    assert larger_errors(usual, [2.4 * noise(1)], 1.0, [T], 2.0) is None
    found = larger_errors(usual, [4.0 * noise(1)], 0.0, [T], 2.0)
    assert found is not None
    assert found.where[0] == pytest.approx(4.0, rel=0.1)
    assert found.share == pytest.approx(15 / 16, abs=0.02)
    assert found.p_value < 1e-6


def test_a_slow_signal_is_no_line() -> None:
    found = spectral_excess([noise(0) + 2.0 * noise(9, 1.0)], [SPEED], DT)
    assert found is not None
    assert found.kind == "unrecorded signal"
    assert found.where[0] < 1.0
    assert found.p_value < 1e-6
    assert found.share > 0.4


def test_a_step_of_the_offset_is_a_signal() -> None:
    found = spectral_excess([noise(1) + np.where(T > 7.0, 1.0, 0.0)], [SPEED], DT)
    assert found is not None
    assert found.kind == "unrecorded signal"
    assert found.p_value < 1e-4


def test_a_resonance_over_two_octaves_does_not_count_as_noise_of_its_surroundings() -> None:
    band = signal.butter(2, [1.5, 4.5], "bandpass", fs=1.0 / DT, output="sos")
    wide = signal.sosfilt(band, noise(2))
    found = spectral_excess([noise(1) + 2.5 * wide / wide.std()], [SPEED], DT)
    assert found is not None
    assert 1.0 < found.where[0] < 5.5
    assert found.p_value < 1e-6


def test_a_signal_beside_larger_errors_at_reversals_is_a_small_share() -> None:
    turns = np.flatnonzero(np.sign(SPEED[1:]) != np.sign(SPEED[:-1]))
    rough = noise(0) + 2.0 * np.sin(2 * np.pi * 3.7 * T)
    alone = spectral_excess([rough], [SPEED], DT)
    for turn in turns:
        rough[turn - 1 : turn + 3] += 15.0
    found = spectral_excess([rough], [SPEED], DT)
    assert alone is not None
    assert found is not None
    assert found.p_value < 1e-6
    assert found.share < 0.5 * alone.share


def test_contact_is_bursts_at_their_times() -> None:
    touched = noise(0)
    for begin in (2.2, 7.4):
        touched[round(begin / DT) : round(begin / DT) + 15] += 12.0
    found = bursts([touched], [T], [SPEED])
    assert found is not None
    assert found.p_value < 1e-12
    assert found.share > 0.5
    assert all(min(abs(t - 2.2), abs(t - 7.4)) < 0.4 for t in found.where)


def test_errors_at_reversals_are_no_bursts() -> None:
    turns = np.flatnonzero(np.sign(SPEED[1:]) != np.sign(SPEED[:-1]))
    rough = noise(0)
    for turn in turns:
        rough[turn - 1 : turn + 3] += 12.0
    found = bursts([rough], [T], [SPEED])
    assert found is None or found.p_value > 1e-3


def test_a_joint_at_rest_has_none() -> None:
    rest = np.zeros(ROWS)
    assert spectral_excess([rest], [SPEED], DT) is None
    assert bursts([rest], [T], [SPEED]) is None


@pytest.mark.parametrize(("frequency", "own"), [(28.2, False), (100.0, True)])
def test_a_line_of_measured_motion_is_one_of_set_points_only_at_their_rate(frequency: float, own: bool) -> None:
    sample = 1.0 / 400.0
    t = sample * np.arange(4000)
    rng = np.random.default_rng(0)
    motion = np.sin(2.0 * t) + 1e-6 * rng.normal(size=t.size) + 1e-5 * np.sin(2 * np.pi * frequency * t)
    assert has_line(motion, sample, frequency, 0.1, 100.0, recorded=True)
    assert has_line(motion, sample, frequency, 0.1, 100.0, recorded=False) is own
    assert not has_line(motion, sample, 61.3, 0.1, 100.0, recorded=True)


def test_a_series_shorter_than_the_window_about_a_reversal_keeps_its_length() -> None:
    (away,) = away_from_reversals([np.ones(6)], [np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0])], 0.1)
    np.testing.assert_array_equal(away, [0.0 if abs(k - 5) <= 4 else 1.0 for k in range(6)])


def test_sidebands_of_set_points_do_not_hide_their_line() -> None:
    sample, rng = 1.0 / 500.0, np.random.default_rng(1)
    t = sample * np.arange(9000)
    knots = np.arange(0.0, t[-1] + 0.02, 0.01)
    waves = rng.uniform(0.1, 8.0, 40)[:, None] * knots + rng.uniform(0.0, 6.0, 40)[:, None]
    reference = np.interp(t, knots, np.sin(2.0 * np.pi * waves).sum(axis=0))
    assert has_line(reference, sample, 99.5, 1.0, 100.0, recorded=True)
    for frequency in (33.0, 61.3, 150.0):
        assert not has_line(reference, sample, frequency, 1.0, 100.0, recorded=True)
