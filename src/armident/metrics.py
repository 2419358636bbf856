"""Metrics for Prometheus: an endpoint over HTTP for services, and a text file for jobs that end."""

import importlib.metadata
import logging
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from prometheus_client import CollectorRegistry, start_http_server, write_to_textfile
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from armident.configs.errors import ConfigError

log = logging.getLogger(__name__)

Value = float | str | Mapping[tuple[str, ...], float] | None
"""Number of a metric, or numbers by the values of labels; texts, ``None`` and NaN are left out."""
Values = Mapping[str, Value]
"""Values by the keys of the families."""
COMMON = ("cell", "robot")
"""Labels of every metric."""


@dataclass(frozen=True)
class Family:
    """A metric without ``armident_PROGRAM_`` and, of a counter, ``_total``; ``labels``: those beside `COMMON`.

    ``key``: of its values; ``scale``: factor from their unit to that of the metric.
    """

    key: str
    name: str
    help: str
    labels: tuple[str, ...] = ()
    kind: Literal["counter", "gauge"] = "gauge"
    scale: float = 1.0


INFO = Family("version", "info", "Always 1, with the version of armident.", ("version",))
UPDATED = Family("time_s", "updated_timestamp_seconds", "Time of these values.")
"""Families of every program; `INFO` has its value by itself."""
_VERSION: Value = {(importlib.metadata.version("armident"),): 1.0}


@dataclass(frozen=True)
class Metrics:
    """Metrics of a program."""

    program: str
    families: tuple[Family, ...]

    def filled(self, common: tuple[str, str], values: Values) -> Iterator[Metric]:
        """Yield the metrics that have values; ``common``: those of the labels `COMMON`."""
        for family in self.families:
            value = _VERSION if family is INFO else values.get(family.key)
            series = {(): value} if isinstance(value, int | float) else value
            if not isinstance(series, Mapping):
                continue
            kind = CounterMetricFamily if family.kind == "counter" else GaugeMetricFamily
            name, labels = f"armident_{self.program}_{family.name}", [*COMMON, *family.labels]
            metric = kind(name, family.help, labels=labels)
            for of, number in series.items():
                if math.isfinite(number):
                    metric.add_metric([*common, *of], number * family.scale)
            if metric.samples:
                yield metric

    def write(self, path: Path, common: tuple[str, str], values: Values) -> None:
        """Replace a file as a whole by the metrics; raises OSError if it cannot be written."""
        write_to_textfile(str(path), _Served(self, common, values).registry)


class _Served(Collector):
    """Metrics with their last values, in a registry of their own."""

    def __init__(self, metrics: Metrics, common: tuple[str, str], values: Values | None = None) -> None:
        self.values = values or {}
        self._metrics, self._common = metrics, common
        self.registry = CollectorRegistry()
        self.registry.register(self)

    def collect(self) -> Iterator[Metric]:
        return self._metrics.filled(self._common, self.values)


class MetricsEndpoint:
    """Serves the last values of the metrics of a program over HTTP, to be read only; port 0 takes a free one.

    Raises ConfigError if it cannot listen.
    """

    def __init__(self, metrics: Metrics, common: tuple[str, str], address: str, port: int) -> None:
        self._served = _Served(metrics, common)
        try:
            self._server, self._thread = start_http_server(port, address, self._served.registry)
        except OSError as error:
            raise ConfigError(f"metrics: cannot listen on {address}:{port}: {error.strerror}") from error
        self.url = f"http://{address}:{int(self._server.server_port)}/metrics"
        """Address of the metrics."""
        log.info("metrics on %s", self.url)

    def update(self, values: Values) -> None:
        """Replace the served values."""
        self._served.values = values

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def check_file(path: Path) -> None:
    """Raise ConfigError unless the textfile collector of node_exporter reads the name, and it can be written."""
    folder = path.absolute().parent
    if path.suffix != ".prom":
        raise ConfigError(f"--metrics {path}: the name must end in .prom; the textfile collector reads no others")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"--metrics {path}: there is no folder {folder}, or no permission to write in it")
