"""Reads a configuration file once, checks it once, and says in one line what is wrong with it."""

import difflib
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from configs.errors import ConfigError
from configs.robot import RobotConfig
from configs.session import SessionConfig
from configs.suite import SuiteConfig
from configs.trajectory import Trajectory
from configs.urdf import UrdfGeometry, geometry_from_urdf

HERE = Path(__file__).parent
T = TypeVar("T", bound=BaseModel)


def config_path(name: str | Path) -> Path:
    """The file a user means: the path as given, or a file that comes with armident.

    ``tx40.yaml``, ``configs/tx40.yaml`` and ``tx40`` all find the shipped ``configs/tx40.yaml``
    where no file of that name exists in the working directory.

    Raises
    ------
    ConfigError
        If there is no such file; names the shipped ones.
    """
    path = Path(name)
    if path.is_file():
        return path
    relative = Path(*path.parts[1:]) if path.parts[:1] == ("configs",) else path
    for candidate in (HERE / relative, (HERE / relative).with_suffix(".yaml")):
        if not path.is_absolute() and candidate.is_file():
            return candidate
    shipped = ", ".join(sorted(p.name for p in HERE.glob("*.yaml")))
    raise ConfigError(f"{name}: no such file (shipped with armident: {shipped})")


def load_robot(name: str | Path) -> RobotConfig:
    """A robot configuration from a file.

    Where the file has a key ``urdf`` (see `configs.urdf`), joints and geometry come from there: ``joints`` then only
    adds to them, by name, and ``gravity`` is that of the URDF's base link.

    Raises
    ------
    ConfigError
        Naming file, key and what was expected.
    """
    path = config_path(name)
    data = _read_mapping(_read_text(path), str(path))
    if "urdf" in data:
        concerned = {key: data[key] for key in UrdfGeometry.model_fields if key in data}
        geometry = geometry_from_urdf(_checked(concerned, UrdfGeometry, str(path)), path)
        data = {key: value for key, value in data.items() if key not in concerned} | geometry
    return _checked(data, RobotConfig, str(path))


def load_trajectory(name: str | Path) -> Trajectory:
    """A reference trajectory from a file.

    Raises
    ------
    ConfigError
        Naming file, key and what was expected.
    """
    return _load(config_path(name), Trajectory)


def load_session(name: str | Path) -> SessionConfig:
    """A session configuration from a file, its relative paths made absolute.

    Raises
    ------
    ConfigError
        Naming file, key and what was expected.
    """
    path = config_path(name)
    session = _load(path, SessionConfig)
    base = path.resolve().parent

    def resolved(relative: Path, key: str) -> Path:
        target = base / relative
        if not target.is_file():
            raise ConfigError(f"{path}: {key}: no such file {relative} (looked for {target})")
        return target

    changes: dict[str, Any] = {
        "robot": resolved(session.robot, "robot"),
        "drives": tuple(
            d.model_copy(update={"eds": resolved(d.eds, f"drives[{k}].eds")}) for k, d in enumerate(session.drives)
        ),
    }
    if session.setpoints is not None:
        changes["setpoints"] = session.setpoints.model_copy(
            update={"trajectory": resolved(session.setpoints.trajectory, "setpoints.trajectory")}
        )
    if session.zenoh.config is not None:
        changes["zenoh"] = session.zenoh.model_copy(update={"config": resolved(session.zenoh.config, "zenoh.config")})
    session = session.model_copy(update=changes)
    joints = {j.name for j in load_robot(session.robot).joints}
    for k, drive in enumerate(session.drives):
        if drive.joint not in joints:
            raise ConfigError(
                f"{path}: drives[{k}].joint: {drive.joint!r} is not a joint of {session.robot.name} "
                f"({', '.join(sorted(joints))})"
            )
    return session


def load_suite(name: str | Path) -> SuiteConfig:
    """A suite of hidden effects from a file.

    Raises
    ------
    ConfigError
        Naming file, key and what was expected.
    """
    return _load(config_path(name), SuiteConfig)


def _load(path: Path, kind: type[T]) -> T:
    return parse(_read_text(path), kind, str(path))


def parse(text: str, kind: type[T], where: str) -> T:
    """A configuration object from YAML text; ``where`` is how messages name it.

    Raises
    ------
    ConfigError
        Naming ``where``, the key and what was expected.
    """
    return _checked(_read_mapping(text, where), kind, where)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error


def _read_mapping(text: str, where: str) -> dict[str, Any]:
    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark is not None else ""
        raise ConfigError(f"{where}:{line} not valid YAML: {getattr(error, 'problem', error)}") from error
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: expected keys and values, found {type(data).__name__}")
    return data


def _checked(data: dict[str, Any], kind: type[T], where: str) -> T:
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{where}: {_first_problem(error, kind, data)}") from error


def _first_problem(error: ValidationError, kind: type[BaseModel], data: dict[str, Any]) -> str:
    problems = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    first = problems[0]
    key = ""
    for part in first["loc"]:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else str(part)
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    if first["type"] == "extra_forbidden":
        missing = [str(p["loc"][-1]) for p in problems if p["type"] == "missing"]
        offered = _keys(kind) | (_keys(UrdfGeometry) if kind is RobotConfig else set())
        near = difflib.get_close_matches(str(first["loc"][-1]), missing + sorted(offered), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        return f"{key}: unknown key{hint}{more}"
    value = first.get("input")
    found = f", found {value!r}" if isinstance(value, str | int | float | bool) or value is None else ""
    message = first["msg"].removeprefix("Value error, ")
    return f"{key + ': ' if key else ''}{message[0].lower() + message[1:]}{found}{more}"


def _keys(kind: type[BaseModel]) -> set[str]:
    """All key names of a schema, nested ones too."""
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
