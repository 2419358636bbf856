"""``armident investigate`` killed at every write of a file, and continued: only the stage that ran is repeated."""

import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

import armident
from armident.daq.cli import main
from armident.identify.documents.files import load_document
from armident.identify.documents.investigation import InvestigationDocument
from tests.fixtures.processes import start

pytestmark = [pytest.mark.slow, pytest.mark.nightly, pytest.mark.timeout(300)]

TWIN = f"{Path(sys.executable).with_name('armident')} robot --config emps.yaml --to-command"
WRITES = 11
"""Files that the investigation of a healthy axis replaces until its outcome is written."""
PLAYED = 7
"""The one of them that is the recording of its motion."""


def killed(words: list[str], write: int) -> None:
    """Run a command that is killed while it replaces a file for the ``write``-th time."""
    replace, done = os.replace, []

    def kills(*names: Any, **options: Any) -> None:
        done.append(names)
        if len(done) == write:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(*names, **options)

    os.replace = kills
    main(words)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recordings") / "first.mcap"
    armident.simulate_recording("emps", "emps_excitation", seed=1, period=1e-3).save(file)
    return file


@pytest.mark.parametrize("write", range(1, WRITES + 1))
def test_a_kill_loses_only_the_stage_that_ran(first: Path, tmp_path: Path, write: int) -> None:
    out, log = tmp_path / "why", tmp_path / "log"
    begin = ["investigate", str(first), "--out", str(out)]
    asking = ["--yes", "--robot-command", TWIN]
    with log.open("wb") as file:
        assert start(killed, [*begin, *asking], write, stdout=file, stderr=file).wait(200) == -signal.SIGKILL
    before = None
    if (out / "investigation.json").exists():
        before = load_document(out / "investigation.json", InvestigationDocument)
        begin = ["investigate", "--continue", str(out)]
    recorded = [path.read_bytes() for path in out.glob("answer_1.mcap")]
    with log.open("wb") as file:
        code = start(main, [*begin, *asking], stdout=file, stderr=file).wait(200)
    assert code == 0, log.read_text(encoding="utf-8")
    document = load_document(out / "investigation.json", InvestigationDocument)
    assert document.outcome == "healthy"
    (one,) = document.rounds
    assert one.recording is not None
    assert document.motion_s == pytest.approx(one.chosen.duration_s)
    if before is not None and before.rounds:
        assert one.chosen == before.rounds[0].chosen
        assert before.rounds[0].recording in (None, one.recording)
    # The program was not called again if its recording was in the folder.
    assert [path.name for path in out.glob("answer_*")] == ["answer_1.mcap"]
    assert recorded in ([], [(out / "answer_1.mcap").read_bytes()])
    assert bool(recorded) == (write > PLAYED)
