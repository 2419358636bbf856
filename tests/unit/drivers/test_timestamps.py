"""Hardware time stamps in the machine's time: as even as the interface's clock, never later than software stamps."""

import numpy as np
import pytest

from armident.drivers.can.mmsg import DROP_CONTROL_BYTES, HARDWARE_CONTROL, STAMP_CONTROL
from armident.drivers.can.timestamps import InterfaceClock, has_hardware_timestamps

PERIOD_NS = 200_000
START = 1_700_000_000_000_000_000


def stamps(count: int, drift: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True times, and software and hardware stamps of frames every 200 us; interrupts take 10 to some 100 us."""
    rng = np.random.default_rng(seed)
    true = START + PERIOD_NS * np.arange(count, dtype=np.int64)
    software = true + 10_000 + rng.exponential(50_000, count).astype(np.int64)
    hardware = 5_000_000_000 + ((true - START) * (1 + drift)).astype(np.int64)
    return true, software, hardware


@pytest.mark.parametrize("drift", [0.0, 3e-5, -3e-5])
@pytest.mark.parametrize("cuts", [[], [1, 7, 500, 501, 9000]])
def test_spacing_is_that_of_the_hardware_and_the_base_that_of_the_machine(drift: float, cuts: list[int]) -> None:
    true, software, hardware = stamps(50_000, drift)
    clock = InterfaceClock()
    parts = zip(np.split(software, cuts), np.split(hardware, cuts), strict=True)
    times = np.concatenate([clock.to_utc(s, h) for s, h in parts])
    assert np.all(times <= software)
    settled = slice(5000, None)
    error = (times - true)[settled]
    # Limited by the shortest interrupt latency, and by the drift of the clocks between two short ones.
    assert error.min() >= 0
    assert error.max() < 20_000
    assert np.diff(times)[settled].std() < 0.05 * np.diff(software)[settled].std()


def test_a_clock_step_restarts_the_estimate_of_the_offset() -> None:
    true, software, hardware = stamps(20_000, 0.0)
    clock = InterfaceClock()
    clock.to_utc(software[:10_000], hardware[:10_000])
    later = clock.to_utc(software[10_000:] + 3_600_000_000_000, hardware[10_000:])
    assert np.abs(later[1000:] - true[11_000:] - 3_600_000_000_000).max() < 100_000


def test_frames_without_a_hardware_stamp_keep_their_software_one() -> None:
    _, software, hardware = stamps(100, 0.0)
    hardware[::3] = 0
    times = InterfaceClock().to_utc(software, hardware)
    assert np.array_equal(times[::3], software[::3])


def test_control_messages_lie_where_the_kernel_puts_them() -> None:
    """cmsghdr of 16 bytes, a timespec or three of them, then a cmsghdr and the counter in eight bytes."""
    assert STAMP_CONTROL.itemsize - DROP_CONTROL_BYTES == 16 + 16
    assert HARDWARE_CONTROL.itemsize - DROP_CONTROL_BYTES == 16 + 3 * 16
    fields = HARDWARE_CONTROL.fields
    assert fields is not None
    assert (fields["seconds"][1], fields["hardware_seconds"][1], fields["drops"][1]) == (16, 48, 80)


def test_a_missing_interface_has_no_hardware_stamps() -> None:
    assert not has_hardware_timestamps("can97")
