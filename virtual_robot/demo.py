"""``armident demo``: capture, identification and diagnosis of a virtual arm on one machine, by the real processes."""

import json
import logging
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, MutableMapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NoReturn

import yaml

from armident.configs import ArmidentError, ConfigError, SessionConfig, load_session
from armident.drivers.vcan import ensure_vcan, have_socketcan, launcher_command, launcher_obstacle
from armident.processes import CommandProcess, ProcessEnded, ProcessTimeout, start_command
from armident.virtual_robot.twin import at_period

CELL = "tx40_cell.yaml"
SCENARIO = "scenarios/tx40_worn_joint2.yaml"
GUEST_VARIABLE = "ARMIDENT_GUEST"
REPEATS = 3
"""Number of runs of the trajectory in the second part: one run is too short for the small hidden effect."""
UDP_GROUP = "239.74.163.2"
"""Multicast address of the bus without SocketCAN."""
UDP_PERIOD_US = 2000
"""SYNC period on UDP multicast, us."""
SLOW_PERIOD_US = 1000
"""SYNC period on a machine that cannot run arm, bus, capture and worker at 5 kHz, us."""
MAX_LOST_SHARE = 0.02
"""Largest fraction of lost samples before the recording is repeated at the lower rate."""
HEARTBEAT_MS = 1000
"""Heartbeat period, ms: long, because drives and master share this machine."""
READY_S = 120.0
"""Time limit of the start of a process, s; the first compilation of its loops takes most of it."""
PART_S = 300.0
"""Time limit of a process after its start, s."""
SHOWN_CHARACTERS = 160
"""Maximum length of a process's output line that is passed on."""
PATIENT, URGENT = 19, -10
"""Nice values of the worker, and of the virtual arm if permitted: all processes share one CPU in the guest."""
_PART = re.compile(r"<!-- chapter begins -->(.*?)<!-- chapter ends -->", re.DOTALL)


class _ElapsedTime(logging.LoggerAdapter[logging.Logger]):
    """Logger that puts the time since the start of the demo before each message."""

    begin = time.monotonic()

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, MutableMapping[str, Any]]:
        """Add the elapsed time to a message.

        Parameters
        ----------
        msg
            The message.
        kwargs
            Keyword arguments of the logging call, which are returned unchanged.
        """
        return f"[{time.monotonic() - self.begin:5.1f} s] {msg}", kwargs


log = _ElapsedTime(logging.getLogger(__name__), {})


def demo(*, out: Path, keep_going: bool = False, quick: bool = False) -> None:
    """Run both parts and write the report.

    Parameters
    ----------
    out
        Directory of recordings, results and the report.
    keep_going
        Leave the virtual arm running on its bus until Ctrl-C.
    quick
        Only the first part: capture and identification.

    Raises
    ------
    ConfigError
        If the bus cannot be set up.
    ArmidentError
        If a process fails; contains its name and the end of its output.
    """
    session = _session_for_this_machine(out, keep_going, quick)
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    log.begin = time.monotonic()
    first, session = _identify_part(session, out)
    second = None if quick else _diagnose_part(session, out)
    report = _write_report(out, first, second)
    _print_table(first, second)
    if keep_going:
        with ExitStack() as stack:
            robot = _start_robot(_write_session(session, out, "running"), out, stack)
            log.info(f"the virtual arm keeps running until Ctrl-C; the report is {report}")
            robot.process.wait()
    _print_next_steps(report)


@dataclass(frozen=True)
class Identified:
    """Results of the first part.

    Parameters
    ----------
    document
        Content of ``identification.json``.
    report
        Report of the identification.
    truth
        Parameters of the virtual arm by name.
    lost
        Number of lost samples.
    """

    document: dict[str, Any]
    report: Path
    truth: dict[str, float]
    lost: int


@dataclass(frozen=True)
class Recorded:
    """Result of a capture.

    Parameters
    ----------
    path
        The recording.
    lost, lost_share
        Number and fraction of the samples in gaps.
    """

    path: Path
    lost: int
    lost_share: float


@dataclass(frozen=True)
class Diagnosed:
    """Results of the second part.

    Parameters
    ----------
    document
        Content of ``diagnosis.json``.
    report
        Report of the diagnosis.
    """

    document: dict[str, Any]
    report: Path


