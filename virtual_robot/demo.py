"""``armident demo``: capture, identification and investigation of a virtual arm on one machine, by real processes."""

import json
import logging
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, MutableMapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml

from armident.configs import (
    ArmidentError,
    ConfigError,
    RobotConfig,
    Scenario,
    SessionConfig,
    config_path,
    load_robot,
    load_scenario,
    load_session,
)
from armident.configs.schema.scenario import HiddenEffect
from armident.drivers.vcan import ensure_vcan, have_socketcan, launcher_command, launcher_obstacle
from armident.processes import CommandProcess, ProcessEnded, ProcessTimeout, start_command
from armident.virtual_robot.demo_report import (
    Identified,
    Investigated,
    print_next_steps,
    print_results,
    true_values,
    write_report,
)
from armident.virtual_robot.drawn_parameters import torque_scale
from armident.virtual_robot.effects import hidden_effects
from armident.virtual_robot.twin import (
    SHARED_HEARTBEAT_MS,
    STANDARD,
    ParameterChoice,
    Twin,
    at_period,
    load_twin,
    on_virtual_bus,
    write_twin,
)

CELL = "tx40_cell.yaml"
SCENARIO = "scenarios/tx40_cable.yaml"
VCAN = "vcan0"
"""Bus of a configured arm, in place of those of its session: real drives stay apart."""
WEAR = 0.3
"""Share by which the viscous friction of a worn bearing differs from its mean, in either direction."""
GUEST_VARIABLE = "ARMIDENT_GUEST"
UDP_GROUP = "239.74.163.2"
"""Multicast address of the bus without SocketCAN."""
UDP_PERIOD_US = 2000
"""SYNC period on UDP multicast, us."""
SLOW_PERIOD_US = 1000
"""SYNC period of the second part, and on a machine that cannot run arm, bus, capture and worker at 5 kHz, us."""
MAX_LOST_SHARE = 0.02
"""Largest fraction of lost samples before the recording is repeated at the lower rate."""
READY_S = 120.0
"""Time limit of the start of a process, s; the first compilation of its loops takes most of it."""
PART_S = 300.0
"""Time limit of a process after its start, s."""
SHOWN_CHARACTERS = 160
"""Maximum length of a process's output line that is passed on."""
PATIENT, URGENT = 19, -10
"""Nice values of the worker, and of the virtual arm if permitted: all processes share one CPU in the guest."""


class _ElapsedTime(logging.LoggerAdapter[logging.Logger]):
    """Logger that puts the time since the start of the demo before each message."""

    begin = time.monotonic()

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, MutableMapping[str, Any]]:
        """Add the elapsed time to a message."""
        return f"[{time.monotonic() - self.begin:5.1f} s] {msg}", kwargs


log = _ElapsedTime(logging.getLogger(__name__), {})


@dataclass(frozen=True)
class DemoOptions:
    """Options of ``armident demo``; ``quick``: first part only; ``keep_going``: leave the arm running until Ctrl-C."""

    out: Path
    keep_going: bool = False
    quick: bool = False
    config: Path | None = None
    scenario: Path | None = None
    choice: ParameterChoice = STANDARD

    def words(self) -> list[str]:
        """Return the options as words of a command line, with absolute paths."""
        words = ["--out", str(self.out.resolve())]
        for name, path in (("config", self.config), ("scenario", self.scenario), ("model", self.choice.model)):
            if path is not None:
                words += [f"--{name}", str(path.resolve() if path.exists() else path)]
        words += ["--arm-seed", str(self.choice.seed)]
        flags = {"keep-going": self.keep_going, "quick": self.quick, "draw-masses": self.choice.draw_masses}
        return words + [f"--{name}" for name, given in flags.items() if given]


@dataclass(frozen=True)
class Subject:
    """The arm of the demo, and the scenario of the second part."""

    session: SessionConfig
    robot: RobotConfig
    scenario: Path
    robot_options: tuple[str, ...] = ()

    def at(self, session: SessionConfig) -> "Subject":
        """Return the same arm in another session."""
        return replace(self, session=session)


