"""Re-identification without an arm: checks before the motion, text lines, baseline, fleet."""

import datetime
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
import yaml
from typer.testing import CliRunner, Result

from armident.configs import ConfigError, DataError, config_path, load_robot, load_session
from armident.configs.schema.scenario import Scenario
from armident.daq.cli import application
from armident.daq.recording import write_recording
from armident.identify.diagnosis.change_test import compare
from armident.identify.documents.files import load_document, to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.change.history import History
from armident.identify.monitoring.reidentify.baseline import baseline_of
from armident.identify.monitoring.reidentify.fleet import cluster
from armident.identify.monitoring.reidentify.run import prepare
from armident.identify.monitoring.reidentify.summary import change_lines, meaning_of, place_of
from tests.fixtures.arms import document, hide, recording
from tests.statistics.weeks import WORN

NOW = datetime.datetime(2026, 3, 1, tzinfo=datetime.UTC)
WEEKS = {"a_monday": (1, ()), "b_tuesday": (2, ()), "d_worn": (3, Scenario.model_validate(WORN).effects)}
"""Seed of the noise, and hidden effects."""


@pytest.fixture(scope="module")
def documents() -> dict[str, IdentificationDocument]:
    """Two weeks of an arm, and one with a tenth more friction in joint 2."""
    return {name: document("tx40", seed, *effects) for name, (seed, effects) in WEEKS.items()}


def cell(folder: Path, **changes: Any) -> Path:
    """The shipped cell with changes."""
    shipped = config_path("tx40_cell.yaml")
    data = yaml.safe_load(shipped.read_text())
    data["robot"] = str(config_path(data["robot"]))
    for drive in data["drives"]:
        drive["eds"] = str(config_path(drive["eds"]))
    data["setpoints"]["trajectory"] = str(config_path(data["setpoints"]["trajectory"]))
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in (data | changes).items() if value is not None}))
    return path


def store(folder: Path) -> str:
    return f"sqlite:///{folder}/history.sqlite"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"setpoints": None}, "missing, so nothing would move"),
        ({"sync": {"role": "consumer"}}, "expected producer, which sends SYNC"),
        ({"recording": {"trigger": {}}}, "records only events"),
    ],
)
def test_a_session_that_cannot_do_the_job_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        prepare(cell(tmp_path, **changes), None, store(tmp_path), None, 1e-4)


def test_a_trajectory_beyond_the_limits_never_moves_anything(tmp_path: Path) -> None:
    far = tmp_path / "far.yaml"
    far.write_text(
        "schema: armident/trajectory/1\nstart: [0, 0, 0, 0, 0, 0]\nmoves:\n- {to: [0, 3, 0, 0, 0, 0], duration: 9}\n"
    )
    config = cell(tmp_path, setpoints={"trajectory": str(far)})
    with pytest.raises(ConfigError, match=r"far\.yaml: joint_2 moves over \[0\.000, 3\.000\], allowed is"):
        prepare(config, None, store(tmp_path), None, 1e-4)


@pytest.mark.slow
def test_a_torque_beyond_the_limit_is_predicted_by_the_baseline(
    tmp_path: Path, documents: dict[str, IdentificationDocument]
) -> None:
    """Ten times the mass: joint 2 cannot hold the arm."""
    heavy = documents["a_monday"]
    parameters = [p.model_copy(update={"value": 10 * p.value}) if p.name == "mx2r" else p for p in heavy.parameters]
    baseline = tmp_path / "heavy.json"
    baseline.write_text(to_json(heavy.model_copy(update={"parameters": parameters})))
    with pytest.raises(ConfigError, match=r"joint_2 needs a torque of \d+\.\d, allowed is 110\.0"):
        prepare(cell(tmp_path), baseline, store(tmp_path), None, 1e-4)


def test_the_baseline_of_another_robot_is_refused(tmp_path: Path, documents: dict[str, IdentificationDocument]) -> None:
    other = tmp_path / "other.json"
    other.write_text(to_json(documents["a_monday"].model_copy(update={"robot": "rx160"})))
    with pytest.raises(DataError, match="the baseline is of robot 'rx160', the arm is 'tx40'"):
        prepare(cell(tmp_path), other, store(tmp_path), None, 1e-4)


def test_the_first_run_becomes_the_baseline_and_a_name_misspelt_later_does_not(
    tmp_path: Path, documents: dict[str, IdentificationDocument]
) -> None:
    history, file = History(store(tmp_path)), tmp_path / "baseline.json"
    first = baseline_of(file, history, "tx40", "cell")
    assert first.document is None
    assert str(file) in first.become(documents["a_monday"])
    assert load_document(file, IdentificationDocument) == documents["a_monday"]
    history.add(documents["a_monday"], NOW)
    assert baseline_of(file, history, "tx40", "cell").document == documents["a_monday"]
    assert baseline_of(None, history, "tx40", "cell").document == documents["a_monday"]
    with pytest.raises(
        ConfigError, match="no such file, and this is not the first run: the history has one of 2026-03-01"
    ):
        baseline_of(tmp_path / "baselin.json", history, "tx40", "cell")
    assert baseline_of(None, history, "emps", "cell").document is None


