"""Metrics for Prometheus: values with kind, labels and unit, over HTTP and in a file."""

import socket
import urllib.error
import urllib.request
from contextlib import closing
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from armident.configs import ConfigError, SessionConfig
from armident.configs.loading import load_session
from armident.metrics import INFO, Family, Metrics, MetricsExporter, Value, check_file

METRICS = Metrics(
    "test",
    (
        INFO,
        Family("frames", "frames_total", "Frames."),
        Family("error_us", "clock_error_seconds", "Error.", scale=1e-6),
        Family("load_of", "load_ratio", "Load.", ("bus",)),
    ),
)
COMMON = ("press_7", "tx40")
LABELS = {"cell": "press_7", "robot": "tx40"}
Found = dict[tuple[str, str], tuple[str, dict[str, str], float]]


def parsed(text: str) -> Found:
    return {
        (sample.name, sample.labels.get("bus", "")): (family.type, sample.labels, sample.value)
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def scraped(exporter: MetricsExporter) -> Found:
    directly = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with directly.open(exporter.url, timeout=10) as answer:
        return parsed(answer.read().decode())


def test_values_are_served_in_base_units_with_the_labels_of_the_cell() -> None:
    with closing(MetricsExporter(METRICS, COMMON).serve("127.0.0.1", 0)) as exporter:
        before = scraped(exporter)
        loads: Value = {("can0",): 0.25, ("can1",): 0.5, ("vcan0",): float("nan")}
        exporter.values = {"frames": 12, "error_us": 3.0, "load_of": loads, "file": "a.mcap"}
        found = scraped(exporter)
        exporter.values = {"frames": 15, "error_us": None}
        after = scraped(exporter)
    assert set(before) == {("armident_test_info", "")}
    assert found == {
        **before,
        ("armident_test_frames_total", ""): ("counter", LABELS, 12),
        ("armident_test_clock_error_seconds", ""): ("gauge", LABELS, 3e-6),
        ("armident_test_load_ratio", "can0"): ("gauge", LABELS | {"bus": "can0"}, 0.25),
        ("armident_test_load_ratio", "can1"): ("gauge", LABELS | {"bus": "can1"}, 0.5),
    }
    assert after == {**before, ("armident_test_frames_total", ""): ("counter", LABELS, 15)}


def test_an_occupied_port_is_a_configuration_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"metrics: cannot listen on 127\.0\.0\.1:{port}: Address already"):
            MetricsExporter(METRICS, COMMON).serve("127.0.0.1", port)


def test_the_port_is_free_again_afterwards() -> None:
    with closing(MetricsExporter(METRICS, COMMON).serve("127.0.0.1", 0)) as first:
        url = first.url
    port = int(url.split(":")[2].split("/")[0])
    with closing(MetricsExporter(METRICS, COMMON).serve("127.0.0.1", port)) as second:
        assert second.url == url


def test_metrics_can_be_read_and_nothing_else() -> None:
    with closing(MetricsExporter(METRICS, COMMON).serve("127.0.0.1", 0)) as exporter:
        for method in ("POST", "PUT", "DELETE"):
            request = urllib.request.Request(exporter.url, b"armident_test_frames_total 1", method=method)
            with pytest.raises(urllib.error.HTTPError, match=r"405|501"):
                urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=10)


def test_a_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.prom"
    path.write_text("old")
    exporter = MetricsExporter(METRICS, COMMON)
    exporter.values = {"frames": 7}
    exporter.write(path)
    assert parsed(path.read_text())["armident_test_frames_total", ""] == ("counter", LABELS, 7)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("name", "words"), [("a.txt", "must end in .prom"), ("none/a.prom", "there is no folder")])
def test_a_file_that_nobody_would_read_is_refused(tmp_path: Path, name: str, words: str) -> None:
    check_file(tmp_path / "a.prom")
    with pytest.raises(ConfigError, match=words):
        check_file(tmp_path / name)


def test_capture_and_worker_of_a_session_have_ports_of_their_own() -> None:
    metrics = load_session("tx40_cell.yaml").metrics.model_dump()
    assert metrics == {"port": None, "worker_port": None, "address": "127.0.0.1"}
    data = load_session("tx40_cell.yaml").model_dump(by_alias=True)
    with pytest.raises(ValueError, match="capture and worker cannot both listen on 9101"):
        SessionConfig.model_validate(data | {"metrics": {"port": 9101, "worker_port": 9101}})
