"""A real capture, worker and job export the metrics that they declare, with the values of what they did.

The capture records a virtual axis on a bus over UDP. Rules, dashboard and documentation are compared with the same
declarations in `tests/unit/test_metrics_shipped.py`.
"""

import logging
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from armident.configs import ArmidentError, DataError, SessionConfig
from armident.configs.loading import HERE
from armident.configs.schema.session import Bus
from armident.daq.capture.capture import CaptureResult, capture, load_plan
from armident.daq.capture.capture_metrics import CAPTURE
from armident.daq.recording import Recording, write_recording
from armident.daq.recording.clock import clock_state
from armident.identify.diagnosis.change_test import compare
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.reidentify import run
from armident.identify.monitoring.reidentify.job_metrics import JOB, drift_values
from armident.identify.monitoring.reidentify.reidentify_options import ReidentifyOptions
from armident.identify.monitoring.reidentify.run import reidentify_command
from armident.identify.monitoring.worker.ledger import FILE, Ledger
from armident.identify.monitoring.worker.worker import Worker
from armident.identify.monitoring.worker.worker_metrics import WORKER
from armident.metrics import COMMON, Metrics
from tests.faults.service import cell_of
from tests.fixtures import arms
from tests.fixtures.processes import armident
from tests.integration.test_worker import LONGEST_S
from tests.integration.test_worker_failures import recorded

pytestmark = pytest.mark.slow

FRICTION = arms.hide("friction_drift", "joint_1", change=0.1, time_constant=1e-6)
Exported = dict[str, dict[tuple[str, ...], float]]
"""Values of each metric by those of its labels besides cell and robot, in the order of their declaration."""


def exported(metrics: Metrics, text: str) -> Exported:
    """Values of all metrics, whose types and labels are those declared; promtool has no objection, if it is there."""
    declared = {f"armident_{metrics.program}_{each.name}": each for each in metrics.families}
    found: Exported = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            each = declared[sample.name]
            assert family.type == ("counter" if sample.name.endswith("_total") else "gauge")
            assert family.documentation == each.help
            assert set(sample.labels) == {*COMMON, *each.labels}
            found.setdefault(sample.name, {})[tuple(sample.labels[name] for name in each.labels)] = sample.value
    if shutil.which("promtool"):
        done = subprocess.run(
            ["promtool", "check", "metrics"], input=text, capture_output=True, text=True, check=False, timeout=60
        )
        assert done.returncode == 0, done.stderr
    return {name.removeprefix(f"armident_{metrics.program}_"): values for name, values in found.items()}


def names(metrics: Metrics) -> set[str]:
    return {family.name for family in metrics.families}


def scraped(metrics: Metrics, caplog: pytest.LogCaptureFixture, wanted: Callable[[Exported], bool]) -> Exported:
    """Metrics from the endpoint that the log names, as soon as they are as wanted."""
    until = time.monotonic() + LONGEST_S
    found: Exported = {}
    while time.monotonic() < until:
        for url in re.findall(r"metrics on (http://127\.0\.0\.1:\d+/metrics)", caplog.text)[-1:]:
            with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(url, timeout=10) as answer:
                found = exported(metrics, answer.read().decode())
            if wanted(found):
                return found
        time.sleep(0.2)
    raise AssertionError(found)


def cell(folder: Path, **changes: Any) -> Path:
    """The shipped cell of one axis, with changes."""
    data = yaml.safe_load((HERE / "cells" / "emps_cell.yaml").read_text(encoding="utf-8"))
    letters = "".join(letter if letter.isalnum() else "_" for letter in folder.name.lower())
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data | {"cell": letters, "identification": {"method": "idim-ls"}} | changes))
    return path


