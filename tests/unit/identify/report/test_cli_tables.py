"""Progress of the commands on a terminal."""

import numba
import pytest

from armident.identify.cli.progress import progress, time_left


def test_the_compiler_message_appears_once(capsys: pytest.CaptureFixture[str]) -> None:
    one = numba.njit(lambda x: x + 1)
    two = numba.njit(lambda x: x + 2)
    with progress("identify tx40.mcap"):
        assert one(1) + two(1) == 5
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "compiling" in line] == [
        "identify tx40.mcap: compiling for this machine, once: later runs find it"
    ]
    with progress("identify tx40.mcap"):
        assert one(1) == 2
    assert "compiling" not in capsys.readouterr().err


def test_plain_progress_states_the_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armident.identify.cli.progress.SHOW_AFTER_S", 0.0)
    with progress("trajectory") as report:
        report("searching", 0.0)
        report("searching", 0.5)
    assert capsys.readouterr().err.splitlines() == [
        "trajectory: searching (0 %)",
        "trajectory: searching (50 %, 0 s left)",
    ]
    assert time_left(30.0, 0.25) == "90 s"
    assert time_left(600.0, 0.5) == "10 min"