def _session_for_this_machine(out: Path, keep_going: bool, quick: bool) -> SessionConfig:
    """Session of the demo on the best available bus; without SocketCAN the demo is restarted in a guest."""
    session = load_session(CELL).model_copy(update={"heartbeat_ms": HEARTBEAT_MS})
    if have_socketcan():
        ensure_vcan(session.bus.channel)
        return session
    reason = "the guest has no SocketCAN" if os.environ.get(GUEST_VARIABLE) else launcher_obstacle()
    if reason is None:
        log.logger.info("this kernel has no SocketCAN: the demo runs under a User-Mode Linux guest")
        _restart_in_guest(out, keep_going, quick)
    log.logger.info(f"no vcan on this machine ({reason}): using udp_multicast at a lower rate, which may lose frames")
    bus = session.bus.model_copy(update={"interface": "udp_multicast", "channel": UDP_GROUP})
    sync = session.sync.model_copy(update={"period_us": UDP_PERIOD_US})
    return session.model_copy(update={"bus": bus, "sync": sync})


def _restart_in_guest(out: Path, keep_going: bool, quick: bool) -> NoReturn:
    options = ["--keep-going"] * keep_going + ["--quick"] * quick
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    if out.is_relative_to(Path.cwd()) or out.is_relative_to("/tmp"):
        command = launcher_command([*_armident(), "demo", "--out", str(out), *options])
        raise SystemExit(subprocess.run(command, check=False).returncode)
    raise ConfigError(
        f"--out {out}: expected a folder below the working directory or /tmp, the guest writes nowhere else"
    )


def _armident() -> list[str]:
    return [sys.executable, "-m", "armident.daq.cli"]


def _identify_part(session: SessionConfig, out: Path) -> tuple[Identified, SessionConfig]:
    """Record and identify, at a lower rate if this machine cannot keep up; return the session in use, too."""
    log.info(f"part 1: record a virtual TX40 at {_rate(session)} and identify its dynamic model")
    truth_file = out / "truth.json"
    while True:
        # The worker waits for the recording that follows; those of earlier attempts and runs are not its work.
        for path in out.glob("worker.sqlite*"):
            path.unlink()
        session = session.model_copy(update={"recording": session.recording.model_copy(update={"directory": out})})
        config = _write_session(session, out, "cell")
        options = ["--config", str(config), "--once", "--out", str(out)]
        with _running("worker", ["worker", *options], out, "worker: ready", PATIENT) as worker:
            log.info("worker: ready")
            recorded = _record("capture", config, out, ["--truth", str(truth_file)])
            slower = _slower(session)
            if recorded.lost_share > MAX_LOST_SHARE and slower is not None:
                log.info(
                    f"this machine is too busy for {_rate(session)}: {100 * recorded.lost_share:.0f} % of the samples "
                    f"were late or lost; recording again at {_rate(slower)}"
                )
                session = slower
                continue
            worker.wait(PART_S)
            output = worker.output()
        break
    result, report = _line_after(output, "result: ", worker.name), _line_after(output, "report: ", worker.name)
    document = json.loads(Path(result).read_text(encoding="utf-8"))
    essential = sum(1 for p in document["parameters"] if p["essential"])
    error = document["relative_error_pct"]
    log.info(f"identified: {essential} essential parameters, relative torque error {error:.1f} %")
    truth = json.loads(truth_file.read_text(encoding="utf-8"))
    return Identified(document, Path(report), truth, recorded.lost), session


def _diagnose_part(session: SessionConfig, out: Path) -> Diagnosed:
    """Record the arm with a hidden effect and diagnose it."""
    log.info("part 2: record the same arm with a hidden effect, and let the diagnosis find the effect")
    if session.setpoints is not None:
        session = session.model_copy(update={"setpoints": session.setpoints.model_copy(update={"repeat": REPEATS})})
    config = _write_session(session, out, "cell_worn")
    recorded = _record("capture_worn", config, out, ["--scenario", SCENARIO])
    log.info("diagnosing")
    folder = out / "diagnosis"
    with _running("diagnose", ["diagnose", str(recorded.path), "--out", str(folder), "--json"], out) as diagnosis:
        diagnosis.wait(PART_S, accepted=(0, 4))
    document = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    for finding in document["findings"]:
        log.info(
            f"found: {finding['effect'].replace('_', ' ')} in {finding['joint']}; its torque error on held-out data "
            f"{finding['gap_before']:.2f} % -> {finding['gap_after']:.2f} %"
        )
    if not document["findings"]:
        log.info(f"nothing found: verdict {document['verdict']}")
    return Diagnosed(document, folder / "report.html")


