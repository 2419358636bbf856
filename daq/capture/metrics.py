"""Metrics of a capture for Prometheus; off by default, and on the loopback interface."""

from collections.abc import Iterator
from typing import Self

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from armident.configs import ConfigError

Value = int | float | str | None

COUNTERS = {
    "frames": "CAN frames received",
    "rows": "Complete rows recorded",
    "rows_in_gaps": "Rows that are in the gap list",
    "rows_not_written": "Rows that could not be written to disk",
    "kernel_drops": "Frames that the kernel dropped because the receive buffer was full",
    "blocks_dropped": "Blocks that were not sent on Zenoh because the queue was full",
    "events_dropped": "Events that were not sent on Zenoh because the queue was full",
    "emcy": "Emergency messages of drives",
    "heartbeat_lost": "Lost heartbeats of drives",
    "rebooted": "Unexpected reboots of drives",
    "bus_down": "Buses that went down",
    "bus_off": "CAN controllers that went bus-off",
    "error_frames": "Error frames of the controllers",
}
"""Values of the health message that are counters, with their help texts; all others are gauges."""


class Metrics:
    """Serves the last health message over HTTP, each metric with ``labels``; port 0 takes a free one."""

    def __init__(self, address: str, port: int, labels: dict[str, str]) -> None:
        collected = _Collected(labels)
        registry = CollectorRegistry()
        registry.register(collected)
        try:
            self._server, self._thread = start_http_server(port, address, registry)
        except OSError as error:
            raise ConfigError(f"metrics: cannot listen on {address}:{port}: {error.strerror}") from error
        self._collected = collected

    @property
    def port(self) -> int:
        """Port of the server."""
        return int(self._server.server_port)

    def update(self, health: dict[str, Value]) -> None:
        """Replace the served health message."""
        self._collected.health = dict(health)

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Collected(Collector):
    def __init__(self, labels: dict[str, str]) -> None:
        self.health: dict[str, Value] = {}
        self._labels = labels

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics of the last health message."""
        names, values = list(self._labels), list(self._labels.values())
        info = InfoMetricFamily("armident_capture", "Cell and robot that are recorded", labels=names)
        info.add_metric(values, {})
        yield info
        for name, value in self.health.items():
            if isinstance(value, str) or value is None:
                continue
            if name in COUNTERS:
                counter = CounterMetricFamily(f"armident_{name}", COUNTERS[name], labels=names)
                counter.add_metric(values, value)
                yield counter
            else:
                gauge = GaugeMetricFamily(f"armident_{name}", name.replace("_", " "), labels=names)
                gauge.add_metric(values, value)
                yield gauge
