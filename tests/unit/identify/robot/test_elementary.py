"""Vector sine, cosine and arctangent against the C library's."""

import numpy as np
import pytest

from armident.compiled import ARITHMETIC, compiled
from armident.identify.robot.chain import Floats
from armident.identify.robot.elementary import arctangents, padded, sines_cosines


@compiled(kept=True, **ARITHMETIC)
def turned(angle: Floats, sine: Floats, cosine: Floats) -> None:
    """A kernel around the inlined helper."""
    sines_cosines(angle, sine, cosine)


@compiled(kept=True, **ARITHMETIC)
def bent(x: Floats, out: Floats, slope: Floats) -> None:
    """A kernel around the inlined helper."""
    arctangents(x, out, slope)


@compiled(kept=True, **ARITHMETIC)
def lanes(n: int) -> int:
    """A kernel around the inlined helper."""
    return padded(n)


@pytest.mark.slow
def test_sine_and_cosine_are_exact_to_the_last_places_up_to_1e5() -> None:
    rng = np.random.default_rng(1)
    quarters = np.arange(-400, 401) * (np.pi / 4)
    angle = np.concatenate([rng.uniform(-10, 10, 20_000), rng.uniform(-1e5, 1e5, 20_000), quarters, [0.0]])
    sine, cosine = np.empty_like(angle), np.empty_like(angle)
    turned(angle, sine, cosine)
    assert np.abs(sine - np.sin(angle)).max() < 4e-16
    assert np.abs(cosine - np.cos(angle)).max() < 4e-16


@pytest.mark.slow
def test_the_arctangent_is_exact_to_the_last_places_everywhere() -> None:
    rng = np.random.default_rng(2)
    x = np.concatenate(
        [rng.choice([-1.0, 1.0], 40_000) * 10.0 ** rng.uniform(-300, 300, 40_000), [0.66, 2.4142135, 0.0]]
    )
    out, slope = np.empty_like(x), np.empty_like(x)
    with np.errstate(over="ignore"):
        expected = 1.0 / (1.0 + x * x)
    bent(x, out, slope)
    assert np.max(np.abs(out - np.arctan(x)) / np.maximum(np.abs(np.arctan(x)), 1e-300)) < 5e-16
    assert np.allclose(slope, expected, rtol=1e-15, atol=0)


def test_what_is_not_finite_stays_so() -> None:
    angle = np.array([np.nan, np.inf])
    sine, cosine = np.empty(2), np.empty(2)
    turned(angle, sine, cosine)
    assert not np.isfinite(sine).any()
    assert not np.isfinite(cosine).any()
    assert lanes(6) == 8
    assert lanes(8) == 8
