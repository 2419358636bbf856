"""CANopen objects, TPDO layouts and the EDS of the servo drive."""

import canopen
import numpy as np
import pytest
from canopen.objectdictionary import ODArray, ODVariable
from hypothesis import given
from hypothesis import strategies as st

from armident.configs import ConfigError, config_path
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.emcy import emcy_text
from armident.drivers.canopen.objects import DriveState, TpdoLayout, drive_state
from armident.drivers.canopen.pdo_mapping import interpolation_period

EDS = str(config_path("eds/cia402_servo.eds"))


def test_the_samples_stream_fills_eight_bytes_in_mapping_order() -> None:
    layout = TpdoLayout.of(["position", "current", "status"])
    assert layout.size == 8
    assert layout.entries == (0x60640020, 0x60780010, 0x60410010)


@given(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1), st.integers(0, 2**16 - 1))
def test_decoding_returns_the_packed_values(position: int, current: int, status: int) -> None:
    packed = (
        position.to_bytes(4, "little", signed=True)
        + current.to_bytes(2, "little", signed=True)
        + status.to_bytes(2, "little")
    )
    data = np.frombuffer(packed, dtype=np.uint8).reshape(1, 8)
    record = TpdoLayout.of(["position", "current", "status"]).decode(data)[0]
    assert (record["position"], record["current"], record["status"]) == (position, current, status)


def test_a_short_tpdo_decodes_with_the_bytes_behind_it_ignored() -> None:
    data = np.array([[1, 2, 3, 4, 99, 99, 99, 99], [255, 255, 255, 255, 0, 0, 0, 0]], dtype=np.uint8)
    assert TpdoLayout.of(["demand"]).decode(data)["demand"].tolist() == [0x04030201, -1]


def test_more_than_eight_bytes_are_refused_with_the_size_of_each_object() -> None:
    with pytest.raises(ConfigError, match=r"streams\.samples: 10 bytes \(position 4, velocity 4, current 2\)"):
        TpdoLayout.of(["position", "velocity", "current"], "streams.samples")


@pytest.mark.parametrize(("names", "message"), [(["speed"], "no object named 'speed'"), (["demand"] * 2, "twice")])
def test_unknown_and_repeated_objects_are_refused(names: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TpdoLayout.of(names)


def test_every_statusword_belongs_to_at_most_one_state() -> None:
    for statusword in range(256):
        matching = [s for s, (mask, value) in od.STATE_CODES.items() if statusword & mask == value]
        assert len(matching) <= 1
        assert drive_state(statusword) == (matching[0] if matching else None)


def test_operation_enabled_is_recognised_whatever_the_manufacturer_bits() -> None:
    assert drive_state(0x0027) == drive_state(0xFFA7 & ~0x0008) == DriveState.ENABLED


def test_emcy_texts_fall_back_to_the_narrowest_group() -> None:
    assert emcy_text(0x8130) == "life guard or heartbeat error"
    assert emcy_text(0x2315) == "continuous over-current on the output side"
    assert emcy_text(0x8199) == "communication"
    assert emcy_text(0x2999) == "current"
    assert emcy_text(0xA000) == "unknown error"


@pytest.mark.parametrize("kind", [canopen.LocalNode, canopen.RemoteNode])
def test_the_eds_loads_for_both_sides_of_the_bus(kind: type[canopen.LocalNode] | type[canopen.RemoteNode]) -> None:
    dictionary = kind(5, EDS).object_dictionary
    device, second_tpdo = dictionary.get_variable(od.DEVICE_TYPE), dictionary.get_variable(od.TPDO_COMMUNICATION + 1, 1)
    assert device is not None
    assert device.default == 0x00020000 | od.DEVICE_PROFILE_CIA402
    assert second_tpdo is not None
    assert second_tpdo.default == 0x80000285


def test_every_object_of_the_eds_has_a_default_that_its_type_can_hold() -> None:
    node = canopen.LocalNode(5, EDS)
    for entry in node.object_dictionary.values():
        for variable in [entry] if isinstance(entry, ODVariable) else entry.values():
            data = node.get_data(variable.index, variable.subindex)
            assert variable.data_type not in canopen.objectdictionary.NUMBER_TYPES or 8 * len(data) == len(variable)


def test_every_object_a_stream_may_carry_is_mappable_in_the_eds_with_the_size_we_map() -> None:
    dictionary = canopen.import_od(EDS, 1)
    for mapped in (*od.OBJECTS.values(), od.SETPOINT):
        variable = dictionary.get_variable(mapped.index, mapped.subindex)
        assert variable is not None
        assert variable.pdo_mappable
        assert len(variable) == mapped.bits
    controlword = dictionary.get_variable(od.CONTROLWORD)
    assert controlword is not None
    assert controlword.writable


def test_objects_that_are_not_process_data_are_not_mappable() -> None:
    dictionary = canopen.import_od(EDS, 1)
    for index in (od.DEVICE_TYPE, od.RATED_CURRENT, od.HEARTBEAT_PRODUCER):
        variable = dictionary.get_variable(index)
        assert variable is not None
        assert not variable.pdo_mappable


@given(st.integers(1, 255), st.sampled_from([1, 10, 100, 1000]))
def test_the_interpolation_period_means_the_set_point_period(value: int, unit: int) -> None:
    period_us = value * unit
    mantissa, exponent = interpolation_period(period_us)
    assert 0 < mantissa <= 255
    assert mantissa * 10 ** (exponent + 6) == period_us


def test_one_millisecond_is_stated_as_drives_expect_it() -> None:
    assert interpolation_period(1000) == (1, -3)


def test_a_period_without_a_short_mantissa_is_refused() -> None:
    with pytest.raises(ConfigError, match="60C2h"):
        interpolation_period(1001)


def test_a_vendor_text_comes_before_that_of_the_standard() -> None:
    assert emcy_text(0xFF01, {0xFF01: "encoder battery low"}) == "encoder battery low"
    assert emcy_text(0x4310, {0xFF01: "encoder battery low"}) == "excess drive temperature"


def test_a_packed_tpdo_maps_the_arrays_sample_by_sample() -> None:
    layout = TpdoLayout.of(["position", "current"], pack=10, fd=True)
    assert (layout.size, layout.frame_size) == (6, 60)
    assert layout.entries[:4] == (0x20640120, 0x20780110, 0x20640220, 0x20780210)
    assert len(layout.entries) == 20


def test_the_error_of_an_oversized_tpdo_names_can_fd() -> None:
    with pytest.raises(ConfigError, match=r"8 bytes of a TPDO; a bus with fd: true carries 64"):
        TpdoLayout.of(["position", "velocity", "current"])
    with pytest.raises(ConfigError, match=r"11 times 6 bytes .* do not fit into the 64 bytes"):
        TpdoLayout.of(["position", "current"], pack=11, fd=True)


def test_the_fd_eds_has_every_array_that_packed_samples_are_mapped_from() -> None:
    known = canopen.import_od(str(config_path("eds/cia402_servo_fd.eds")), 1)
    for entry in TpdoLayout.of(["position", "velocity", "current", "torque", "demand", "status"], fd=True).objects:
        array = known[entry.packed(1).index]
        assert isinstance(array, ODArray)
        assert array[1].pdo_mappable
        assert len(array[1]) == entry.bits
        assert array[0].default == 64
