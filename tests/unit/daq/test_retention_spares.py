"""Recordings that retention does not delete: marked, not identified, not copied, or of an unknown age."""

import datetime
import fcntl
import logging
from dataclasses import replace
from pathlib import Path

import pytest

from armident.configs.schema.session import RecordingOptions
from armident.daq.capture.recording_files import RecordingRetention
from armident.daq.recording import Mark, clock, write_recording
from armident.daq.recording.clock import ClockState
from armident.daq.recording.model import MarkKind
from armident.daq.recording.retention import KEEP, LEDGER, identified_in, prune, reason_to_stay
from armident.identify.monitoring.worker import ledger as ledger_module
from armident.identify.monitoring.worker.ledger import FoundFiles, Ledger, State
from tests.unit.daq.test_recording import make_recording
from tests.unit.daq.test_rotation import NOW, made


def deleted(folder: Path, copied_to: Path | None = None) -> list[Path]:
    """Delete recordings older than 30 days, and return those that are gone."""
    identified = identified_in(folder, "tx40")
    return prune(
        folder, "tx40", NOW, 30.0, None, needed=lambda path: reason_to_stay(path, identified, copied_to) is not None
    )


def test_a_marked_recording_stays(tmp_path: Path) -> None:
    plain, kept = made(tmp_path, "20261001T000000"), made(tmp_path, "20261002T000000")
    kept.with_name(kept.name + KEEP).touch()
    noted, other = (tmp_path / f"tx40-202610{day}T000000-000Z.mcap" for day in ("03", "04"))
    kinds: dict[Path, MarkKind] = {noted: "note", other: "emcy"}
    for path, kind in kinds.items():
        recording = make_recording(300)
        write_recording(replace(recording, marks=(Mark(kind, 5, int(recording.samples.t_ns[0]), "look"),)), path)
    made(tmp_path, "20261119T000000")
    assert deleted(tmp_path) == [plain, other]
    kept.with_name(kept.name + KEEP).unlink()
    assert deleted(tmp_path) == [kept]
    assert noted.exists()


def test_what_a_worker_has_not_identified_stays(tmp_path: Path) -> None:
    """The ledger is that of the workers; without one there is no worker to wait for."""
    assert LEDGER == ledger_module.FILE
    days = ("01", "02", "03", "04", "05")
    done, failed, waiting, strange, unknown = (made(tmp_path, f"202610{day}T000000") for day in days)
    parts = [made(tmp_path, "20261006T000000", suffix=f".000{k}.mcap") for k in (1, 2)]
    damaged = made(tmp_path, "20261007T000000", suffix=".mcap.damaged")
    made(tmp_path, "20261119T000000")
    ledger = Ledger(tmp_path / LEDGER, "worker")
    states: dict[Path, State] = {done: "done", failed: "failed", waiting: "waiting"}
    for path, state in states.items():
        ledger.add(path.name, path.stem, [path])
        assert ledger.claim(path.name) is not None
        assert ledger.finish(path.name, state, None, "")
    ledger.enter([FoundFiles(strange.stem, (strange,), ("stamp",), 0.0)], "of another cell")
    with parts[-1].open("rb") as file:
        # It ends perhaps never; its first parts are not waited for.
        fcntl.flock(file, fcntl.LOCK_EX)
        assert deleted(tmp_path) == [done, failed, strange, parts[0], damaged]
    assert deleted(tmp_path) == []
    assert all(path.exists() for path in (waiting, unknown, parts[1]))
    (tmp_path / LEDGER).unlink()
    assert deleted(tmp_path) == [waiting, unknown, parts[1]]


def test_a_ledger_that_cannot_be_read_deletes_nothing(tmp_path: Path) -> None:
    (tmp_path / LEDGER).write_bytes(b"no ledger" * 100)
    with pytest.raises(OSError, match="not a database") as caught:
        identified_in(tmp_path, "tx40")
    assert caught.value.filename == str(tmp_path / LEDGER)


def test_what_is_not_copied_stays(tmp_path: Path) -> None:
    folder, archive = tmp_path / "recordings", tmp_path / "archive"
    folder.mkdir()
    whole, half, none = (made(folder, f"2026100{day}T000000") for day in (1, 2, 3))
    made(folder, "20261119T000000")
    assert deleted(folder, archive) == []
    archive.mkdir()
    (archive / whole.name).write_bytes(whole.read_bytes())
    (archive / half.name).write_bytes(half.read_bytes()[:50])
    assert deleted(folder, archive) == [whole]
    assert half.exists()
    assert none.exists()


@pytest.mark.parametrize("synchronised", [True, False])
def test_a_clock_that_is_not_synchronised_makes_no_recording_old(
    synchronised: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Five recordings of the last days, and one that was made after the clock had stepped 40 days ahead."""
    caplog.set_level(logging.INFO, "armident")
    monkeypatch.setattr(clock, "clock_state", lambda: ClockState(0.0, 0.0, 0.0, synchronised))
    now = datetime.datetime.now(datetime.UTC)
    recent = [made(tmp_path, f"{now - datetime.timedelta(days=40 + k):%Y%m%dT%H%M%S}") for k in range(5)]
    made(tmp_path, f"{now - datetime.timedelta(hours=1):%Y%m%dT%H%M%S}")
    with RecordingRetention(RecordingOptions(keep_days=30.0), tmp_path, "tx40"):
        pass
    assert [path.exists() for path in recent] == [not synchronised] * 5
    assert ("because the clock is not synchronised" in caplog.text) == (not synchronised)


def test_the_reasons_why_recordings_stay_are_logged_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(clock, "clock_state", lambda: ClockState(0.0, 0.0, 0.0, True))
    for day in range(1, 4):
        made(tmp_path, f"2026010{day}T000000")
    made(tmp_path, "20260301T000000")
    options = RecordingOptions(keep_days=30.0, copied_to=tmp_path / "archive")
    with RecordingRetention(options, tmp_path, "tx40") as retention:
        retention._prune()
    said = [record.message for record in caplog.records]
    assert said == ["retention: 3 recordings stay that are not copied"]
