"""Polling of temperatures, without delay of other transfers by a drive that does not answer."""

import threading
import time
from collections.abc import Callable

import pytest

from armident.configs import ConfigError
from armident.configs.schema.session import Temperature
from armident.drivers.canopen import objects as od
from armident.drivers.canopen.temperature import ANSWER_S, TemperaturePoll
from tests.fuzz.read_bus import LyingDrive, new_drive

PLACE = Temperature(index=0x2030, subindex=2, type="int16", scale=0.1, every_s=1.0)
SILENT = bytes([3]) + bytes(8)


def until(found: Callable[[], bool]) -> bool:
    end = time.monotonic() + 10
    while not found() and time.monotonic() < end:
        time.sleep(0.005)
    return found()


def test_a_temperature_is_read_and_scaled() -> None:
    drive, sdo = new_drive(temperature=PLACE)
    drive.objects = {(0x2030, 2): (-123).to_bytes(2, "little", signed=True)}
    with TemperaturePoll([sdo]) as poll:
        assert until(lambda: poll.celsius() == {"joint_1": pytest.approx(-12.3)})


def test_a_drive_without_a_temperature_object_is_not_polled() -> None:
    drive, sdo = new_drive()
    with TemperaturePoll([sdo]) as poll:
        time.sleep(0.05)
        assert poll.celsius() == {}
    assert drive.asked == 0


def test_the_temperature_of_a_silent_drive_is_dropped_and_polled_again_later() -> None:
    drive, sdo = new_drive(temperature=PLACE)
    drive.objects = {(0x2030, 2): b"\x0a\x00"}
    drive.script = SILENT
    with TemperaturePoll([sdo], rest_s=0.05) as poll:
        assert until(lambda: poll.celsius() == {"joint_1": pytest.approx(1.0)})
    # A request, its abort when no answer came, and a request.
    assert drive.asked == 3


def test_a_drive_with_another_transfer_in_progress_is_skipped() -> None:
    drive, sdo = new_drive(temperature=PLACE)
    asked, go_on = threading.Event(), threading.Event()
    send = drive.send

    def slow(message: object) -> None:
        asked.set()
        go_on.wait(10)
        send(message)  # type: ignore[arg-type]

    drive.send = slow  # type: ignore[method-assign]
    drive.objects = {(od.MODE_DISPLAY, 0): b"\x08"}
    reader = threading.Thread(target=lambda: sdo.read(od.MODE_DISPLAY, 0, "b"))
    reader.start()
    assert asked.wait(10)
    assert sdo.poll(0x2030, 2, "h", ANSWER_S) is None
    go_on.set()
    reader.join()
    assert drive.asked == 1


def test_a_command_waits_for_a_poll_no_longer_than_the_answer_time() -> None:
    drive, sdo = new_drive(temperature=PLACE, timeout_s=5.0)
    drive.script = SILENT
    begin = time.monotonic()
    with pytest.raises(ConfigError, match="does not answer"):
        sdo.poll(0x2030, 2, "h", ANSWER_S)
    assert time.monotonic() - begin < 4.0
    assert sdo.node.sdo.RESPONSE_TIMEOUT == 5.0


def test_the_faulty_drive_behaves_like_a_drive_without_its_fault() -> None:
    drive, sdo = new_drive()
    assert isinstance(drive, LyingDrive)
    sdo.write(od.HEARTBEAT_PRODUCER, 0, 100, "H")
    assert drive.objects[od.HEARTBEAT_PRODUCER, 0] == b"\x64\x00"