def _record(name: str, config: Path, out: Path, robot_options: Sequence[str]) -> Recorded:
    """Start the virtual arm, capture it to the end of its trajectory, and stop it."""
    with ExitStack() as stack:
        _start_robot(config, out, stack, robot_options)
        options = ["--config", str(config), "--out", str(out / "recordings"), "--json"]
        capture = stack.enter_context(_running(name, ["capture", *options], out))
        # A late heartbeat ends a capture with exit code 1; on a busy machine this counts as lost samples.
        capture.wait(PART_S, accepted=(0, 1))
        lines = capture.output().splitlines()
        result = next((json.loads(line) for line in lines if line.startswith('{"recording"')), None)
        if result is None or (capture.exit_code and not result["counters"]["samples.in_gaps"]):
            raise capture.failure(f"ended with exit code {capture.exit_code}")
    counters = result["counters"]
    got, lost = counters["samples.rows"], counters["samples.in_gaps"]
    return Recorded(Path(result["recording"]), lost, lost / max(got + lost, 1))


def _slower(session: SessionConfig) -> SessionConfig | None:
    """Session at the demo's lower rate, with set points on every SYNC; ``None`` if it is that slow already."""
    if session.sync.period_us >= SLOW_PERIOD_US:
        return None
    return at_period(session, SLOW_PERIOD_US)


def _rate(session: SessionConfig) -> str:
    return f"{1 / session.sync_period:.0f} Hz"


def _start_robot(config: Path, out: Path, stack: ExitStack, options: Sequence[str] = ()) -> "_DemoProcess":
    niceness = URGENT if os.geteuid() == 0 else 0
    robot = stack.enter_context(_running("robot", ["robot", "--config", str(config), *options], out, "ready", niceness))
    log.info(f"robot: {robot.output().strip().splitlines()[-1]}")
    return robot


def _write_session(session: SessionConfig, out: Path, name: str) -> Path:
    """Write a session file with absolute paths."""
    path = out / f"{name}.yaml"
    path.write_text(yaml.safe_dump(session.model_dump(mode="json", by_alias=True), sort_keys=False), encoding="utf-8")
    return path


class _DemoProcess(CommandProcess):
    """Command of the demo with its output in ``logs/NAME.log``."""

    def __init__(self, name: str, words: Sequence[str], out: Path, niceness: int) -> None:
        start = partial(start_command, niceness=niceness)
        file = out / "logs" / f"{name}.log"
        file.unlink(missing_ok=True)
        super().__init__(words, name=name, log=file, merge=True, start=start)

    def wait(self, seconds: float, accepted: Sequence[int] = (0,)) -> None:
        """Wait for the end and log the lines that the process prints in the meantime.

        Parameters
        ----------
        seconds
            Longest time to wait, s.
        accepted
            Exit codes of success.

        Raises
        ------
        ArmidentError
            If it takes longer, or ends with another exit code.
        """
        until = time.monotonic() + seconds
        while True:
            try:
                line = self.wait_for_line("", max(until - time.monotonic(), 0.0))
            except ProcessEnded:
                break
            except ProcessTimeout:
                raise self.failure(f"did not end within {seconds:.0f} s") from None
            if not line.startswith(("{", " ", "}")) and len(line) < SHOWN_CHARACTERS:
                log.info(f"{self.name}: {line.removeprefix(self.name + ': ')}")
        if self.exit_code not in accepted:
            raise self.failure(f"ended with exit code {self.exit_code}")


@contextmanager
def _running(
    name: str, words: Sequence[str], out: Path, ready: str | None = None, niceness: int = 0
) -> Iterator[_DemoProcess]:
    with _DemoProcess(name, words, out, niceness) as process:
        if ready is not None:
            process.wait_for_line(ready, READY_S)
        yield process


def _line_after(text: str, start: str, who: str) -> str:
    for line in text.splitlines():
        if line.startswith(start):
            return line.removeprefix(start).strip()
    raise ArmidentError(f"demo: the output of {who} has no line {start.strip()!r}")