def demo(options: DemoOptions) -> None:
    """Run both parts and write the report; raises ArmidentError, with the end of its output, if a process fails."""
    out = options.out.resolve()
    subject = _subject(options, out)
    subject = subject.at(_session_for_this_machine(subject.session, options))
    out.mkdir(parents=True, exist_ok=True)
    log.begin = time.monotonic()
    first, subject = _identify_part(subject, out)
    second = None if options.quick else _investigate_part(subject, out)
    report = write_report(out, subject.robot, first, second)
    print_results(first, second)
    if options.keep_going:
        with ExitStack() as stack:
            robot = _start_robot(_write_session(subject.session, out, "running"), out, stack, subject.robot_options)
            log.info(f"the virtual arm keeps running until Ctrl-C; the report is {report}")
            robot.process.wait()
    print_next_steps(report)


def _subject(options: DemoOptions, out: Path) -> Subject:
    """Return the arm of the demo; that of a configuration is written to ``out / "twin"``."""
    if options.config is None:
        session = load_session(CELL).model_copy(update={"heartbeat_ms": SHARED_HEARTBEAT_MS})
        return Subject(session, load_robot(session.robot), config_path(options.scenario or SCENARIO))
    twin = load_twin(options.config, options.choice)
    folder = out / "twin"
    session = on_virtual_bus(twin.session, VCAN, f"{twin.session.cell[:50]}_demo")
    session = load_session(write_twin(twin.with_session(session), folder))
    if session.setpoints is None:
        raise ConfigError(f"{options.config}: sync.role: the demo moves the arm, expected producer")
    if options.scenario is not None:
        scenario = config_path(options.scenario, listed=("scenarios",)).resolve()
        hidden_effects(load_scenario(scenario), twin.robot, str(scenario))
    else:
        scenario = _write_yaml(
            worn(twin).model_dump(mode="json", by_alias=True, exclude_none=True), folder / "worn.yaml"
        )
    if not os.environ.get(GUEST_VARIABLE):
        for line in (*twin.parameters.sources, *(f"assumed: {entry}" for entry in twin.assumed)):
            log.logger.info(line)
    # The written session has no masses: they come from the same source again.
    words = ["--arm-seed", str(options.choice.seed), *(["--draw-masses"] * options.choice.draw_masses)]
    if options.choice.model is not None:
        words += ["--model", str(options.choice.model.resolve())]
    return Subject(session, twin.robot, scenario, tuple(words))


def worn(twin: Twin) -> Scenario:
    """Scenario of a worn bearing: viscous friction depends on the direction, in the joint where there is most of it."""
    robot, standard = twin.robot, twin.parameters.standard
    scale = torque_scale(robot, standard).torque
    share = [standard[f"fv{j + 1}"] * joint.limits.velocity / scale[j] for j, joint in enumerate(robot.joints)]
    worst = int(np.argmax(share))
    joint, change = robot.joints[worst].name, {"fva": WEAR * standard[f"fv{worst + 1}"]}
    hidden = HiddenEffect(effect="asymmetric_viscous_friction", joint=joint, parameters=change)
    text = f"worn bearing in {joint}: its viscous friction depends on the direction"
    return Scenario(schema="armident/scenario/1", description=text, effects=(hidden,))


@dataclass(frozen=True)
class Recorded:
    """Result of a capture. ``lost``, ``lost_share``: number and fraction of the samples in gaps."""

    path: Path
    lost: int
    lost_share: float


def _session_for_this_machine(session: SessionConfig, options: DemoOptions) -> SessionConfig:
    """Session of the demo on the best available bus; without SocketCAN the demo is restarted in a guest."""
    if have_socketcan():
        ensure_vcan(session.bus.channel)
        return session
    reason = "the guest has no SocketCAN" if os.environ.get(GUEST_VARIABLE) else launcher_obstacle()
    if reason is None:
        log.logger.info("this kernel has no SocketCAN: the demo runs under a User-Mode Linux guest")
        _restart_in_guest(options)
    log.logger.info(f"no vcan on this machine ({reason}): using udp_multicast at a lower rate, which may lose frames")
    bus = session.bus.model_copy(update={"interface": "udp_multicast", "channel": UDP_GROUP})
    sync = session.sync.model_copy(update={"period_us": UDP_PERIOD_US})
    return session.model_copy(update={"bus": bus, "sync": sync})


def _restart_in_guest(options: DemoOptions) -> NoReturn:
    out = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    if out.is_relative_to(Path.cwd()) or out.is_relative_to("/tmp"):
        command = launcher_command([*_armident(), "demo", *options.words()])
        raise SystemExit(subprocess.run(command, check=False).returncode)
    raise ConfigError(
        f"--out {out}: expected a folder below the working directory or /tmp, the guest writes nowhere else"
    )