def test_a_capture_exports_what_it_declares(udp_bus: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The object of the mode stands for a temperature, which virtual drives have not: 8 in units of 5 degrees."""
    caplog.set_level(logging.INFO)
    warm = {"index": 0x6061, "type": "int8", "scale": 5.0, "every_s": 1.0}
    drive = {"joint": "joint_1", "node_id": 1, "eds": "eds/cia402_servo.eds", "temperature": warm}
    config = cell(
        tmp_path,
        bus={"interface": "udp_multicast", "channel": udp_bus.channel, "bitrate": 1_000_000},
        sync={"role": "producer", "period_us": 20_000, "counter": 240},
        drives=[drive],
        metrics={"port": 0},
        setpoints=None,
    )
    process = armident("robot", "--config", config, "--noise", 0)
    stop, results = threading.Event(), list[CaptureResult]()
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready:")
        thread = threading.Thread(
            target=lambda: results.append(capture(load_plan(config, tmp_path / "out", None, False), stop))
        )
        thread.start()
        found = scraped(
            CAPTURE,
            caplog,
            lambda each: "drive_temperature_celsius" in each and each["rows_total"][()] > 100 and not stop.is_set(),
        )
        stop.set()
        thread.join()
    finally:
        stop.set()
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=20)
    try:
        clock_state()
        without = set[str]()
    except OSError:
        without = {name for name in names(CAPTURE) if name.startswith("clock_")}
    assert set(found) == names(CAPTURE) - without
    (result,) = results
    assert found["rows_total"][()] <= result.counters["samples.rows"]
    assert found["drive_temperature_celsius"] == {("joint_1",): 40.0}
    bus = (udp_bus.channel,)
    # A late SYNC brings its frames into another second.
    assert 0 < found["bus_load_ratio"][bus] < 2 * found["bus_load_planned_ratio"][bus] < 0.1
    assert 0 < found["frames_total"][bus] <= result.counters["frames"]
    assert set(found["sync_jitter_seconds"]) == {(*bus, each) for each in ("std", "p50", "p99", "p99.9", "max")}
    assert 0 < found["sync_jitter_seconds"][*bus, "max"] < 10
    assert abs(found["updated_timestamp_seconds"][()] - time.time()) < LONGEST_S
    assert found["events_total"]["heartbeat_lost",] <= result.counters["heartbeat_lost"]
    # The endpoint has ended with the capture.
    with pytest.raises(OSError, match="refused"):
        scraped(CAPTURE, caplog, lambda _: True)


def test_a_worker_exports_what_it_declares(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    session = cell_of(tmp_path)
    session = session.model_copy(update={"metrics": session.metrics.model_copy(update={"worker_port": 0})})
    made = recorded(session, "a")
    (tmp_path / "emps-c.mcap").write_bytes(b"no recording\x89MCAP0\r\n")
    with Worker(session, made.robot, tmp_path) as worker:
        assert worker.result(LONGEST_S) == 0
        found = scraped(
            WORKER, caplog, lambda each: each.get("recordings", {}).get(("done",)) == 1 and "parameter_std" in each
        )
        # A recording that another worker holds.
        other = Ledger(tmp_path / FILE, "other", lease_s=1000.0)
        other.add("f" * 64, "emps-b", [tmp_path / "emps-b.mcap"])
        assert other.claim("f" * 64) is not None
        waits = scraped(WORKER, caplog, lambda each: each["oldest_waiting_seconds"][()] >= 1.0)
    assert set(found) == names(WORKER)
    states = {"waiting": 0, "done": 1, "failed": 0, "passed": 1, "ignored": 0}
    assert found["recordings"] == {(state,): number for state, number in states.items()}
    assert found["oldest_waiting_seconds"] == {(): 0.0}
    assert found["attempts_total"][()] == 2
    document = load_document(tmp_path / "emps-a.identification" / "identification.json", IdentificationDocument)
    assert [verdict for (verdict,), value in found["last_verdict"].items() if value] == [document.verdict]
    assert found["parameter_value"] == {("joint_1", p.name, p.unit): p.value for p in document.parameters}
    assert found["parameter_std"] == {("joint_1", p.name, p.unit): p.std for p in document.parameters}
    assert found["torque_error_ratio"][()] == pytest.approx(document.relative_error_pct / 100)
    assert waits["recordings"] == found["recordings"] | {("waiting",): 1}
    assert waits["oldest_waiting_seconds"][()] < LONGEST_S
    assert waits["parameter_value"] == found["parameter_value"]


def test_a_second_worker_serves_the_metrics_when_the_first_has_ended(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    session, robot = cell_of(tmp_path), arms.recording("emps", "emps_excitation", 1).robot
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        session = session.model_copy(update={"metrics": session.metrics.model_copy(update={"worker_port": port})})
        with Worker(session, robot, tmp_path) as worker:
            assert worker.result(3.0) is None
            assert caplog.text.count(f"metrics: cannot listen on 127.0.0.1:{port}") == 1
            taken.close()
            assert scraped(WORKER, caplog, lambda each: "recordings" in each)["zenoh_open"] is not None


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Recording | Exception], Exported]:
    """Runs a job with a recording in place of the motion, or a failure; returns its metrics."""
    config, file = cell(tmp_path), tmp_path / "reidentify.prom"
    store = f"sqlite:///{tmp_path}/history.sqlite"
    numbers = iter(range(100))

    def moved(done: Recording | Exception) -> Recording:
        if isinstance(done, Exception):
            raise done
        path = tmp_path / f"emps-20260105T06000{next(numbers)}-000Z.mcap"
        write_recording(done, path)
        return replace(done, path=path)

    def carry_out(done: Recording | Exception) -> Exported:
        monkeypatch.setattr(run, "record_run", lambda *_: moved(done))
        options = ReidentifyOptions(config=config, store=store, out=tmp_path, metrics=file)
        if isinstance(done, ArmidentError):
            with pytest.raises(type(done)):
                reidentify_command(options, as_json=True)
        else:
            reidentify_command(options, as_json=True)
        return exported(JOB, file.read_text(encoding="utf-8"))

    return carry_out


def of_the_cell(seed: int, session: SessionConfig) -> Recording:
    return replace(arms.recording("emps", "emps_excitation", seed), session=session)


def test_a_job_exports_what_it_declares(job: Callable[[Recording | Exception], Exported], tmp_path: Path) -> None:
    session = cell_of(tmp_path)
    first = job(of_the_cell(1, session))
    assert names(JOB) - set(first) == {"p_value", "p_value_limit"}, "there is no baseline yet"
    second = job(of_the_cell(2, session))
    assert set(second) == names(JOB)
    assert (second["exit_code"], second["changed"], second["investigated"]) == ({(): 0}, {(): 0}, {(): 0})
    assert sum(second["verdict"].values()) == 1
    assert min(second["p_value"].values()) > second["p_value_limit"][()] > 0
    assert ("all_parameters", "") in second["p_value"]
    assert ("friction", "joint_1") in second["p_value"]
    assert abs(second["last_run_timestamp_seconds"][()] - time.time()) < LONGEST_S
    failed = job(DataError("the guard stopped the motion"))
    assert failed["exit_code"] == {(): 3}
    assert set(failed) == {"info", "exit_code", "last_run_timestamp_seconds", "duration_seconds"}


def test_the_evidence_of_a_change_names_the_joint_and_its_friction() -> None:
    before, after = arms.document("emps", 1), arms.document("emps", 3, FRICTION)
    values = drift_values(compare(before, after), after)
    limit, found = values["limit"], values["p_values"]
    assert isinstance(limit, float)
    assert isinstance(found, dict)
    assert {of for of, p in found.items() if p < limit} >= {("friction", "joint_1"), ("all_parameters", "")}
