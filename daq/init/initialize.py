"""The command ``armident init``: writes robot and session, and says what was found, assumed, and is still missing."""

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armident.configs import ConfigError, RobotConfig, config_path, load_robot, load_session
from armident.configs.blanks import MARK, NEEDS, grouped, pattern
from armident.daq.init.dh_table import Convention, from_dh_table
from armident.daq.init.geometry import Geometry, from_library, from_urdf, of_axes
from armident.daq.init.recorded_facts import RecordedFacts, examine
from armident.daq.init.yaml_contents import CellFacts, robot_content, session_content
from armident.daq.init.yaml_text import Noted, yaml_text
from armident.daq.interchange.import_options import given
from armident.daq.interchange.importing import read_rows, table_rows
from armident.daq.interchange.readers import reader_of
from armident.daq.interchange.table_files import Source
from armident.daq.recording import is_recording


@dataclass(frozen=True)
class InitOptions:
    """Options of ``armident init``; the geometry is that of ``urdf``, ``robot``, ``dh``, or only a number of ``axes``.

    ``convention``: of the table ``dh``; ``None``: by its columns. ``base``, ``tip``: links of the chain in the URDF.
    ``stated``: options of `import_recording`. ``link_torques``: efforts are measured behind the gears. ``gravity``:
    m/s^2 in the frame of the base; ``None``: upright.
    """

    out: Path
    urdf: Path | None = None
    robot: str | None = None
    dh: Path | None = None
    axes: int | None = None
    convention: Convention | None = None
    base: str | None = None
    tip: str | None = None
    recording: Path | None = None
    stated: Mapping[str, Any] = field(default_factory=dict)
    name: str | None = None
    signal: str | None = None
    link_torques: bool = False
    gravity: tuple[float, float, float] | None = None
    cell: Mapping[str, Any] = field(default_factory=dict)
    overwrite: bool = False


def run_init(options: InitOptions) -> str:
    """Write ``robot.yaml`` and ``session.yaml``, return the summary; DataError if the recording is of another arm."""
    robot_file, session_file = options.out / "robot.yaml", options.out / "session.yaml"
    taken = [str(file) for file in (robot_file, session_file) if file.exists()]
    if taken and not options.overwrite:
        raise ConfigError(
            f"{' and '.join(taken)}: exists already; --overwrite replaces it, --out chooses another folder"
        )
    if options.recording is not None and reader_of(options.recording).session:
        raise ConfigError(
            f"{options.recording}: the log of a bus needs a complete session; run armident init without --recording"
        )
    geometry = _geometry(options)
    facts = None if options.recording is None else examine(options.recording, geometry.robot, options.stated)
    robot = robot_content(geometry, facts, options.signal, options.gravity, options.link_torques)
    robot["name"] = options.name or robot["name"]
    signal = _signal(robot)
    cell = CellFacts(**{"cell": f"{robot['name']}_cell", **options.cell, **_data_sheet(options)})
    session = session_content(geometry.robot, signal, facts, cell)
    sources = geometry.source if facts is None else f"{geometry.source} and {facts.path.name}"
    head = f"# Written by armident init from {sources}. {MARK} marks a value that is not known yet.\n"
    options.out.mkdir(parents=True, exist_ok=True)
    robot_file.write_text(head + yaml_text(robot), encoding="utf-8")
    session_file.write_text(head + yaml_text(session), encoding="utf-8")
    return summary(robot_file, session_file, geometry, facts)


def _data_sheet(options: InitOptions) -> dict[str, str]:
    """Return the data sheet of the drives as the session names it: relative to its folder, or a shipped file."""
    if (eds := options.cell.get("eds")) is None:
        return {}
    file = config_path(eds, ("eds",))
    return {"eds": os.path.relpath(file.resolve(), options.out.resolve()) if file == Path(eds) else eds}


def _geometry(options: InitOptions) -> Geometry:
    sources = {"a URDF": options.urdf, "--robot": options.robot, "--dh": options.dh, "--axes": options.axes}
    given = [name for name, source in sources.items() if source is not None]
    if len(given) != 1:
        raise ConfigError(
            f"expected one source of the geometry, found {' and '.join(given) or 'none'}: armident init ARM.urdf, "
            "--robot NAME of the library, --dh TABLE.csv, or --axes N with the geometry left blank"
        )
    if options.robot is not None:
        return from_library(options.robot)
    if options.dh is not None:
        return from_dh_table(options.dh, options.convention)
    if options.axes is not None:
        return of_axes(options.axes)
    assert options.urdf is not None
    return from_urdf(options.urdf, options.out, options.base, options.tip, _fits(options))


