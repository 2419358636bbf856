"""Bus load against the figures of can-utils and of Davis et al. 2007."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from armident.configs import ConfigError, SessionConfig, load_session
from armident.daq.cli import application
from armident.drivers.can.frames import FD_FLAG, FD_LENGTHS, counts_by_length, frames
from armident.drivers.canopen.bus_load import (
    alternatives,
    bus_loads,
    busy_seconds,
    check_fits,
    exact_bits,
    fd_frame_bits,
    fits,
    fitting_period,
    frame_bits,
    loads,
)
from armident.drivers.canopen.objects import TpdoLayout


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


@pytest.mark.parametrize(("data_bitrate", "percent"), [(5_000_000, 45), (8_000_000, 32)])
def test_six_axes_with_ten_samples_in_64_bytes_load_one_fd_bus_with_45_and_32_percent(
    data_bitrate: int, percent: int
) -> None:
    """Six frames and one SYNC per ten samples at 5 kHz, without stuff bits in the data."""
    nominal, data = fd_frame_bits(64)[0]
    sync = sum(exact_bits(0x80, bytes([k])) for k in range(1, 241)) / 240
    load = 500 * (6 * (nominal / 1e6 + data / data_bitrate) + sync / 1e6)
    assert round(100 * load) == percent


@given(st.sampled_from(FD_LENGTHS))
def test_an_fd_frame_has_the_bits_of_iso_11898(n: int) -> None:
    """Counted field by field: identifier, control, data, stuff count, CRC with fixed stuff bits, tail."""
    (low_nominal, low_data), (high_nominal, high_data) = fd_frame_bits(n)
    crc = 17 if n <= 16 else 21
    fixed = 1 + (4 + crc) // 4
    assert low_nominal + low_data == 1 + 11 + 5 + 1 + 4 + 8 * n + 4 + crc + fixed + 1 + 2 + 7 + 3
    stuffed = 1 + 11 + 5 + 1 + 4 + 8 * n
    assert high_nominal + high_data - low_nominal - low_data == (stuffed - 1) // 4


def physical(name: str, data_bitrate: int | None = None) -> SessionConfig:
    session = load_session(name)
    changed = {"bitrate": 1_000_000, "data_bitrate": data_bitrate}
    return session.model_copy(update={"buses": tuple(b.model_copy(update=changed) for b in session.all_buses)})


def test_the_shipped_sessions_of_several_buses_fit_physical_buses() -> None:
    check_fits(physical("tx40_six_buses"))
    check_fits(physical("tx40_one_fd", 5_000_000))
    two = physical("tx40_two_fd", 5_000_000)
    with pytest.raises(ConfigError, match="pack: 2 for samples"):
        check_fits(two)
    packed = two.streams["samples"].model_copy(update={"pack": 2})
    check_fits(two.model_copy(update={"streams": {"samples": packed}}))


def test_the_error_of_an_overload_lists_the_nearest_sessions_that_fit() -> None:
    session = on_a_physical_bus(200)
    options = alternatives(session)
    assert all(fits(option.session) for option in options)
    assert [option.kinds for option in options] == sorted(option.kinds for option in options)
    texts = [option.text for option in options]
    assert texts[0] == "sync.period_us 1000"
    assert "buses 6 instead of 1" in texts
    assert any("fd: true" in text and "pack:" in text for text in texts)
    # The smallest packing of each: one sample less in a frame would not fit.
    packed = next(o for o in options if "pack:" in o.text and "buses" not in o.text).session
    pack = packed.streams["samples"].pack
    fewer = max(k for k in range(1, pack) if 240 % k == 0)
    less = packed.streams["samples"].model_copy(update={"pack": fewer})
    assert not fits(packed.model_copy(update={"streams": {"samples": less}}))


def test_each_bus_carries_its_own_drives_and_every_sync() -> None:
    rows = loads(physical("tx40_six_buses"))
    per_bus = {row.bus for row in rows}
    assert len(per_bus) == 6
    assert sum(row.frames_per_s for row in rows if row.message.startswith("TPDO1")) == pytest.approx(30_000)
    assert sum(row.frames_per_s for row in rows if row.message == "SYNC") == pytest.approx(30_000)


@pytest.mark.parametrize(("name", "data_bitrate"), [("tx40_six_buses", None), ("tx40_one_fd", 5_000_000)])
def test_frames_of_a_second_take_the_time_that_is_planned_without_stuff_bits(
    name: str, data_bitrate: int | None
) -> None:
    session = physical(name, data_bitrate)
    bus = session.all_buses[0]
    stream = session.streams["samples"]
    received = frames(100, fd=bus.fd)
    received["length"] = TpdoLayout.of(stream.objects, "samples", stream.pack, bus.fd).frame_size
    received["flags"] = FD_FLAG if bus.fd else 0
    planned = next(row for row in bus_loads(session, bus) if row.message.startswith("TPDO1"))
    assert busy_seconds(bus, counts_by_length(received)) == pytest.approx(100 * planned.typical / planned.frames_per_s)
    assert counts_by_length(received)[int(bus.fd)].sum() == counts_by_length(received).sum() == 100


def test_frames_on_a_virtual_bus_take_no_known_time() -> None:
    assert np.isnan(busy_seconds(load_session("tx40_cell").all_buses[0], counts_by_length(frames(1))))


def table(*options: str) -> str:
    """Output and errors of the command."""
    words = ["bus-load", *options]
    return CliRunner().invoke(application(words), words).output


def test_a_bus_with_fd_keeps_fd_at_another_bit_rate() -> None:
    shipped = "tx40_one_fd.yaml"
    assert "vcan0: a CAN FD bus needs --data-bitrate, too" in table("--config", shipped, "--bitrate", "1000000")
    both = table("--config", shipped, "--bitrate", "1000000", "--data-bitrate", "5000000")
    assert "vcan0 (CAN FD)" in both
    assert "%" in both
    classic = table("--config", "tx40_six_buses.yaml", "--bitrate", "1000000")
    assert classic.count("(classic)") == 6
