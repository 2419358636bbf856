"""Units and cron lines shipped with armident: systemd accepts them, and their commands exist."""

import re
import shlex
import shutil
import subprocess
from configparser import ConfigParser
from pathlib import Path

import pytest
import typer.main
from typer.core import TyperGroup

from armident.configs import SessionConfig
from armident.configs.loading import HERE
from armident.daq.cli import application
from armident.daq.service import LONGEST_STOP_S
from armident.identify.monitoring.change.history_schema import BUSY_S
from armident.identify.monitoring.reidentify.keep import RETRY_S
from armident.identify.monitoring.reidentify.run import DIAGNOSIS_S

UNITS = sorted(path for path in (HERE / "systemd").iterdir() if path.suffix in (".service", ".timer"))
SERVICES = [path for path in UNITS if path.suffix == ".service"]
CRON = HERE / "cron" / "armident-reidentify.cron"


class Unit(ConfigParser):
    """Parser of a unit file, in which keys may repeat and keep their case."""

    def optionxform(self, optionstr: str) -> str:
        return optionstr

    def __init__(self, path: Path) -> None:
        super().__init__(interpolation=None, strict=False, delimiters=("=",), comment_prefixes=("#", ";"))
        # Every value of a key that repeats counts.
        seen: dict[str, int] = {}
        lines = []
        for line in path.read_text(encoding="utf-8").splitlines():
            key = line.partition("=")[0]
            if "=" in line and not line.startswith("#"):
                seen[key] = seen.get(key, 0) + 1
                line = line.replace(key, f"{key}#{seen[key]}" if seen[key] > 1 else key, 1)
            lines.append(line)
        self.read_string("\n".join(lines))


def accepted(words: list[str]) -> None:
    """Parse a command line as the program would, without running it."""
    group = typer.main.get_command(application(words))
    assert isinstance(group, TyperGroup)
    command = group.commands[words[0]]
    command.make_context(words[0], words[1:])


def commands(path: Path) -> list[list[str]]:
    unit = Unit(path)
    lines = [value for key, value in unit["Service"].items() if key.startswith("ExecStart")]
    return [shlex.split(line.lstrip("+-!").replace("%i", "cell"))[1:] for line in lines]


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_systemd_takes_every_unit(path: Path, tmp_path: Path) -> None:
    """Verified by systemd where it is installed; sections and keys are read in any case."""
    unit = Unit(path)
    wanted = {".service": ["Unit", "Service"], ".timer": ["Unit", "Timer", "Install"]}[path.suffix]
    assert unit.sections()[: len(wanted)] == wanted
    if shutil.which("systemd-analyze") is None:
        return
    for each in UNITS:
        text = re.sub(r"/opt/armident/bin/armident", "/bin/true", each.read_text(encoding="utf-8"))
        (tmp_path / each.name.replace("@.", "@cell.")).write_text(text)
    name = tmp_path / path.name.replace("@.", "@cell.")
    done = subprocess.run(["systemd-analyze", "verify", "--man=no", str(name)], capture_output=True, text=True)
    complaints = [line for line in done.stderr.splitlines() if str(tmp_path) in line or "armident" in line]
    assert done.returncode == 0, done.stderr
    assert complaints == []


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_commands_of_units_exist(path: Path) -> None:
    found = commands(path)
    assert found
    for words in found:
        accepted(words)


def values(path: Path, name: str) -> list[str]:
    """Values of a key of ``[Service]`` that may repeat."""
    return [value for key, value in Unit(path)["Service"].items() if key.partition("#")[0] == name]


def gigabytes(size: str) -> float:
    return float(size[:-1]) / {"G": 1.0, "M": 1024.0}[size[-1]]


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_services_are_bounded_in_memory_system_calls_and_network(path: Path) -> None:
    (most,) = values(path, "MemoryMax")
    assert all(gigabytes(high) < gigabytes(most) for high in values(path, "MemoryHigh"))
    assert values(path, "SystemCallFilter")[0].split()[0] == "@system-service"
    assert values(path, "SystemCallErrorNumber") == ["EPERM"]
    assert values(path, "IPAddressDeny") == ["any"]
    assert values(path, "IPAddressAllow") == ["localhost"]


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_a_service_loads_no_code_that_another_one_has_compiled(path: Path) -> None:
    """The worker reads files of strangers; capture and job have capabilities."""
    (name,) = re.findall("armident-([a-z]+)[@.]", path.name)
    assert values(path, "CacheDirectory") == [f"armident/{name}"]
    assert f"XDG_CACHE_HOME=/var/cache/armident/{name}" in values(path, "Environment")


