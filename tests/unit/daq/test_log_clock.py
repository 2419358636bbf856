"""Times of bus logs: equal, coarse, wrapped, negative, from the newest to the oldest, and of several runs."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from armident.configs import ConfigError, DataError, SessionConfig
from armident.daq.interchange.bus_log import recording_from_log
from armident.daq.interchange.importing import import_recording
from tests.unit.daq.test_bus_log import PERIOD_NS, ROBOT, SESSION
from tests.unit.daq.test_log_files import ROWS, lines_of, read, same


def with_sync(**changes: object) -> SessionConfig:
    """Return the session with other keys of SYNC."""
    return SESSION.model_copy(update={"sync": SESSION.sync.model_copy(update=changes)})


SLOWER = with_sync(period_us=1000)


def candump(path: Path, lines: Sequence[str], stamp: Callable[[float], float]) -> Path:
    """Write the lines of a log with other times, s, that ``stamp`` makes of those since its beginning."""
    since = np.maximum.accumulate([float(line.split()[0][1:-1]) for line in lines])
    times = [stamp(t) for t in since - since[0]]
    path.write_text("".join(f"({t:.6f}) {line.split(' ', 1)[1]}" for t, line in zip(times, lines, strict=True)))
    return path


@pytest.mark.parametrize("digits", [None, 0])
def test_times_that_do_not_tell_the_sync_period_need_the_rate(tmp_path: Path, digits: int | None) -> None:
    path, lines = lines_of(tmp_path, ".log")
    candump(path, lines, lambda t: 0.0 if digits is None else round(t + 0.488, digits))
    for session in (SESSION, SLOWER):
        with pytest.raises(
            DataError, match=r"do not tell the SYNC period, which is every .* ms in the session.*--rate"
        ):
            recording_from_log(path, session, ROBOT)
    with pytest.raises(ConfigError, match=r"--rate 5000 contradicts the session: SYNC comes every 1 ms"):
        import_recording(path, SLOWER, rate_hz=5000.0)
    found = import_recording(path, SESSION, rate_hz=5000.0)
    assert same(found)
    assert "the SYNC rate of 5000 Hz is that of --rate, and is not verified" in found.metadata["source_remarks"]


@pytest.mark.parametrize(("wrap_s", "digits"), [(60.0, 3), (65.536, 3), (4294.967296, 6), (60.0, 4)])
def test_wraps_of_adapters_are_undone_and_the_period_is_verified(tmp_path: Path, wrap_s: float, digits: int) -> None:
    path, lines = lines_of(tmp_path, ".log")
    candump(path, lines, lambda t: float(np.floor((wrap_s - 0.01 + t) % wrap_s * 10**digits) / 10**digits))
    found = read(path)
    assert same(found)
    assert f"times begin again after {wrap_s:.10g} s (1 times): unwrapped" in found.metadata["source_remarks"]
    lasts = found.samples.t_ns[-1] - found.samples.t_ns[0]
    assert lasts == pytest.approx((ROWS - 1) * PERIOD_NS, abs=2 * 10 ** (9 - digits))
    with pytest.raises(DataError, match=r"SYNC comes every 0\.\d+ ms .* but every 1 ms in the session"):
        recording_from_log(path, SLOWER, ROBOT)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".trc"])
def test_a_log_from_the_newest_to_the_oldest_frame_is_turned_round(tmp_path: Path, suffix: str) -> None:
    path, lines = lines_of(tmp_path, suffix)
    frames = [k for k, line in enumerate(lines) if " 18" in line or " 28" in line or "80" in line.split("#")[0][-4:]]
    frames = [
        k for k, line in enumerate(lines) if not line.startswith((";", "//", "date", "base", "Begin", "End", "int"))
    ]
    turned = dict(zip(frames, reversed([lines[k] for k in frames]), strict=True))
    path.write_text("".join(turned.get(k, line) for k, line in enumerate(lines)))
    found = read(path)
    assert same(found)
    assert "the newest frame comes first" in found.metadata["source_remarks"]


def test_the_sync_counter_tells_the_order_of_frames_with_equal_times(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    candump(path, lines, lambda _: 0.0)
    path.write_text("".join(reversed(path.read_text().splitlines(keepends=True))))
    found = recording_from_log(path, SESSION, ROBOT, rate_hz=5000.0)
    assert same(found)
    assert "the newest frame comes first" in found.metadata["source_remarks"]


@pytest.mark.parametrize("relative", [False, True])
def test_times_before_a_trigger_are_negative(tmp_path: Path, relative: bool) -> None:
    path, lines = lines_of(tmp_path, ".asc")
    made = []
    for line in lines:
        words = line.split()
        if words and words[0].replace(".", "").isdigit() and "Rx" in words:
            made.append(f"  {float(words[0]) - 0.012:.6f} {' '.join(words[1:])}\n")
        elif not (relative and line.startswith(("date", "Begin"))):
            made.append(line)
    assert any(line.startswith("  -") for line in made)
    path.write_text("".join(made))
    found = read(path)
    assert same(found)
    assert np.all(found.samples.t_ns >= 0)


def test_a_second_run_in_a_log_is_named_with_its_line(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    first = candump(path, lines[:700], lambda t: t + 100).read_text()
    path.write_text(first + candump(tmp_path / "b.log", lines, lambda t: t).read_text())
    with pytest.raises(
        DataError, match=r"line 701: times go back by 100 s here.* jumps from \d+ to 1: several runs in"
    ):
        read(path)
    found = recording_from_log(path, with_sync(counter=0), ROBOT)
    assert "or another run begins there: write one file for each" in found.metadata["source_remarks"]
    later = candump(tmp_path / "c.log", lines, lambda t: t + 100).read_text()
    path.write_text(candump(tmp_path / "b.log", lines, lambda t: t).read_text() + later)
    assert "or another run begins there: write one file for each" in read(path).metadata["source_remarks"]
