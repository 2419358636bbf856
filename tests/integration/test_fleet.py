"""A fleet in processes of its own: one worker is killed, some recordings fail, and SQL of the docs asks its table."""

import os
import re
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import duckdb
import pytest
from distributed import Client

from armident.configs import ArmidentError, load_session
from armident.identify.monitoring.reidentify import fleet
from tests.evaluation.fleet import REST, Outcome, at_rest, run
from tests.fixtures.arms import hide, recording

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
WORN = hide("friction_drift", "joint_1", change=0.1, time_constant=1e-6)
RUNS = {
    "cell_1/monday.mcap": (1, (), 2),
    "cell_1/tuesday.mcap": (2, (WORN,), 3),
    "cell_2/monday.mcap": (3, (), 2),
    "cell_2/tuesday.mcap": (4, (), 3),
}
"""Seed of the noise, hidden effects and day of each recording."""
PAGE = Path(__file__).resolve().parents[2] / "docs" / "jobs.md"


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """Folder and figures of a fleet with two workers, of which one is killed in the middle."""
    folder = tmp_path_factory.mktemp("fleet")
    session = load_session("emps_cell.yaml").model_copy(update={"identification": {"method": "idim-ls"}})
    for name, (seed, effects, day) in RUNS.items():
        made = recording("emps", "emps_excitation", seed, *effects)
        facts = {"cell": name.partition("/")[0], "started_utc": f"2026-11-0{day}T06:00:00+00:00"}
        (folder / "recordings" / name).parent.mkdir(parents=True, exist_ok=True)
        replace(made, session=session, metadata=facts).save(folder / "recordings" / name)
    (folder / "recordings" / REST).parent.mkdir()
    at_rest(made.robot).save(folder / "recordings" / REST)
    return folder, run(folder / "recordings", folder, 2, list(RUNS), [REST])


def test_every_recording_has_one_result_or_reason_also_if_a_worker_is_killed(outcome: tuple[Path, Outcome]) -> None:
    folder, figures = outcome
    assert figures.killed_after
    assert figures.violations == []
    assert figures.exit_code == 4, (folder / "stderr").read_text()
    assert list(figures.failed) == [REST]


def sql_blocks() -> list[str]:
    return re.findall(r"^```sql\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_the_questions_of_the_documentation_are_answered_by_the_table(
    outcome: tuple[Path, Outcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, figures = outcome
    monkeypatch.chdir(folder)
    changed, failed, moved = (duckdb.connect().execute(text).fetchall() for text in sql_blocks())
    assert [(row[0], row[1]) for row in changed] == [("cell_1", "emps")]
    assert "fv1" in changed[0][3] or "fc1" in changed[0][3]
    assert failed == [(str(folder / "recordings" / REST), figures.failed[REST])]
    assert [row[0].day for row in moved] == [2, 3]
    assert all(std > 0 for _, _, std, _ in moved)
    assert moved[0][3] == 0
    assert moved[1][3] == pytest.approx(100 * (moved[1][1] / moved[0][1] - 1))


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with fleet.cluster(None, 1) as client:
        yield client


def end_of_worker(number: int) -> int:
    """End the process, as the kernel does when memory is short."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_recording_whose_workers_end_is_given_up_and_no_other_is(client: Client) -> None:
    futures = [client.submit(end_of_worker, number, pure=False) for number in range(3)]
    results: list[Any] = [fleet._fetched(future) for future in futures]
    first, deadly, last = results
    assert (first, last) == (0, 2)
    assert isinstance(deadly, ArmidentError)
    assert "4 workers ended while it was identified" in str(deadly)
