"""Data sets of LeRobot: Parquet with ``observation.state``, ``action`` and, where recorded, effort or current."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError, RobotConfig
from armident.daq.interchange.bag_files import METADATA, SUFFIXES
from armident.daq.interchange.text_files import listed

STATE, ACTION, EPISODE = "observation.state", "action", "episode_index"
_QUANTITIES = {
    "effort": ("effort", "efforts", "eff", "torque", "torques", "tau"),
    "current": ("current", "currents"),
    "velocity": ("velocity", "vel"),
}
"""Last words of the columns of observations, and of the names in a state, that tell another quantity than position."""
FULL = 100.0
"""Ends of a calibrated range in the default unit of positions; those of a gripper are 0 and 100."""
UNSURE = {
    "deg": "degrees are right only if the arm was recorded with use_degrees: no position passes 100, and LeRobot's "
    "default is -100 to 100 of the calibrated range",
    "": "positions are taken as rad; LeRobot's default is -100 to 100 of the calibrated range (--units "
    "position=FILE.json), or degrees",
}
"""Notes on positions of a data set by the unit that is stated, or none."""
_COUNTS = 4096
"""Counts per turn of the servos of LeRobot's arms (STS3215, XL330, XL430)."""
_MOST = 1 << 31
"""Counts that no range reaches."""
_BETWEEN = 6
"""Periods from an episode to the next: a gap at every rate. Many short episodes do not count as lost samples."""
MOST_DEGREES = 720.0
"""Positions beyond two turns are counts."""
_SUFFIX = re.compile(r"[._](pos|position|goal|eff|effort|torque|tau|current)$", re.IGNORECASE)
"""End of a name that tells the quantity, not the joint."""


def is_lerobot(arrays: Mapping[str, Any]) -> bool:
    """Return ``True`` if the columns are those of a LeRobot data set."""
    return STATE in arrays or {ACTION, EPISODE} <= set(arrays)


def data_files(folder: Path) -> list[Path]:
    """Return the Parquet files of a data set (a folder with ``data``, or one in it) in order; else none."""
    if not folder.is_dir() or any(file.name.endswith((METADATA, *SUFFIXES)) for file in folder.iterdir()):
        return []
    parts = ("data/*/*.parquet", "data/*.parquet", "chunk-*/*.parquet", "*.parquet")
    return next((found for pattern in parts if (found := sorted(folder.glob(pattern)))), [])


