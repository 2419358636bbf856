"""Tests that need a virtual bus, run by a second pytest in a guest kernel and reported by the first."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from armident.configs import ConfigError
from armident.drivers.vcan import ensure_vcan, launcher_command, remove_vcan
from armident.testing import REPORTS_VARIABLE, needs_bus

TAIL_LINES = 15
"""Lines of the guest's output in the report of a test that the guest did not report."""


def can_make_buses() -> bool:
    """Return True if this process may create vcan interfaces on this kernel."""
    name = f"vb{os.getpid() % 1_000_000}p"
    try:
        ensure_vcan(name)
        remove_vcan(name)
    except ConfigError:
        return False
    return True


class ReportWriter:
    """Plug-in of the pytest in the guest: appends each report as a line of JSON to a file."""

    def __init__(self, config: pytest.Config, file: Path) -> None:
        self._config, self._file = config, file

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Append the report of a phase of a test."""
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(data, default=str) + "\n")


class GuestRun:
    """Reports of the tests that run in a guest; it is booted when the first of them is due."""

    def __init__(self) -> None:
        self._reports: dict[str, list[Any]] = {}
        self._done: set[str] = set()
        self._output = ""

    def report(self, item: pytest.Item, nextitem: pytest.Item | None) -> None:
        """Report a test as if it had run here."""
        if item.nodeid not in self._done:
            # A worker of pytest-xdist knows all tests, but runs only a part of them.
            alone = hasattr(item.config, "workerinput")
            self._run([item] if alone else [each for each in item.session.items if needs_bus(each)], item.config)
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for data in self._reports.get(item.nodeid) or [None]:
            item.ihook.pytest_runtest_logreport(report=self._restored(data, item))
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        # Fixtures of former tests that the next one does not share end now, as after a test that ran here.
        item.session._setupstate.teardown_exact(nextitem)

    def _restored(self, data: Any, item: pytest.Item) -> pytest.TestReport:
        if data is not None:
            report: Any = item.config.hook.pytest_report_from_serializable(config=item.config, data=data)
            report.location = item.location
            if isinstance(report.longrepr, list):  # file, line and reason of a skip; JSON has no tuples
                report.longrepr = tuple(report.longrepr)
            assert isinstance(report, pytest.TestReport)
            return report
        tail = "\n".join(self._output.splitlines()[-TAIL_LINES:])
        message = f"the guest ended before it reported this test:\n{tail}"
        return pytest.TestReport(item.nodeid, item.location, {}, "failed", message, "call")

    def _run(self, items: Sequence[pytest.Item], config: pytest.Config) -> None:
        """Run tests in a guest and keep their reports."""
        terminal: Any = config.pluginmanager.get_plugin("terminalreporter")
        if terminal is not None and not hasattr(config, "workerinput"):
            terminal.ensure_newline()
            terminal.write_line(f"armident: a guest kernel runs {len(items)} test(s) with a virtual CAN bus")
        with tempfile.TemporaryDirectory(prefix="armident-tests-") as name:
            folder = Path(name)
            reports, output = folder / "reports", folder / "output"
            reports.touch()
            tests = [f"{item.path}::{item.nodeid.split('::', 1)[1]}" for item in items]
            (folder / "tests").write_text("\n".join(tests), encoding="utf-8")
            command = launcher_command([sys.executable, "-m", "pytest", *_options(config, folder)])
            command.insert(command.index("--"), "--guest")
            with output.open("wb") as stream:
                subprocess.run(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=stream,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, REPORTS_VARIABLE: str(reports)},
                    check=False,
                )
            self._output = output.read_text(encoding="utf-8", errors="replace")
            for line in reports.read_text(encoding="utf-8").splitlines():
                data = json.loads(line)
                self._reports.setdefault(data["nodeid"], []).append(data)
        self._done |= {item.nodeid for item in items}


def _options(config: pytest.Config, folder: Path) -> list[str]:
    """Command line of the second run: options of the first, its tests, and no second report, cache or processes."""
    places = set(config.args)
    words = [str(word) for word in config.invocation_params.args if str(word) not in places]
    words += ["--rootdir", str(config.rootpath), "-o", f"cache_dir={folder / 'cache'}"]
    if config.inipath is not None:
        words += ["-c", str(config.inipath)]
    if config.option.basetemp:
        words += ["--basetemp", f"{config.option.basetemp}-guest"]
    if config.pluginmanager.hasplugin("xdist"):
        words += ["-n0"]
    if config.pluginmanager.hasplugin("_cov") or config.pluginmanager.hasplugin("pytest_cov"):
        words += ["--no-cov"]
    return [*words, f"@{folder / 'tests'}"]
