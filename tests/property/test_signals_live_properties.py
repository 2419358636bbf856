"""What must hold for any signal: how a stream is cut does not matter, units do not, lines are followed exactly."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from armident.identify.signals.irwsm import automatic_nvr, kept_share
from armident.identify.signals.live import VelocityFilter

DT = 1e-3
seeds = st.integers(0, 2**32 - 1)
orders = st.sampled_from([2, 3])
ratios = st.floats(-9, 3).map(lambda exponent: 10.0**exponent)


@given(seeds, ratios, st.lists(st.integers(0, 200), max_size=5), st.booleans())
def test_how_the_stream_is_cut_into_batches_does_not_matter(seed: int, nvr: float, cuts: list[int], gaps: bool) -> None:
    rng = np.random.default_rng(seed)
    y = np.cumsum(rng.standard_normal((200, 3)), axis=0)
    if gaps:
        y[rng.random(y.shape) < 0.2] = np.nan
    whole = VelocityFilter(3, DT, nvr)
    expected = whole.handle(y)
    stream = VelocityFilter(3, DT, nvr)
    parts = [stream.handle(part) for part in np.split(y, sorted(cuts))]
    np.testing.assert_array_equal(np.concatenate([p.qd for p in parts]), expected.qd)
    np.testing.assert_array_equal(stream._p, whole._p)


@given(ratios, st.floats(-10, 10), st.floats(-5, 5))
def test_uniform_motion_is_followed_without_lag(nvr: float, start: float, speed: float) -> None:
    t = np.arange(400) * DT
    live = VelocityFilter(1, DT, nvr)
    found = live.handle((start + speed * t)[:, None])
    # The prior of the slope keeps 1e-10 of it at first; the rest is rounding of positions, divided by dt.
    scale = abs(start) + abs(speed)
    np.testing.assert_allclose(found.qd[50:, 0], speed, atol=1e-6 * scale + 1e-9)


@given(seeds, orders, st.floats(1e-6, 1e6))
def test_the_automatic_ratio_does_not_depend_on_the_unit(seed: int, order: int, unit: float) -> None:
    rng = np.random.default_rng(seed)
    y = np.cumsum(np.cumsum(rng.standard_normal(600))) + 30 * rng.standard_normal(600)
    assert abs(np.log10(automatic_nvr(unit * y, order) / automatic_nvr(y, order))) < 0.05


@given(orders, st.floats(-10, 4), st.floats(0.01, 2))
def test_a_greater_ratio_keeps_more_and_never_everything(order: int, exponent: float, step: float) -> None:
    less, more = kept_share(order, 10.0**exponent), kept_share(order, 10.0 ** (exponent + step))
    assert 0 < less < more < 1
