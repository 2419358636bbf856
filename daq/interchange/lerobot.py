"""Data sets of LeRobot: Parquet with ``observation.state``, ``action`` and, where recorded, effort or current."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.daq.interchange.bag_files import METADATA, SUFFIXES
from armident.daq.interchange.text_files import listed

STATE, ACTION, EPISODE = "observation.state", "action", "episode_index"
_EFFORTS = {
    "tau": ("effort", "efforts", "torque", "torques", "joint_effort", "joint_torque"),
    "current": ("current", "currents", "joint_current", "motor_current"),
}
"""Last words of the columns of observations that are an effort."""
_BETWEEN_S = 1.0
"""Gap between two episodes, s: the time between them is not recorded."""
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
    efforts = {
        base: next((name for name in arrays if name.startswith("observation.") and name.split(".")[-1] in words), None)
        for base, words in _EFFORTS.items()
    }
    if STATE not in arrays:
        raise DataError(f"{path}: this data set has no {STATE}, the measured positions; found {listed(list(arrays))}")
    if not any(efforts.values()):
        raise DataError(
            f"{path}: this data set has no effort or current of its joints, which a model is identified from; "
            f"expected observation.effort or observation.current, found {listed(list(arrays))}"
        )
    sources = {"position": STATE, "demand": ACTION, "effort": efforts["tau"], "current": efforts["current"]}
    bases = {"position": "q", "demand": "qr", "effort": "tau", "current": "current"}
    state_names = _names(features, STATE)
    unnamed: list[str] = []
    for quantity, source in sources.items():
        if source is None or source not in arrays:
            continue
        values = _matrix(path, source, arrays[source])
        names = _names(features, source)
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


def _one_clock(times: NDArray[np.float64], episode: NDArray[np.float64], notes: list[str]) -> NDArray[np.float64]:
    """Return times that increase over all episodes, each of which begins at zero."""
    if times.size < 2:
        return times
    begins = np.flatnonzero(np.diff(episode) != 0) + 1
    step = float(np.median(np.diff(times)))
    made = times.copy()
    for begin in begins:
        # Whole periods, so that the gap is one.
        between = max(1.0, round(_BETWEEN_S / step)) * step if step > 0 else _BETWEEN_S
        made[begin:] += made[begin - 1] + between - made[begin]
    if begins.size:
        notes.append(f"{begins.size + 1} episodes one after the other, with a gap of {_BETWEEN_S:g} s between them")
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
    """Return the names of the joints of a column, without the word for the quantity; empty if there are none."""
    entry = features.get(column)
    names = entry.get("names") if isinstance(entry, dict) else None
    if isinstance(names, dict):
        names = next((each for each in names.values() if isinstance(each, list)), None)
    if not isinstance(names, list) or not all(isinstance(each, str) for each in names):
        return []
    return [_SUFFIX.sub("", each) for each in names]
