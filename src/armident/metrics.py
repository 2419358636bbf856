"""Metrics for Prometheus: an endpoint over HTTP for services, and a text file for jobs that end."""

import importlib.metadata
import logging
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from prometheus_client import CollectorRegistry, start_http_server, write_to_textfile
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from armident.configs.errors import ConfigError

log = logging.getLogger(__name__)

Value = float | str | Mapping[tuple[str, ...], float] | None
"""Number of a metric, or numbers by the values of labels; texts, ``None`` and NaN are left out."""
COMMON = ("cell", "robot")
"""Labels of every metric."""


@dataclass(frozen=True)
class Family:
    """A metric: name without ``armident_PROGRAM_``, and its ``labels`` beside `COMMON`. ``_total`` makes it a counter.

    ``key``: of its values; ``scale``: factor from their unit to that of the metric.
    """

    key: str
    name: str
    help: str
    labels: tuple[str, ...] = ()
    scale: float = 1.0


INFO = Family("version", "info", "Always 1, with the version of armident.", ("version",))
UPDATED = Family("time_s", "updated_timestamp_seconds", "Time at which the values were read.")
"""Families of every program; `INFO` has its value by itself."""
CERTIFICATES = Family(
    "certificate_ends", "certificate_expiry_timestamp_seconds", "Time at which a certificate ends.", ("certificate",)
)
"""Family of the programs that sign."""
_VERSION: Value = {(importlib.metadata.version("armident"),): 1.0}


@dataclass(frozen=True)
class Metrics:
    """Metrics of a program, as ``capture``."""

    program: str
    families: tuple[Family, ...]


class MetricsExporter(Collector):
    """Exports ``values``, which may be replaced at any time, to be read only; ``common``: those of `COMMON`."""

    def __init__(self, metrics: Metrics, common: tuple[str, str]) -> None:
        self.values: Mapping[str, Value] = {}
        self._metrics, self._common = metrics, common
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics that have values."""
        values = self.values
        for family in self._metrics.families:
            value = _VERSION if family is INFO else values.get(family.key)
            series = {(): value} if isinstance(value, int | float) else value
            if isinstance(series, Mapping):
                kind = CounterMetricFamily if family.name.endswith("_total") else GaugeMetricFamily
                name = f"armident_{self._metrics.program}_{family.name}"
                metric = kind(name, family.help, labels=[*COMMON, *family.labels])
                for labels, number in series.items():
                    if math.isfinite(number):
                        metric.add_metric([*self._common, *labels], number * family.scale)
                if metric.samples:
                    yield metric

    def serve(self, address: str, port: int) -> Self:
        """Serve the metrics over HTTP; port 0 takes a free one. Raises ConfigError if it cannot listen."""
        try:
            self._server, self._thread = start_http_server(port, address, self._registry)
        except OSError as error:
            raise ConfigError(f"metrics: cannot listen on {address}:{port}: {error.strerror}") from error
        self.url = f"http://{address}:{int(self._server.server_port)}/metrics"
        log.info("metrics on %s", self.url)
        return self

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def write(self, path: Path) -> None:
        """Replace a file as a whole by the metrics; raises OSError if it cannot be written."""
        write_to_textfile(str(path), self._registry)


def check_file(path: Path) -> None:
    """Raise ConfigError unless the textfile collector of node_exporter reads the name, and it can be written."""
    folder = path.absolute().parent
    if path.suffix != ".prom":
        raise ConfigError(f"--metrics {path}: the name must end in .prom; the textfile collector reads no others")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"--metrics {path}: there is no folder {folder}, or no permission to write in it")
