"""Messages for missing buses, and frames in arrays."""

import numpy as np
import pytest

from armident.configs import ConfigError
from armident.configs.schema.session import Bus
from armident.drivers.can.frames import FRAME, frame, frames
from armident.drivers.can.udp import open_bus
from armident.drivers.canopen.sync_producer import SetpointPlan
from armident.drivers.vcan import have_socketcan


def test_a_frame_ends_with_the_sixteen_bytes_of_the_kernel() -> None:
    one = frame(0x181, b"\x01\x02\x03")
    kernel = one.view(np.uint8)[8:]
    assert kernel.tolist() == [0x81, 1, 0, 0, 3, 0, 0, 0, 1, 2, 3, 0, 0, 0, 0, 0]


def test_joining_arrays_of_frames_keeps_their_layout() -> None:
    assert np.concatenate([frames(2), frames(3)]).dtype == FRAME


def test_a_bus_that_does_not_exist_is_a_configuration_error_with_the_command_to_run() -> None:
    expected = r"bus vcan97: no such CAN interface.*sudo ip link" if have_socketcan() else "bus vcan97: .*no SocketCAN"
    with pytest.raises(ConfigError, match=expected):
        open_bus(Bus(channel="vcan97"))


def test_an_address_that_is_no_multicast_group_is_a_configuration_error() -> None:
    with pytest.raises(ConfigError, match=r"bus 10\.1\.2\.3: cannot join"):
        open_bus(Bus(interface="udp_multicast", channel="10.1.2.3"))


def test_set_points_must_have_a_column_per_drive() -> None:
    with pytest.raises(ValueError, match="for 3 drives"):
        SetpointPlan(np.zeros((4, 2), dtype=np.int32), (0x201, 0x202, 0x203))