@pytest.mark.parametrize("name", ["capture", "worker"])
def test_a_service_is_started_again_for_months(name: str) -> None:
    """A bus that is down at boot ends doctor, and so a start; five in 300 s were the last ones."""
    unit = Unit(HERE / "systemd" / f"armident-{name}@.service")
    assert unit["Unit"]["StartLimitIntervalSec"] == "0"
    assert unit["Service"]["Restart"] == "on-failure"
    assert unit["Service"]["RestartSec"] == "10"


def test_limits_of_time_match_those_of_the_programs() -> None:
    def longest(name: str) -> float:
        return float(next(bound.le for bound in SessionConfig.model_fields[name].metadata if hasattr(bound, "le")))

    (start,) = values(HERE / "systemd" / "armident-capture@.service", "TimeoutStartSec")
    assert float(start) > longest("boot_timeout_s")
    for path in SERVICES:
        (stop,) = values(path, "TimeoutStopSec")
        assert float(stop) < LONGEST_STOP_S
    (job,) = values(HERE / "systemd" / "armident-reidentify@.service", "TimeoutStartSec")
    assert 3600.0 * float(job.removesuffix("h")) > DIAGNOSIS_S + RETRY_S + 2 * BUSY_S


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_who_has_a_watchdog_notifies_it(path: Path) -> None:
    notifies = values(path, "Type") == ["notify"]
    assert notifies == (path.name != "armident-reidentify@.service")
    assert bool(values(path, "WatchdogSec")) == notifies
    assert values(path, "NotifyAccess") == (["main"] if notifies else [])


@pytest.mark.parametrize("name", ["capture", "reidentify", "worker"])
def test_a_service_may_read_the_state_of_the_clock_and_not_set_it(name: str) -> None:
    """``ProtectClock=`` and ``@system-service`` alone forbid adjtimex(2), which health and retention need."""
    path = HERE / "systemd" / f"armident-{name}@.service"
    assert values(path, "ProtectClock") == []
    # A later line adds to an earlier one, or takes away from it.
    assert values(path, "SystemCallFilter")[-1].endswith("adjtimex clock_adjtime")
    assert "CAP_SYS_TIME" not in values(path, "CapabilityBoundingSet")[0]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_systemd_calls_the_exposure_of_a_service_low(path: Path, tmp_path: Path) -> None:
    """At most 3.0 of 10 by ``systemd-analyze security``; a unit without sandbox has 9.6."""
    unit = tmp_path / path.name.replace("@.", "@cell.")
    unit.write_text(path.read_text(encoding="utf-8").replace("/opt/armident/bin/armident", "/bin/true"))
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=30", "--no-pager", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout.splitlines()[-1:] + done.stderr.splitlines()


def test_the_timer_runs_its_service_weekly_and_catches_up_no_missed_run() -> None:
    """An arm must not move because a machine was switched on."""
    timer = Unit(HERE / "systemd" / "armident-reidentify@.timer")["Timer"]
    assert timer["OnCalendar"].startswith("Sun ")
    assert timer["Persistent"] == "false"
    assert (HERE / "systemd" / "armident-reidentify@.service").is_file()


def test_the_job_may_end_a_capture_and_use_real_time_priority() -> None:
    service = Unit(HERE / "systemd" / "armident-reidentify@.service")
    assert service["Unit"]["Conflicts"] == "armident-capture@%i.service"
    assert service["Service"]["Type"] == "oneshot"
    assert "RestrictRealtime" not in service["Service"]
    assert "CAP_SYS_NICE" in service["Service"]["AmbientCapabilities"]


def test_the_cron_line_runs_the_same_command_weekly() -> None:
    (line,) = [line for line in CRON.read_text(encoding="utf-8").splitlines() if re.match(r"\d", line)]
    *when, user, program = line.split()[:7]
    assert when == ["0", "3", "*", "*", "0"]
    assert user == "armident"
    assert program == "/opt/armident/bin/armident"
    words = line.split()[7:]
    accepted(words)
    (unit,) = [words for words in commands(HERE / "systemd" / "armident-reidentify@.service") if "reidentify" in words]
    assert unit == [word.replace("CELL", "cell") for word in words]
    history = "ARMIDENT_HISTORY=sqlite:////var/lib/armident/CELL/history.sqlite"
    assert history in CRON.read_text(encoding="utf-8").splitlines()
    service = HERE / "systemd" / "armident-reidentify@.service"
    assert history.replace("CELL", "%i") in values(service, "Environment")
    assert values(service, "EnvironmentFile") == ["-/etc/armident/%i.env"]


def test_a_wrong_option_would_be_noticed() -> None:
    with pytest.raises(Exception, match="No such option"):
        accepted(["reidentify", "--bassline", "x"])
