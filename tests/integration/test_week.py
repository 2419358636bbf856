"""A minute of `tests.faults.week` with a few faults, and ten minutes with all of them."""

from pathlib import Path

import pytest

from tests.faults.week import run

pytestmark = pytest.mark.slow

FAULTS = ("worker killed", "router gone", "disk full", "clock jumped", "attack")
ODD = ("half", "replaced", "deleted", "copy", "other cell", "bomb", "damaged", "no recording")
"""Those that no worker waits a minute for."""


@pytest.mark.parametrize(
    ("minutes", "faults", "odd"),
    [
        pytest.param(1.0, FAULTS, ODD, marks=pytest.mark.timeout(1800)),
        pytest.param(10.0, (), (), marks=[pytest.mark.nightly, pytest.mark.timeout(7200)]),
    ],
)
def test_every_file_has_one_result_or_one_reason_and_every_result_one_announcement(
    tmp_path: Path, minutes: float, faults: tuple[str, ...], odd: tuple[str, ...]
) -> None:
    report = run(minutes, 1, tmp_path, 10.0, faults, odd)
    assert report["wrong"] == []
    assert report["audit"]["files with one result"] > 8 * minutes
    assert report["audit"]["files with one reason"] > 0
    assert len(report["faults"]) > 2 * minutes
    # Nobody but the plant has been believed, and its listener has been there.
    assert sum(report["audit"][f"heard {how}"] for how in ("once", "again", "not, told when asked")) > 8 * minutes
