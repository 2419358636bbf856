"""Metrics for Prometheus: values of the last health message, with kind and labels."""

import socket
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from armident.configs import ConfigError
from armident.daq.capture.metrics import Metrics


def scraped(metrics: Metrics) -> dict[str, tuple[str, dict[str, str], float]]:
    directly = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with directly.open(f"http://127.0.0.1:{metrics.port}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    return {
        sample.name: (family.type, sample.labels, sample.value)
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_health_is_served_as_counters_and_gauges_of_the_cell() -> None:
    labels = {"cell": "press_7", "robot": "tx40"}
    with Metrics("127.0.0.1", 0, labels) as metrics:
        before = scraped(metrics)
        metrics.update({"frames": 12, "rows_in_gaps": 3, "frames_per_s": 29_998.5, "file": "a.mcap", "queue_depth": 0})
        found = scraped(metrics)
        metrics.update({"frames": 15})
        after = scraped(metrics)
    assert set(before) == {"armident_capture_info"}
    assert found == {
        **before,
        "armident_frames_total": ("counter", labels, 12),
        "armident_rows_in_gaps_total": ("counter", labels, 3),
        "armident_frames_per_s": ("gauge", labels, 29_998.5),
        "armident_queue_depth": ("gauge", labels, 0),
    }
    assert after["armident_frames_total"] == ("counter", labels, 15)


def test_an_occupied_port_is_a_configuration_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"metrics: cannot listen on 127\.0\.0\.1:{port}: Address already"):
            Metrics("127.0.0.1", port, {"cell": "a", "robot": "b"})


def test_the_port_is_free_again_afterwards() -> None:
    with Metrics("127.0.0.1", 0, {"cell": "a", "robot": "b"}) as first:
        port = first.port
    with Metrics("127.0.0.1", port, {"cell": "a", "robot": "b"}) as second:
        assert second.port == port