def test_ten_percent_more_friction_is_reported(documents: dict[str, IdentificationDocument]) -> None:
    """The line names joint, parameter, values and significance."""
    robot = load_robot("tx40.yaml")
    same = compare(documents["a_monday"], documents["b_tuesday"])
    assert not same.drifted
    assert change_lines(same, robot) == []
    worn = compare(documents["a_monday"], documents["d_worn"])
    assert worn.drifted
    words = change_lines(worn, robot)
    assert all(line.startswith("joint_2: ") for line in words)
    assert any("viscous friction fv2 5." in line and "standard deviations" in line for line in words)
    assert any(", p = " in line for line in words)


@pytest.mark.parametrize(
    ("name", "place", "meaning"),
    [
        ("fv3", "joint_3", "viscous friction"),
        ("fcm6", "joint_5 and joint_6", "Coulomb friction"),
        ("iam6", "joint_5 and joint_6", "rotor inertia"),
        ("zz1r", "joint_1", "inertia"),
        ("mx2r", "joint_2", "first moment of mass"),
        ("off4", "joint_4", "torque offset"),
    ],
)
def test_parameters_have_places_and_meanings(name: str, place: str, meaning: str) -> None:
    assert place_of(name, load_robot("tx40.yaml")) == place
    assert meaning_of(name) == meaning


def fleet_words(folder: Path, *options: str) -> list[str]:
    words = ["reidentify", "--recordings", str(folder / "[a-z]_*.mcap"), "--store", store(folder)]
    return [*words, "--out", str(folder / "results"), *options]


def fleet_in_process(folder: Path, *options: str) -> Result:
    """Run the command without a process of its own, which would import everything anew."""
    return CliRunner().invoke(application(["reidentify"]), fleet_words(folder, *options))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_fleet_is_compared_in_order_and_survives_a_failed_recording(tmp_path: Path) -> None:
    """One line per recording and one history; one file is torn before its first chunk."""
    from distributed import LocalCluster

    friction = hide("friction_drift", "joint_1", change=0.1, time_constant=1e-6)
    session = load_session("emps_cell.yaml").model_copy(update={"identification": {"method": "idim-ls"}})
    for name, seed, effects in (("a_monday", 1, ()), ("b_tuesday", 2, ()), ("d_worn", 3, (friction,))):
        made = replace(recording("emps", "emps_excitation", seed, *effects), session=session)
        write_recording(made, tmp_path / f"{name}.mcap")
    (tmp_path / "c_broken.mcap").write_bytes((tmp_path / "a_monday.mcap").read_bytes()[:3000])
    # The worker is two threads of this process, which has imported everything.
    with LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp://", dashboard_address=None
    ) as remote:
        done = fleet_in_process(tmp_path, "--scheduler", remote.scheduler_address, "--json")
    assert done.exit_code == 4, done.stderr
    monday, tuesday, broken, worn = (line for line in done.stderr.splitlines() if ".mcap: " in line)
    assert "a_monday.mcap: first run of emps: the baseline" in monday
    assert "b_tuesday.mcap: no change" in tuesday
    assert "c_broken.mcap: failed: " in broken
    assert "d_worn.mcap: CHANGED: joint_1: " in worn
    runs = json.loads(done.stdout)["runs"]
    assert [Path(run["recording"]).stem for run in runs] == ["a_monday", "b_tuesday", "c_broken", "d_worn"]
    assert runs[1]["drift"]["drifted"] is False
    assert np.isfinite(runs[1]["drift"]["chi_square"])
    with sa.create_engine(store(tmp_path)).connect() as connection:
        assert connection.execute(sa.text("select count(*) from identifications")).scalar() == 3
        assert connection.execute(sa.text("select count(*) from recordings")).scalar() == 3
        drifted = connection.execute(sa.text("select drifted from comparisons order by identification")).scalars().all()
    assert [bool(each) for each in drifted] == [False, True]
    results = tmp_path / "results" / "d_worn.identification" / "identification.json"
    assert load_document(results, IdentificationDocument).robot == "emps"


@pytest.mark.slow
def test_workers_of_this_machine_work_in_processes_of_their_own() -> None:
    with cluster(None, 1) as client:
        assert client.submit(os.getpid, pure=False).result(timeout=120) != os.getpid()


@pytest.mark.parametrize(
    ("scheduler", "workers", "message"),
    [
        (None, None, "needs --scheduler ADDRESS, or --workers N"),
        ("tcp://127.0.0.1:1", 2, "not with --scheduler"),
        ("nonsense://x", None, "no Dask scheduler answers there"),
    ],
)
def test_a_cluster_that_is_not_there_is_one_line(scheduler: str | None, workers: int | None, message: str) -> None:
    with pytest.raises(ConfigError, match=message), cluster(scheduler, workers):
        pytest.fail("there is a cluster")


def test_no_recording_matches_is_one_line(tmp_path: Path) -> None:
    done = fleet_in_process(tmp_path, "--workers", "1")
    assert done.exit_code == 2
    assert "no such file" in done.stderr


def test_the_shipped_cell_can_do_the_job(tmp_path: Path) -> None:
    job = prepare(config_path("tx40_cell.yaml"), None, store(tmp_path), tmp_path, 1e-4)
    assert job.session == load_session("tx40_cell.yaml")
    assert job.baseline.document is None
