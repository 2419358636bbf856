"""Bus load against the figures of can-utils and of Davis et al. 2007."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from configs import ConfigError, SessionConfig, load_session
from drivers.bus_load import check_fits, exact_bits, fitting_period, frame_bits, loads


def on_a_physical_bus(period_us: int, drives: int = 6) -> SessionConfig:
    session = load_session("tx40_replay")
    return session.model_copy(
        update={
            "bus": session.bus.model_copy(update={"bitrate": 1_000_000}),
            "sync": session.sync.model_copy(update={"period_us": period_us}),
            "drives": session.drives[:drives],
        }
    )


def test_a_megabit_carries_7407_to_9009_frames_of_eight_bytes_a_second() -> None:
    low, high = frame_bits(8)
    assert round(1e6 / high) == 7407
    assert round(1e6 / low) == 9009


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_the_exact_length_of_a_frame_lies_between_the_bounds(identifier: int, data: bytes) -> None:
    low, high = frame_bits(len(data))
    assert low <= exact_bits(identifier, data) <= high


def test_alternating_bits_need_no_stuffing_in_the_data() -> None:
    assert exact_bits(0x555, bytes([0x55] * 8)) - 111 <= 4
    assert exact_bits(0x000, bytes(8)) > 120


def test_six_axes_at_one_kilohertz_fit_one_bus_and_at_five_kilohertz_do_not() -> None:
    check_fits(on_a_physical_bus(1000))
    with pytest.raises(ConfigError, match=r"% in the worst case; sync\.period_us 1000 would fit"):
        check_fits(on_a_physical_bus(200))
    assert fitting_period(on_a_physical_bus(200)) == 1000


def test_one_axis_at_five_kilohertz_fits_one_bus() -> None:
    session = on_a_physical_bus(200, drives=1)
    check_fits(session)
    assert 0.9 < sum(row.worst for row in loads(session)) <= 1.01


def test_a_virtual_bus_has_no_bit_rate_to_exceed() -> None:
    check_fits(load_session("tx40_cell"))