def joined(parts: Mapping[Path, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the columns of the files of a data set, one after the other; DataError if a file lacks a column."""
    every = dict.fromkeys(name for part in parts.values() for name in part)
    for file, part in parts.items():
        if absent := [
            name for name in every if name not in part and name.startswith(("observation.", ACTION, "timestamp"))
        ]:
            raise DataError(f"{file}: no column {', '.join(absent)}, which other files of the data set have")
    common = [name for name in every if all(name in part for part in parts.values())]
    return {name: np.concatenate([part[name] for part in parts.values()]) for name in common}


def lerobot_table(path: Path, arrays: Mapping[str, Any]) -> tuple[dict[str, NDArray[np.float64]], list[str]]:
    """Return times, positions, demand and effort of a data set, and notes; ``meta/info.json`` names its joints."""
    features = _features(path)
    table: dict[str, NDArray[np.float64]] = {}
    notes: list[str] = []
    if STATE not in arrays:
        raise DataError(f"{path}: this data set has no {STATE}, the measured positions; found {listed(list(arrays))}")
    sources = {"position": STATE, "demand": ACTION} | {
        kind: name
        for name in reversed(list(arrays))
        if name.startswith("observation.") and (kind := _quantity(name)) != "position"
    }
    found = {
        quantity: (source, _matrix(path, source, arrays[source]), _names(features, source))
        for quantity, source in sources.items()
        if source in arrays
    }
    kinds = [_quantity(name) for name in _names(features, STATE)]
    _, state, state_names = found["position"]
    if len(kinds) == state.shape[1]:
        for kind in dict.fromkeys(kinds):
            own = [k for k, each in enumerate(kinds) if each == kind]
            found[kind] = STATE, state[:, own], [state_names[k] for k in own]
        state_names = found.get("position", found[kinds[0]])[2]
    found.pop("velocity", None)
    if not found.keys() & {"effort", "current"}:
        raise DataError(
            f"{path}: this data set has no effort or current of its joints, which a model is identified from; "
            f"expected observation.effort or observation.current, found {listed(list(arrays))}"
        )
    bases = {"position": "q", "demand": "qr", "effort": "tau", "current": "current"}
    state_names = [_SUFFIX.sub("", each) for each in state_names]
    unnamed: list[str] = []
    for quantity, (source, values, full) in found.items():
        names = [_SUFFIX.sub("", each) for each in full]
        if not names and len(state_names) == values.shape[1]:
            names = state_names
            notes.append(f"{source} has no names of joints: taken in the order of {STATE}")
        if names and len(names) == values.shape[1]:
            word = "target position" if quantity == "demand" else quantity
            table |= {f"{name}/{word}": values[:, j] for j, name in enumerate(names)}
        else:
            table[bases[quantity]] = values
            unnamed.append(source)
    if unnamed:
        notes.append(f"no names of joints in meta/info.json: {listed(unnamed)} taken in the order of the robot")
    if len({len(values) for values in table.values()}) > 1:
        raise DataError(f"{path}: its columns have unequal lengths")
    if "timestamp" in arrays:
        times = _matrix(path, "timestamp", arrays["timestamp"]).ravel()
        episode = _matrix(path, EPISODE, arrays[EPISODE]).ravel() if EPISODE in arrays else np.zeros(times.size)
        if episode.size != times.size or not np.isfinite(episode).all():
            raise DataError(f"{path}: {EPISODE} has values that are no numbers, or not one for every timestamp")
        table["t"] = _one_clock(times, episode, notes)
    return table, notes


def _quantity(name: str) -> str:
    """Return the quantity of a column of observations, or of a name in a state, by its last word."""
    last = re.split(r"[._]", name.lower())[-1]
    return next((quantity for quantity, words in _QUANTITIES.items() if last in words), "position")


def position_hint(position: NDArray[np.float64]) -> str:
    """Return the units that positions (N, n) of a data set may have, and the options that read them, for a message."""
    if np.abs(position).max() > MOST_DEGREES:
        return "; counts of the servos have to be converted where they are recorded"
    if np.abs(position).max() > FULL:
        return "; values beyond 100 are degrees (use_degrees) in a data set of LeRobot: --units position=deg reads them"
    return (
        "; LeRobot records -100 to 100 of each joint's calibrated range unless use_degrees was set: --units "
        "position=FILE.json, the calibration of this arm, converts them; --units position=deg only with use_degrees"
    )


def calibrated(
    file: Path, labels: Sequence[str], robot: RobotConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return factors and offsets (n,) from -100 to 100 of ranges to rad, by a file of ``lerobot-calibrate``."""
    try:
        motors = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror or 'an error of the file system'}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: not JSON, as a calibration of LeRobot is") from error
    motors = motors if isinstance(motors, dict) else {}
    factors, offsets = np.ones(robot.n), np.zeros(robot.n)
    for j, (label, joint) in enumerate(zip(labels, robot.joints, strict=True)):
        name = next((each for each in (label.split("/")[0], joint.source_name, joint.name) if each in motors), None)
        entry = motors.get(name)
        ends: list[Any] = [entry.get(end) for end in ("range_min", "range_max")] if isinstance(entry, dict) else []
        if len(ends) != 2 or not all(isinstance(end, int) and abs(end) < _MOST for end in ends) or ends[0] >= ends[1]:
            raise ConfigError(f"{file}: no range_min below range_max of {joint.name}; found {listed(list(motors))}")
        gripper = name == "gripper"
        factors[j] = (ends[1] - ends[0]) / (FULL if gripper else 2 * FULL) * 2 * np.pi / _COUNTS
        offsets[j] = -factors[j] * FULL / 2 if gripper else 0.0
    return factors, offsets


def _one_clock(times: NDArray[np.float64], episode: NDArray[np.float64], notes: list[str]) -> NDArray[np.float64]:
    """Return times that increase over all episodes, each of which begins at zero."""
    if times.size < 2:
        return times
    begins = np.flatnonzero(np.diff(episode) != 0) + 1
    step = float(np.median(np.diff(times)))
    made = times.copy()
    for begin in begins:
        made[begin:] += made[begin - 1] + _BETWEEN * step - made[begin]
    if begins.size:
        notes.append(f"{begins.size + 1} episodes one after the other, the time between them is not known")
    return made


def _matrix(path: Path, name: str, column: Any) -> NDArray[np.float64]:
    try:
        rows = np.stack([np.asarray(row, np.float64).ravel() for row in column])
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: {name} has rows of unequal lengths, or values that are no numbers") from error
    return rows


def _features(path: Path) -> Mapping[str, Any]:
    for folder in (path, *list(path.resolve().parents)[:4]):
        try:
            found = json.loads((folder / "meta" / "info.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        features = found.get("features") if isinstance(found, dict) else None
        if isinstance(features, dict):
            return features
    return {}


def _names(features: Mapping[str, Any], column: str) -> list[str]:
    """Return the names of the joints of a column; empty if there are none."""
    entry = features.get(column)
    names = entry.get("names") if isinstance(entry, dict) else None
    if isinstance(names, dict):
        names = next((each for each in names.values() if isinstance(each, list)), None)
    if not isinstance(names, list) or not all(isinstance(each, str) for each in names):
        return []
    return names