def _armident() -> list[str]:
    return [sys.executable, "-m", "armident.daq.cli"]


def _identify_part(subject: Subject, out: Path) -> tuple[Identified, Subject]:
    """Record and identify, at a lower rate if this machine cannot keep up; return the arm in its session, too."""
    session, robot = subject.session, subject.robot
    log.info(f"part 1: record a virtual {robot.name} at {_rate(session)} and identify its dynamic model")
    truth_file = out / "truth.json"
    while True:
        # The worker waits for the recording that follows, from the stream or in its file; those of earlier attempts and
        # runs are not its work.
        for path in out.glob("worker.sqlite*"):
            path.unlink()
        recordings = out / "recordings" / time.strftime("%Y%m%dT%H%M%S")
        update = {"recording": session.recording.model_copy(update={"directory": recordings})}
        config = _write_session(session.model_copy(update=update), out, "cell")
        options = ["--config", str(config), "--once", "--out", str(out)]
        with _running("worker", ["worker", *options], out, "worker: ready", PATIENT) as worker:
            log.info("worker: ready")
            robot_options = [*subject.robot_options, "--truth", str(truth_file)]
            recorded = _record("capture", config, out, recordings, robot_options)
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
    truth = true_values(document, json.loads(truth_file.read_text(encoding="utf-8")), robot)
    return Identified(document, Path(report), truth, recorded.lost), subject.at(session)


def _investigate_part(subject: Subject, out: Path) -> Investigated:
    """Record the arm with a hidden effect, and ask it for the motion that tells what it is."""
    # The investigation needs no high rate.
    session = _slower(subject.session) or subject.session
    log.info(f"part 2: record the same arm at {_rate(session)} with a hidden effect, which has to be found")
    config = _write_session(session, out, "cell_worn")
    hidden = [*subject.robot_options, "--scenario", str(subject.scenario)]
    recorded = _record("capture_worn", config, out, out / "recordings", hidden)
    folder = out / "investigation" / time.strftime("%Y%m%dT%H%M%S")
    program = shlex.join([*_armident(), "robot", "--config", str(config), *hidden, "--to-command"])
    words = ["investigate", str(recorded.path), "--robot-command", program, "--experiments", "1", "--yes"]
    log.info("what is hidden? The arm may be asked for one motion")
    with _running("investigate", [*words, "--out", str(folder), "--json"], out) as investigation:
        investigation.wait(PART_S, accepted=(0, 3, 4))
    document, diagnosis = (
        json.loads((folder / name).read_text(encoding="utf-8")) for name in ("investigation.json", "diagnosis.json")
    )
    for asked in document["rounds"]:
        log.info(f"asked: {asked['question']} {asked['chosen']['words']}, {asked['chosen']['duration_s']:.1f} s")
    log.info(f"{document['outcome'].replace('_', ' ')}: {document['statement']}")
    effects = load_scenario(subject.scenario).effects
    names = tuple(f"{effect.effect.replace('_', ' ')} in {effect.joint}" for effect in effects)
    return Investigated(document, diagnosis, folder / "report.html", names)


def _record(name: str, config: Path, out: Path, recordings: Path, robot_options: Sequence[str]) -> Recorded:
    """Start the virtual arm, capture it to the end of its trajectory, and stop it."""
    with ExitStack() as stack:
        _start_robot(config, out, stack, robot_options)
        options = ["--config", str(config), "--out", str(recordings), "--json"]
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
    return _write_yaml(session.model_dump(mode="json", by_alias=True), out / f"{name}.yaml")


def _write_yaml(content: dict[str, Any], path: Path) -> Path:
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


class _DemoProcess(CommandProcess):
    """Command of the demo with its output in ``logs/NAME.log``."""

    def __init__(self, name: str, words: Sequence[str], out: Path, niceness: int) -> None:
        start = partial(start_command, niceness=niceness)
        file = out / "logs" / f"{name}.log"
        file.unlink(missing_ok=True)
        super().__init__(words, name=name, log=file, merge=True, start=start)

    def wait(self, seconds: float, accepted: Sequence[int] = (0,)) -> None:
        """Wait for the end and log what the process prints; raises ArmidentError on other exit codes or time-out, s."""
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
