"""Texts of error frames (linux/can/error.h)."""

import numpy as np
import pytest

from armident.drivers.can.error_frames import describe, summarise
from armident.drivers.can.frames import ERROR_FLAG, Frames, frames


def error(classes: int, detail: int = 0) -> Frames:
    one = frames(1)
    one["can_id"], one["length"], one["data"][0, 1] = ERROR_FLAG | classes, 8, detail
    return one


@pytest.mark.parametrize(
    ("classes", "detail", "state", "text"),
    [
        (0x040, 0, "bus_off", "bus-off"),
        (0x100, 0, "restarted", "restarted"),
        (0x004, 0x20, "passive", "error passive"),
        (0x004, 0x08, "warning", "warning level"),
        (0x004, 0x40, "active", "error active"),
        (0x004, 0x01, None, "overflow"),
        (0x020, 0, None, "nobody acknowledges"),
        (0x08A, 0, None, "arbitration lost, protocol violation, bus error"),
        (0x200, 0, None, "class 200h"),
    ],
)
def test_every_class_has_its_text(classes: int, detail: int, state: str | None, text: str) -> None:
    found = describe(error(classes, detail)[0])
    assert found[0] == state
    assert text in found[1]


def test_changes_of_state_are_reported_one_by_one_and_other_errors_counted() -> None:
    several = [error(0x20), error(0x40), error(0x20), error(0x100)]
    told = summarise(np.concatenate(several))
    assert [state for state, _ in told] == ["bus_off", "restarted", None]
    assert told[-1][1] == "nobody acknowledges (2 times)"
