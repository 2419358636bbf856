"""Loading and checking of configuration files; an error is one line that names file, key and expected value."""

import difflib
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from armident.configs.blanks import check_filled, needed, without_marks
from armident.configs.errors import ConfigError
from armident.configs.schema.robot import RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.session import DriveNode, SessionConfig
from armident.configs.schema.trajectory import Trajectory
from armident.configs.suspected_units import suspected_units
from armident.configs.urdf import UrdfGeometry, geometry_from_urdf, urdf_file
from armident.configs.urdf_file import limit_places
from armident.configs.urdf_inertials import UrdfInertials, read_inertials
from armident.configs.urdf_shapes import UrdfShapes, read_shapes
from armident.configs.yaml_loader import is_file, read_yaml

HERE = Path(__file__).parent
KINDS: dict[str, type[BaseModel]] = {
    "robot": RobotConfig,
    "session": SessionConfig,
    "trajectory": Trajectory,
    "scenario": Scenario,
}
"""Kinds of files by the word in their ``schema`` key."""
SHIPPED = ("robots", "cells", "trajectories", "scenarios", "eds", "zenoh")
"""Folders of shipped files, in the order of the search for a bare name."""
_LONGEST = 80
"""Maximum number of characters of a file that a message quotes."""
_LISTED = 12
"""Maximum number of missing keys that a message lists."""
CHECKS = "armident.session_checks"
"""Entry-point group of functions that check a session's keys of other packages, which no configuration imports."""
T = TypeVar("T", bound=BaseModel)


def config_path(name: str | Path, listed: tuple[str, ...] = ("robots", "cells"), of_folder: str = "robot.yaml") -> Path:
    """Path of a configuration file: the path as given, else a file that is shipped with armident.

    Parameters
    ----------
    name
        A path, or the name of a shipped file. ``tx40.yaml``, ``configs/tx40.yaml``, ``robots/tx40.yaml`` and ``tx40``
        all find the shipped ``configs/robots/tx40.yaml`` if the working directory has no file of that name.
    listed
        Folders of shipped files that the error message lists.
    of_folder
        File that is taken of a folder, as ``armident init`` writes it.

    Raises
    ------
    ConfigError
        If there is no such file.
    """
    path = Path(name)
    for file in (path, path / of_folder):
        if is_file(file):
            return file
    found = _shipped(path)
    if found is not None:
        return found
    shipped = ", ".join(sorted(p.name for folder in listed for p in (HERE / folder).glob("*.[ye]*")))
    raise ConfigError(f"{name}: no such file (shipped with armident: {shipped})")


def _shipped(path: Path, folders: tuple[str, ...] = SHIPPED) -> Path | None:
    """Return the shipped file of a relative path, or of a bare name in ``folders``; ``None`` if there is none."""
    if path.is_absolute():
        return None
    relative = Path(*path.parts[1:]) if path.parts[:1] == ("configs",) else path
    files = [folder / relative for folder in (HERE, *(HERE / folder for folder in folders))]
    if relative.suffix in ("", ".yml"):
        files = [found for file in files for found in (file, file.with_suffix(".yaml"))]
    return next((file for file in files if is_file(file)), None)


def load_robot(name: str | Path, command: str = "") -> RobotConfig:
    """Load a robot configuration.

    If the file has a key ``urdf`` (see `armident.configs.urdf`), joints and geometry come from the URDF. In this case
    ``joints`` only adds to the URDF's joints, by name, and ``gravity`` is given in the frame of its base link.

    Parameters
    ----------
    name
        A path, the folder that ``armident init`` wrote, or the name of a shipped file (see `config_path`).
    command
        Command that uses the robot, such as ``identify``: refuse it if it lacks a value that the command needs. By
        default such values may be marked as blank (``FILL_IN``); a function that needs them refuses the robot.

    Raises
    ------
    ConfigError
        If the file is missing or wrong; names file, key and expected value. If values are missing, names all.

    Examples
    --------
    >>> import armident
    >>> armident.load_robot("tx40").n
    6
    """
    path = config_path(name)
    robot = _robot(path)
    robot.check_filled(command, str(path))
    return robot


def is_session(path: Path) -> bool:
    """Return True if a configuration file is that of a session by its schema; ConfigError if it cannot be read."""
    return str(_read_mapping(_read_text(path), str(path)).get("schema", "")).startswith("armident/session/")