def _write_report(out: Path, first: Identified, second: Diagnosed | None) -> Path:
    """Join the reports of both parts to one page."""
    page = first.report.read_text(encoding="utf-8")
    parts = [_part(page)] + ([] if second is None else [_part(second.report.read_text(encoding="utf-8"))])
    head = page[: page.index("<!-- chapter begins -->")]
    tail = page[page.index("<!-- chapter ends -->") :].removeprefix("<!-- chapter ends -->")
    path = out / "report.html"
    handle, temporary = tempfile.mkstemp(dir=out, prefix=".report.")
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(head + _SUMMARY.substitute(_summary(first, second)))
        file.write("".join(f'<section style="margin-top:56px">{part}</section>' for part in parts) + tail)
    os.chmod(temporary, 0o644)
    os.replace(temporary, path)
    return path


def _part(page: str) -> str:
    found = _PART.search(page)
    if found is None:
        raise ArmidentError("demo: a report has no section between the marks of its beginning and end")
    return found.group(1)


_SUMMARY = Template("""
<h1>armident: results of the demo</h1>
<p class="sub">The Staubli TX40, its drives and its bus are virtual; all other processes are those of a real cell.</p>
<ol>
<li>The six drives were configured over CANopen and recorded at $rate samples per second: $rows samples of each of
$joints joints, $gaps lost.</li>
<li>A worker received the samples on Zenoh and identified the dynamic model. It has $essential essential parameters and
predicts the torques with a relative error of $error %. Of $compared parameters with a known true value, $close lie
within three standard deviations of it (largest deviation: $worst).</li>
$second
</ol>
""")


def _summary(first: Identified, second: Diagnosed | None) -> dict[str, str]:
    document = first.document
    compared = _against_truth(first)
    worst = max(compared, key=lambda row: abs(row[4]), default=None)
    line = ""
    if second is not None:
        found = second.document["findings"]
        names = ", ".join(f"{f['effect'].replace('_', ' ')} in {f['joint']}" for f in found) or "nothing"
        gap = second.document["gap"]["validation"]
        line = (
            f"<li>Then an effect was hidden in the arm, unknown to the diagnosis. The diagnosis found: "
            f"<b>{escape(names)}</b>. On held-out data the relative torque error decreased from "
            f"{gap['before']['all']:.2f} % to {gap['after']['all']:.2f} %; "
            f"the noise floor is {second.document['noise_floor']['all']:.2f} %.</li>"
        )
    counters = {} if worst is None else {"worst": f"{worst[0]}, {abs(worst[4]):.1f}"}
    return {
        "rate": f"{document['recording']['sample_rate_hz']:.0f}",
        "rows": str(document["recording"]["samples"]),
        "joints": str(len(document["relative_error_pct_by_joint"])),
        "gaps": str(first.lost or "none"),
        "essential": str(sum(1 for p in document["parameters"] if p["essential"])),
        "error": f"{document['relative_error_pct']:.1f}",
        "close": str(sum(1 for row in compared if abs(row[4]) <= 3)),
        "compared": str(len(compared)),
        "worst": "none",
        "second": line,
        **counters,
    }


def _against_truth(first: Identified) -> list[tuple[str, float, float, float, float]]:
    """Essential parameters: name, value, standard deviation, true value, and deviation in standard deviations."""
    return [
        (p["name"], p["value"], p["std"], first.truth[p["name"]], (p["value"] - first.truth[p["name"]]) / p["std"])
        for p in first.document["parameters"]
        if p["essential"] and p["name"] in first.truth and p["std"] > 0
    ]


def _print_table(first: Identified, second: Diagnosed | None) -> None:
    print(f"\n{'parameter':>10} {'identified':>11} {'+- std':>9} {'true':>9} {'off by':>9}")
    for name, value, std, truth, distance in _against_truth(first):
        print(f"{name:>10} {value:11.4f} {std:9.4f} {truth:9.4f} {distance:5.1f} std")
    if second is not None:
        gap = second.document["gap"]["validation"]
        print(f"\nhidden effect: {second.document['verdict'].replace('_', ' ')}")
        for f in second.document["findings"]:
            print(
                f"  {f['effect']} in {f['joint']}: {f['gap_before']:.2f} % -> {f['gap_after']:.2f} % on held-out data"
            )
        print(f"  all joints: {gap['before']['all']:.2f} % -> {gap['after']['all']:.2f} %")


def _print_next_steps(report: Path) -> None:
    """Print the path of the report and the commands for a user's own robot."""
    print(
        "\nnext, with measurements of your own robot (or on its bus: armident capture --config CELL.yaml):\n"
        "  armident import DATA.csv --config ROBOT.yaml --out my_robot.mcap\n"
        "  armident identify my_robot.mcap --out results\n"
        f"report: {report}",
        flush=True,
    )
