"""When an arm that brakes counts as standing."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import load_robot, load_session
from armident.configs.units import counts_per_si
from armident.daq.capture.setpoints import REST_SPAN_S, REST_STEP_S, SHAKE_COUNTS, StandstillDetector

SESSION, ROBOT = load_session("tx40_cell.yaml"), load_robot("tx40.yaml")
SPAN = round(REST_SPAN_S / SESSION.sync_period)


def counts(q: list[float]) -> NDArray[np.int32]:
    """Encoder counts of joint positions."""
    found: NDArray[np.int32] = np.rint(ROBOT.transmission_matrix @ np.array(q) * counts_per_si(ROBOT)).astype(np.int32)
    return found


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize(("share", "rests"), [(0.0, True), (0.0016, True), (0.0024, False), (-0.0024, False)])
def test_a_joint_moves_that_is_faster_than_a_five_hundredth_of_its_limit(joint: int, share: float, rests: bool) -> None:
    standstill, q = StandstillDetector(SESSION, ROBOT), [0.1] * 6
    seen = []
    step = round(REST_STEP_S / SESSION.sync_period)
    for k in range(0, 3 * SPAN, step):
        q[joint] = 0.1 + share * ROBOT.joints[joint].limits.velocity * k * SESSION.sync_period
        seen.append(standstill.look(k, counts(q)))
    assert not any(seen[: SPAN // step]), "nobody knows yet"
    assert set(seen[SPAN // step + 1 :]) == {rests}


@pytest.mark.parametrize("joint", range(6))
def test_an_arm_that_swings_does_not_rest_where_it_turns_round(joint: int) -> None:
    standstill = StandstillDetector(SESSION, ROBOT)
    rate = 2 * np.pi * 10.0
    swing = 0.01 * ROBOT.joints[joint].limits.velocity / rate
    for k in range(0, 10 * SPAN, 3):
        q = [0.0] * 6
        q[joint] = swing * np.sin(rate * k * SESSION.sync_period)
        assert not standstill.look(k, counts(q))


def test_an_encoder_that_flickers_does_not_move() -> None:
    standstill, rng = StandstillDetector(SESSION, ROBOT), np.random.default_rng(1)
    seen = [standstill.look(k, rng.integers(0, round(SHAKE_COUNTS), 6, endpoint=True)) for k in range(3 * SPAN)]
    assert set(seen[SPAN:]) == {True}


def test_what_was_seen_before_braking_does_not_count_for_long() -> None:
    standstill, speed = StandstillDetector(SESSION, ROBOT), ROBOT.joints[0].limits.velocity
    for k in range(SPAN):
        assert not standstill.look(k, counts([speed * k * SESSION.sync_period, 0, 0, 0, 0, 0]))
    rest = counts([speed * SPAN * SESSION.sync_period, 0, 0, 0, 0, 0])
    first = next(k for k in range(SPAN, 4 * SPAN) if standstill.look(k, rest))
    assert 2 * SPAN - SPAN // 50 <= first <= 2 * SPAN + 1


def test_the_same_sync_again_says_nothing_new() -> None:
    standstill = StandstillDetector(SESSION, ROBOT)
    assert not any(standstill.look(5, counts([0.0] * 6)) for _ in range(1000))