def _fits(options: InitOptions) -> Callable[[RobotConfig], object] | None:
    """Return a function that raises for a robot that is not the recorded one; ``None`` without names of joints."""
    path = options.recording
    if path is None or is_recording(path) or options.stated.get("effort"):
        return None
    keys = ("names", "topic", "joints", "by_position")
    chosen = given(options.stated, keys)
    if reader_of(path).by_robot:
        return lambda robot: read_rows(path, robot, **chosen)
    table = reader_of(path).read(path, None, chosen)
    assert isinstance(table, Source)
    return lambda robot: table_rows(table, robot, chosen)


def _signal(robot: Mapping[str, Any]) -> str:
    """Kind of effort of the first drive of a content of ``robot.yaml``."""
    first = robot["joints"][0]
    joint = first.value if isinstance(first, Noted) else first
    return str(joint["drive"]["signal"])


def summary(robot_file: Path, session_file: Path, geometry: Geometry, facts: RecordedFacts | None) -> str:
    """Return what was written, found and assumed, all blanks, and the next commands."""
    robot, session = load_robot(robot_file, ""), load_session(session_file, "")
    joints = ", ".join(joint.name for joint in robot.joints)
    lines = [f"{robot_file}: {robot.n} joints ({joints})", f"{session_file}: cell {session.cell}"]
    lines += [f"note: {note}" for note in geometry.notes]
    if facts is not None:
        lines += _found(facts)
    blanks = [
        *_blank_lines(robot_file.name, robot.blanks, robot.n),
        *_blank_lines(session_file.name, session.blanks, robot.n),
    ]
    lines += [f"blanks, marked {MARK}:", *blanks] if blanks else ["no blanks"]
    if facts is None and "bus.channel" not in session.blanks:
        return "\n".join(
            [*lines, "next:", f"  armident doctor --for capture --config {shlex.quote(str(session_file))}"]
        )
    return "\n".join([*lines, *_next(robot_file, facts, robot)])


def _blank_lines(file: str, keys: Sequence[str], n: int) -> list[str]:
    """Lines on the blanks of a file: key, entries, the commands that need it, and how to find its value."""
    lines = []
    for key, names in grouped(keys).items():
        need = NEEDS.get(key)
        commands = ", ".join(need.commands) if need is not None else "every command"
        of = "" if not names else " of all joints" if len(names) == n else f" of {', '.join(names)}"
        lines.append(f"  {file}: {key}{of}, for {commands}" + (f"\n    {need.how}" if need is not None else ""))
    return lines


def _found(facts: RecordedFacts) -> list[str]:
    demand = "with" if facts.has_demand else "without"
    sampled = f"{facts.rate_hz:.6g} Hz, {facts.duration_s:.4g} s"
    lines = [f"found in {facts.path}: {sampled}, {facts.signal}s, {demand} demand"]
    if facts.options:
        lines.append(f"read with {_words(facts)}")
    return lines + [f"note: {note}" for note in facts.notes]


def _words(facts: RecordedFacts) -> str:
    """Options of the import, as they are written."""
    return " ".join(f"{name} {shlex.quote(value)}" if value else name for name, value in facts.options.items())


def _next(robot_file: Path, facts: RecordedFacts | None, robot: RobotConfig) -> list[str]:
    config = shlex.quote(str(robot_file))
    if facts is None:
        return ["next:", f"  armident import RECORDING --config {config} --out recording.mcap"]
    recording, commands = facts.path, []
    if not is_recording(facts.path):
        recording = robot_file.with_name(f"{facts.path.stem}.mcap")
        words = " ".join(
            filter(None, (f"armident import {shlex.quote(str(facts.path))} --config {config}", _words(facts)))
        )
        commands.append(f"{words} --out {shlex.quote(str(recording))}")
    own = f"{shlex.quote(str(recording))} --config {config}"
    commands += [f"armident check {own}", f"armident identify {own}"]
    left = robot.blanks_for("identify")
    wait = [f"  (check and identify wait for {', '.join(dict.fromkeys(map(pattern, left)))})"] if left else []
    return ["next:", *(f"  {command}" for command in commands), *wait]
