"""Progress of the commands on a terminal."""

import numba
import pytest

from armident.identify.cli_tables import progress


def test_the_compiler_message_appears_once(capsys: pytest.CaptureFixture[str]) -> None:
    one = numba.njit(lambda x: x + 1)
    two = numba.njit(lambda x: x + 2)
    with progress("identify tx40.mcap"):
        assert one(1) + two(1) == 5
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "compiling" in line] == [
        "identify tx40.mcap: compiling for this machine, once: later runs find it cached"
    ]
    with progress("identify tx40.mcap"):
        assert one(1) == 2
    assert "compiling" not in capsys.readouterr().err
