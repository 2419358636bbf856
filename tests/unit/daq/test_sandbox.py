"""Readers of other tools' files in a subprocess: their arrays, errors, crashes and time limit."""

import os
import signal
import time
from typing import Any

import numpy as np
import pytest

from armident.daq.interchange.sandbox import read_in_subprocess


def test_only_arrays_are_returned() -> None:
    found = read_in_subprocess(
        lambda: {"q": np.arange(6.0).reshape(3, 2), "name": "x", "words": np.array(["a"]), "i": np.arange(3)}
    )
    assert found.keys() == {"q", "i"}
    assert np.array_equal(found["q"], np.arange(6.0).reshape(3, 2))


def refuse() -> dict[str, Any]:
    raise KeyError("no such\nthing")


def crash() -> dict[str, Any]:
    os.kill(os.getpid(), signal.SIGSEGV)
    return {}


def hang() -> dict[str, Any]:
    time.sleep(100)
    return {}


@pytest.mark.parametrize(("read", "words"), [(refuse, "no such"), (crash, "SIGSEGV"), (hang, "SIGKILL")])
def test_a_failing_reader_is_reported(read: Any, words: str) -> None:
    begin = time.monotonic()
    with pytest.raises(ValueError, match=words):
        read_in_subprocess(read, longest_s=1.0)
    assert time.monotonic() - begin < 60
