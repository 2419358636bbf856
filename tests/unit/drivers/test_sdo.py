"""SDO transfers with drives that repeat, mix up, round or delay their answers."""

import struct
from typing import Any

import pytest

from armident.configs import ConfigError
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.sdo import BUSY_RETRY_S, BUSY_S, DriveSdo, SdoRefusedError
from tests.fuzz.read_bus import LyingDrive, new_drive

PREVIOUS_ONLY, TWICE, PREVIOUS_FIRST = 4, 5, 10
"""Steps of the script of a `LyingDrive`."""
ANSWER_S = 0.05


def drive_with(**options: Any) -> tuple[LyingDrive, DriveSdo]:
    """A drive in cyclic synchronous position mode at 1234 counts."""
    drive, sdo = new_drive(timeout_s=ANSWER_S, **options)
    drive.objects = {(od.MODE_DISPLAY, 0): b"\x08", (od.POSITION_ACTUAL, 0): struct.pack("<i", 1234)}
    return drive, sdo


def steps(kind: int, count: int) -> bytes:
    return (bytes([kind]) + bytes(8)) * count


def aborts(code: int, count: int) -> bytes:
    return (bytes([2]) + bytes(4) + struct.pack("<L", code)) * count


@pytest.mark.parametrize("kind", [TWICE, PREVIOUS_FIRST])
def test_answers_that_come_again_are_ignored(kind: int) -> None:
    drive, sdo = drive_with()
    drive.script = steps(kind, 8)
    for _ in range(4):
        assert sdo.read(od.MODE_DISPLAY, 0, "b") == 8
        assert sdo.read(od.POSITION_ACTUAL, 0, "i") == 1234


def test_a_drive_that_answers_only_others_is_not_said_to_be_silent() -> None:
    drive, sdo = drive_with()
    assert sdo.read(od.MODE_DISPLAY, 0, "b") == 8
    drive.script = steps(PREVIOUS_ONLY, 1)
    expected = r"answered only other requests .* not that for object 6064h:0; is another program using its SDO channel"
    with pytest.raises(ConfigError, match=expected):
        sdo.read(od.POSITION_ACTUAL, 0, "i")


def test_an_abort_without_an_object_belongs_to_the_present_transfer() -> None:
    drive, sdo = drive_with()
    answer = drive._answer
    drive._answer = lambda request: b"\x80\0\0\0" + struct.pack("<L", 0x06020000)  # type: ignore[method-assign]
    assert sdo.read_optional(od.RATED_CURRENT, 0, "I") is None
    drive._answer = answer  # type: ignore[method-assign]
    assert sdo.read_optional(od.MODE_DISPLAY, 0, "b") == 8


@pytest.mark.parametrize("code", [0x08000020, 0x08000021, 0x08000022])
def test_a_busy_drive_is_asked_again(code: int) -> None:
    drive, sdo = drive_with()
    drive.script = aborts(code, 3)
    assert sdo.read(od.POSITION_ACTUAL, 0, "i") == 1234
    assert drive.asked == 4
    drive.script = aborts(code, 2)
    sdo.write(od.HEARTBEAT_PRODUCER, 0, 100, "H")
    assert drive.objects[od.HEARTBEAT_PRODUCER, 0] == b"\x64\x00"


def test_a_drive_that_stays_busy_is_asked_for_a_limited_time() -> None:
    drive, sdo = drive_with()
    drive.script = aborts(0x08000022, 150)
    with pytest.raises(SdoRefusedError, match="08000022h") as refused:
        sdo.read(od.POSITION_ACTUAL, 0, "i")
    assert not refused.value.absent
    assert drive.asked <= BUSY_S / BUSY_RETRY_S + 2


def test_other_aborts_are_not_repeated() -> None:
    drive, sdo = drive_with()
    drive.script = aborts(0x06090030, 1)
    with pytest.raises(SdoRefusedError, match="06090030h"):
        sdo.command(od.MODE_OF_OPERATION, 0, 8, "b")
    assert drive.asked == 1


class ReadOnly(dict[tuple[int, int], bytes]):
    """Object dictionary that keeps its values."""

    def __setitem__(self, key: tuple[int, int], value: bytes) -> None:
        pass


def test_a_read_only_object_is_accepted_where_it_holds_the_value() -> None:
    drive, sdo = drive_with()
    drive.objects = ReadOnly(drive.objects)
    drive.script = aborts(0x06010002, 1)
    sdo.write(od.POSITION_ACTUAL, 0, 1234, "i")
    drive.script = aborts(0x06010002, 1)
    with pytest.raises(SdoRefusedError, match=r"refuses object 6064h:0 = FFFFFFFBh"):
        sdo.write(od.POSITION_ACTUAL, 0, -5, "i")


class Rounded(dict[tuple[int, int], bytes]):
    """Object dictionary that keeps numbers of two bytes in steps of 64."""

    def __setitem__(self, key: tuple[int, int], value: bytes) -> None:
        if len(value) == 2:
            value = (-(-int.from_bytes(value, "little") // 64) * 64).to_bytes(2, "little")
        super().__setitem__(key, value)


def test_a_rounded_value_is_returned_or_refused() -> None:
    drive, sdo = drive_with()
    drive.objects = Rounded()
    assert sdo.write_rounded(od.HEARTBEAT_PRODUCER, 0, 100, "H") == 128
    with pytest.raises(ConfigError, match=r"object 1017h:0 reads 80h after writing 64h"):
        sdo.write(od.HEARTBEAT_PRODUCER, 0, 100, "H")
    sdo.write(od.HEARTBEAT_PRODUCER, 0, 100, "H", ignored=0xE4)


def test_a_remark_is_made_once() -> None:
    _, sdo = drive_with()
    made: list[str] = []
    sdo.on_remark = made.append
    for _ in range(2):
        sdo.remark("has no rated current (6075h)")
    assert made == ["has no rated current (6075h)"]