def _robot(path: Path) -> RobotConfig:
    """Robot of a file, which may have blanks."""
    data = _marked(path)
    file_keys = data.keys()
    given = _urdf_geometry(data, path)
    if given is not None:
        geometry = geometry_from_urdf(given, path)
        data = {key: value for key, value in data.items() if key not in UrdfGeometry.model_fields} | geometry
    robot = _checked(data, RobotConfig, str(path))
    suspected = suspected_units(robot, geometry="urdf" not in file_keys)
    if suspected:
        raise ConfigError(f"{path}: expected rad and m: {'; '.join(suspected[:3])}{_others(len(suspected) - 3)}")
    if given is None:
        return robot
    return robot.with_urdf_facts(_limit_places(robot, given, path), *_first_moments(given, path))


def _first_moments(given: UrdfGeometry, path: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Masses and first moments of a URDF, and those with centres in its base frame; none where they are wrong."""
    try:
        found = read_inertials(urdf_file(given, path), given.urdf.base, given.urdf.tip)
    except ConfigError:
        return {}, {}  # only those who need the masses say what is wrong with them
    if found.massless:
        return {}, {}
    return {name: v for name, v in found.standard.items() if name.startswith("m")}, found.of_base


def _limit_places(robot: RobotConfig, given: UrdfGeometry, path: Path) -> tuple[str, ...]:
    """File and line of the limits of velocity and torque of each joint: of the URDF, or of the file that adds to it."""
    own = {more.name for more in given.joints if {"velocity", "torque"} & more.limits.model_fields_set}
    names = [joint.source_name or joint.name for joint in robot.joints]
    places = limit_places(urdf_file(given, path), names)
    return tuple(path.name if name in own else place for name, place in zip(names, places, strict=True))


def checked_robot(data: dict[str, Any], where: str) -> RobotConfig:
    """Robot of the keys and values of a configuration file; ConfigError with ``where``, key and expected value."""
    return _checked(data, RobotConfig, where)


def load_inertials(name: str | Path) -> UrdfInertials | None:
    """Load the masses of a robot from the URDF of its configuration; ``None`` if it names no URDF."""
    path = config_path(name)
    given = _urdf_geometry(_marked(path), path)
    return None if given is None else read_inertials(urdf_file(given, path), given.urdf.base, given.urdf.tip)


def load_shapes(name: str | Path) -> UrdfShapes | None:
    """Load the shapes of the links of a robot from the URDF of its configuration; ``None`` if it names no URDF."""
    path = config_path(name)
    given = _urdf_geometry(_marked(path), path)
    return None if given is None else read_shapes(urdf_file(given, path), given.urdf.base, given.urdf.tip)


def _urdf_geometry(data: dict[str, Any], path: Path) -> UrdfGeometry | None:
    """Keys of a robot configuration that are combined with its URDF; ``None`` if it names none."""
    if "urdf" not in data:
        return None
    return _checked({key: data[key] for key in UrdfGeometry.model_fields if key in data}, UrdfGeometry, str(path))


def _marked(path: Path) -> dict[str, Any]:
    """Content of a file without the blanks, which are listed as ``blanks``."""
    data, blanks = without_marks(_read_mapping(_read_text(path), str(path)))
    known = data.get("blanks", [])
    if blanks and isinstance(known, list):
        data["blanks"] = [*known, *blanks]
    return data


def _others(count: int) -> str:
    """Remark on entries that are not listed."""
    return f" (and {count} more)" if count > 0 else ""


def load_trajectory(name: str | Path) -> Trajectory:
    """Load a reference trajectory; ``name``: a path, or the name of a shipped file (see `config_path`).

    Raises ConfigError if the file is missing or wrong; names file, key and expected value.
    """
    return _load(config_path(name), Trajectory)


def load_session(name: str | Path, command: str | None = None) -> SessionConfig:
    """Load a session configuration and make its relative paths absolute.

    A relative path is searched beside the file first, then among the shipped files (see `config_path`).

    Parameters
    ----------
    name
        A path, the folder that ``armident init`` wrote, or the name of a shipped file (see `config_path`).
    command
        Command that uses the session, such as ``capture``: keys that it does not need may be marked as blank
        (`armident.configs.blanks`). ``None``: no key may.

    Raises
    ------
    ConfigError
        If the file is missing or wrong; names file, key and expected value. If values are missing in session or robot,
        names all.
    """
    path = config_path(name, of_folder="session.yaml")
    session = _checked(_marked(path), SessionConfig, str(path))
    for check in entry_points(group=CHECKS) if session.identification else ():
        try:
            check.load()(session)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error
    base = path.resolve().parent

    def resolved(relative: Path, key: str, folder: str) -> Path:
        target = base / relative
        found = target if is_file(target) else _shipped(relative, (folder,))
        if found is None:
            raise ConfigError(f"{path}: {key}: no such file {relative!s:.400} (looked for {target!s:.400})")
        return found

    changes: dict[str, Any] = {
        "robot": resolved(session.robot, "robot", "robots"),
        "drives": tuple(
            d.model_copy(update={"eds": resolved(d.eds, f"drives[{k}].eds", "eds")})
            for k, d in enumerate(session.drives)
        ),
    }
    if session.setpoints is not None:
        changes["setpoints"] = session.setpoints.model_copy(
            update={"trajectory": resolved(session.setpoints.trajectory, "setpoints.trajectory", "trajectories")}
        )
    files: dict[str, Path] = {}
    if session.zenoh.config is not None:
        files["config"] = resolved(session.zenoh.config, "zenoh.config", "zenoh")
    if session.zenoh.keys is not None:
        files["keys"] = base / session.zenoh.keys
    changes["zenoh"] = session.zenoh.model_copy(update=files)
    session = session.model_copy(update=changes)
    robot = _robot(session.robot)
    check_filled(
        f"{path} with {session.robot.name}",
        (*needed(session.blanks, command), *robot.blanks_for(command)),
        command,
    )
    return session.model_copy(update={"drives": _with_known_joints(session, robot, path)})


def _with_known_joints(session: SessionConfig, robot: RobotConfig, path: Path) -> tuple[DriveNode, ...]:
    """Drives with the names of their joints as the robot writes them; case does not count."""
    joints = {j.name.lower(): j.name for j in robot.joints}
    for k, drive in enumerate(session.drives):
        if drive.joint.lower() not in joints:
            raise ConfigError(
                f"{path}: drives[{k}].joint: {drive.joint!r} is not a joint of {session.robot.name} "
                f"({', '.join(sorted(joints.values()))})"
            )
    return tuple(d.model_copy(update={"joint": joints[d.joint.lower()]}) for d in session.drives)


def load_scenario(name: str | Path) -> Scenario:
    """Load the hidden effects of a virtual arm; ``name``: a path, or the name of a file in ``configs/scenarios``.

    Raises ConfigError if the file is missing or wrong; names file, key and expected value.
    """
    return _load(config_path(name, listed=("scenarios",)), Scenario)


def _load(path: Path, kind: type[T]) -> T:
    return parse(_read_text(path), kind, str(path))


def parse(text: str, kind: type[T], where: str) -> T:
    """Parse YAML text into a configuration object; ConfigError with ``where``, key and expected value."""
    return _checked(_read_mapping(text, where), kind, where)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start + 1} is no UTF-8 text") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error


def _read_mapping(text: str, where: str) -> dict[str, Any]:
    data = read_yaml(text, where)
    if not isinstance(data, dict):
        found = "nothing" if data is None else "a list" if isinstance(data, list) else _shown(data)
        raise ConfigError(f"{where}: expected keys and values, found {found}")
    for key in data:
        if not isinstance(key, str):
            raise ConfigError(f"{where}: {_shown(key)}: expected a word as key")
    return data


def _checked(data: dict[str, Any], kind: type[T], where: str) -> T:
    try:
        model = kind.model_validate(data)
    except ValidationError as error:
        other = _other_kind(data, kind)
        raise ConfigError(f"{where}: {other or _first_problem(error, kind, data)}") from error
    mismatch = _boolean_mismatch(data, model.model_dump(by_alias=True), "")
    if mismatch is not None:
        raise ConfigError(f"{where}: {mismatch}")
    return model


def _other_kind(data: dict[str, Any], kind: type[BaseModel]) -> str | None:
    """Message for a file of another kind than expected; ``None`` if it looks like the expected kind."""
    if kind not in KINDS.values():
        return None
    wanted = next(name for name, one in KINDS.items() if one is kind)
    schema = str(data.get("schema", ""))
    for name in KINDS:
        if schema.startswith(f"armident/{name}/"):
            return None if name == wanted else f"this is a {name} file ({schema}); a {wanted} file is wanted"
    shared = {name: len(data.keys() & _own_keys(one)) for name, one in KINDS.items()}
    best = max(shared, key=lambda name: shared[name])
    if shared[best] > shared[wanted]:
        matching = ", ".join(sorted(data.keys() & _own_keys(KINDS[best])))
        return f"this looks like a {best} file (it has {matching}); a {wanted} file is wanted"
    return None


def _own_keys(kind: type[BaseModel]) -> set[str]:
    """Keys of the first level that identify the kind of a file."""
    keys = {field.alias or name for name, field in kind.model_fields.items()} - {"schema", "description"}
    return keys | ({"urdf"} if kind is RobotConfig else set())


def _boolean_mismatch(given: Any, parsed: Any, key: str) -> str | None:
    """Message for the first boolean (in YAML also yes, no, on, off) that was parsed as a number, or the reverse."""
    if isinstance(given, bool) != isinstance(parsed, bool):
        wanted = "true or false" if isinstance(parsed, bool) else "a number or a word"
        return f"{key}: expected {wanted}, found {str(given).lower():.80}"
    below: list[tuple[Any, Any, str]] = []
    if isinstance(given, dict) and isinstance(parsed, dict):
        below = [(value, parsed.get(k), f"{key}.{k}" if key else str(k)) for k, value in given.items()]
    elif isinstance(given, list) and isinstance(parsed, tuple | list):
        below = [(one, other, f"{key}[{k}]") for k, (one, other) in enumerate(zip(given, parsed, strict=False))]
    return next((found for entry in below if (found := _boolean_mismatch(*entry)) is not None), None)


def _first_problem(error: ValidationError, kind: type[BaseModel], data: dict[str, Any]) -> str:
    problems = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    first = problems[0]
    key = _key_of(first["loc"])
    more = _others(len(problems) - 1)
    if first["type"] == "extra_forbidden":
        missing = [str(p["loc"][-1]) for p in problems if p["type"] == "missing"]
        offered = _keys(kind) | (_keys(UrdfGeometry) if kind is RobotConfig else set())
        near = difflib.get_close_matches(str(first["loc"][-1])[:_LONGEST], missing + sorted(offered), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        return f"{key}: unknown key{hint}{more}"
    missing = [_key_of(p["loc"]) for p in problems if p["type"] == "missing"]
    if first["type"] == "missing" and len(missing) > 1:
        listed = ", ".join(missing[:_LISTED])
        return f"{_shown(listed, 500)}{_others(len(missing) - _LISTED)}: missing"
    value = first.get("input")
    found = f", found {_shown(repr(value))}" if isinstance(value, str | float | bool) or value is None else ""
    if isinstance(value, int) and not isinstance(value, bool):
        found = f", found {value}" if abs(value) < 10**20 else ", found a number of more than 20 digits"
    message = " ".join(first["msg"].removeprefix("Value error, ").split())
    return f"{key + ': ' if key else ''}{_shown(message[0].lower() + message[1:], 500)}{found}{more}"


def _key_of(place: tuple[int | str, ...]) -> str:
    """Key of a problem, such as ``joints[0].mdh``."""
    key = ""
    for part in place:
        key += f"[{part}]" if isinstance(part, int) else f".{_shown(part)}" if key else _shown(part)
    return key


def _shown(text: object, longest: int = _LONGEST) -> str:
    """Text on one line without control characters, cut after ``longest`` characters."""
    line = "".join(c if c.isprintable() else "?" for c in str(text))
    return line if len(line) <= longest else f"{line[: longest - 3]}..."


def _keys(kind: type[BaseModel]) -> set[str]:
    """All key names of a schema, including nested ones."""
    keys: set[str] = set()
    todo: list[Any] = [kind.model_json_schema()]
    while todo:
        node = todo.pop()
        if isinstance(node, dict):
            keys |= set(node.get("properties", {}))
            todo += node.values()
        elif isinstance(node, list):
            todo += node
    return keys
