"""Detection of standstill."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import load_robot, load_session
from armident.configs.units import counts_per_si
from armident.daq.capture.setpoint_source import NOISE_COUNTS, REST_SPAN_S, REST_STEP_S, StandstillDetector

SESSION, ROBOT = load_session("tx40_cell.yaml"), load_robot("tx40.yaml")
SPAN = round(REST_SPAN_S / SESSION.sync_period)


def counts(q: list[float]) -> NDArray[np.int32]:
    """Return the encoder counts (n,) of joint positions (n,), rad."""
    found: NDArray[np.int32] = np.rint(ROBOT.transmission_matrix @ np.array(q) * counts_per_si(ROBOT)).astype(np.int32)
    return found


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize(("share", "rests"), [(0.0, True), (0.0016, True), (0.0024, False), (-0.0024, False)])
def test_a_joint_faster_than_0_2_percent_of_its_limit_moves(joint: int, share: float, rests: bool) -> None:
    standstill, q = StandstillDetector(SESSION, ROBOT), [0.1] * 6
    seen = []
    step = round(REST_STEP_S / SESSION.sync_period)
    for k in range(0, 3 * SPAN, step):
        q[joint] = 0.1 + share * ROBOT.joints[joint].limits.velocity * k * SESSION.sync_period
        seen.append(standstill.update(k, counts(q)))
    assert not any(seen[: SPAN // step]), "not known before the first 50 ms have passed"
    assert set(seen[SPAN // step + 1 :]) == {rests}


@pytest.mark.parametrize("joint", range(6))
def test_the_turning_point_of_an_oscillation_is_no_standstill(joint: int) -> None:
    standstill = StandstillDetector(SESSION, ROBOT)
    rate = 2 * np.pi * 10.0
    swing = 0.01 * ROBOT.joints[joint].limits.velocity / rate
    for k in range(0, 10 * SPAN, 3):
        q = [0.0] * 6
        q[joint] = swing * np.sin(rate * k * SESSION.sync_period)
        assert not standstill.update(k, counts(q))


def test_noise_of_two_encoder_counts_is_no_motion() -> None:
    standstill, rng = StandstillDetector(SESSION, ROBOT), np.random.default_rng(1)
    seen = [standstill.update(k, rng.integers(0, round(NOISE_COUNTS), 6, endpoint=True)) for k in range(3 * SPAN)]
    assert set(seen[SPAN:]) == {True}


def test_standstill_is_detected_soon_after_braking() -> None:
    standstill, speed = StandstillDetector(SESSION, ROBOT), ROBOT.joints[0].limits.velocity
    for k in range(SPAN):
        assert not standstill.update(k, counts([speed * k * SESSION.sync_period, 0, 0, 0, 0, 0]))
    rest = counts([speed * SPAN * SESSION.sync_period, 0, 0, 0, 0, 0])
    first = next(k for k in range(SPAN, 4 * SPAN) if standstill.update(k, rest))
    assert 2 * SPAN - SPAN // 50 <= first <= 2 * SPAN + 1


def test_repeated_positions_of_one_sync_are_no_standstill() -> None:
    standstill = StandstillDetector(SESSION, ROBOT)
    assert not any(standstill.update(5, counts([0.0] * 6)) for _ in range(1000))
