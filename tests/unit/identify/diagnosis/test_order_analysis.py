"""Order analysis: ripple of any real order over an angle."""

import numpy as np
import pytest

from armident.identify.diagnosis.order_analysis import PEAKS, strongest_orders


def turning(seconds: float = 40.0, dt: float = 1e-3) -> np.ndarray:
    """An angle that moves forwards and back over several turns, rad."""
    t = np.arange(0.0, seconds, dt)
    return np.asarray(12.0 * np.sin(0.3 * t) + 5.0 * np.sin(0.71 * t))


@pytest.mark.parametrize("order", [1.0, 2.5, 3.37, 7.913])
def test_an_order_that_is_no_integer_is_found(order: float) -> None:
    angle = turning()
    noise = np.random.default_rng(1).standard_normal(angle.size)
    found = strongest_orders([angle], [0.5 * np.cos(order * angle + 0.4) + noise], 20.0)
    apart = 2 * np.pi / np.ptp(angle)
    assert found[0][0] == pytest.approx(order, abs=0.5 * apart)
    assert found[0][1] > 30.0
    assert len(found) <= PEAKS


def test_two_orders_are_found_strongest_first_over_several_stretches() -> None:
    angles = [turning(20.0), turning(30.0) + 1.0]
    residual = [1.0 * np.sin(2.5 * a) + 0.4 * np.sin(9.2 * a) for a in angles]
    noise = np.random.default_rng(2)
    found = strongest_orders(angles, [r + 0.5 * noise.standard_normal(r.size) for r in residual], 20.0)
    assert [order for order, _ in found[:2]] == pytest.approx([2.5, 9.2], abs=0.15)


def test_noise_has_no_outstanding_order() -> None:
    angle = turning()
    found = strongest_orders([angle], [np.random.default_rng(3).standard_normal(angle.size)], 20.0)
    assert max(power for _, power in found) < 30.0


def test_a_motor_that_stands_has_no_orders() -> None:
    assert strongest_orders([np.ones(100)], [np.ones(100)], 20.0) == []
