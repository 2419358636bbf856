"""When an arm that brakes counts as standing."""

import numpy as np
import pytest
from numpy.typing import NDArray

from configs import load_robot, load_session
from daq.motion import REST_SPAN_S, Standstill
from daq.streams import counts_per_si

SESSION, ROBOT = load_session("tx40_cell.yaml"), load_robot("tx40.yaml")
SPAN = round(REST_SPAN_S / SESSION.sync_period)


def counts(q: list[float]) -> NDArray[np.int32]:
    """Encoder counts of joint positions."""
    found: NDArray[np.int32] = np.rint(ROBOT.transmission_matrix @ np.array(q) * counts_per_si(ROBOT)).astype(np.int32)
    return found


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize(("share", "rests"), [(0.0, True), (0.008, True), (0.012, False), (-0.012, False)])
def test_a_joint_moves_that_is_faster_than_a_hundredth_of_its_limit(joint: int, share: float, rests: bool) -> None:
    standstill, q = Standstill(SESSION, ROBOT), [0.1] * 6
    seen = []
    for k in range(0, 3 * SPAN, 7):
        q[joint] = 0.1 + share * ROBOT.joints[joint].limits.velocity * k * SESSION.sync_period
        seen.append(standstill.look(k, counts(q)))
    assert not any(seen[: SPAN // 7]), "nobody knows yet"
    assert set(seen[SPAN // 7 + 1 :]) == {rests}


def test_what_was_seen_before_braking_does_not_count_for_long() -> None:
    standstill, speed = Standstill(SESSION, ROBOT), ROBOT.joints[0].limits.velocity
    for k in range(SPAN):
        assert not standstill.look(k, counts([speed * k * SESSION.sync_period, 0, 0, 0, 0, 0]))
    rest = counts([speed * SPAN * SESSION.sync_period, 0, 0, 0, 0, 0])
    first = next(k for k in range(SPAN, 4 * SPAN) if standstill.look(k, rest))
    assert 2 * SPAN - SPAN // 50 <= first <= 2 * SPAN + 1


def test_the_same_sync_again_says_nothing_new() -> None:
    standstill = Standstill(SESSION, ROBOT)
    assert not any(standstill.look(5, counts([0.0] * 6)) for _ in range(1000))
