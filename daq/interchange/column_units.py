"""Units in the names of columns: factors to SI, units of times, and units that cannot be read."""

import re
import unicodedata
from collections.abc import Mapping

import numpy as np

from armident.configs import DataError
from armident.daq.interchange.text_files import shortened

_ANGLES = {
    "rad": 1.0, "radian": 1.0, "radians": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "degree": np.pi / 180,
    "degrees": np.pi / 180, "°": np.pi / 180, "rev": 2 * np.pi, "revolution": 2 * np.pi, "revolutions": 2 * np.pi,
    "turn": 2 * np.pi, "turns": 2 * np.pi,
}  # fmt: skip
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
_TORQUES = {"nm": 1.0, "n": 1.0, "knm": 1e3, "kn": 1e3, "ncm": 1e-2, "mnm": 1e-3, "nmm": 1e-3}
_CURRENTS = {"a": 1.0, "amp": 1.0, "amps": 1.0, "ampere": 1.0, "ma": 1e-3}
_VOLTAGES = {"v": 1.0, "volt": 1.0, "volts": 1.0, "mv": 1e-3}

OF_QUANTITY: Mapping[str, Mapping[str, float]] = {
    "position": _ANGLES | _LENGTHS,
    "demand": _ANGLES | _LENGTHS,
    "torque": _TORQUES,
    "current": _CURRENTS,
    "voltage": _VOLTAGES,
}
"""Factors to SI of the units of each quantity."""
SCALES: Mapping[str, float] = _ANGLES | _LENGTHS | _TORQUES | _CURRENTS | _VOLTAGES
"""Factors to SI of all units, by `plain_unit`."""

_TIMES = {
    word: unit
    for unit, words in {
        "s": "s sec secs second seconds",
        "ms": "ms msec msecs millis millisecond milliseconds",
        "us": "us usec usecs micros microsecond microseconds",
        "ns": "ns nsec nsecs nanos nanosecond nanoseconds",
    }.items()
    for word in words.split()
}
_NO_UNITS = frozenset(
    {"actual", "act", "meas", "measured", "feedback", "fb", "fbk", "is", "ist", "raw", "filtered", "estimated", "est"}
    | {"joint", "motor", "value", "utc", "epoch", "unix", "unixtime", "local", "gmt"}
)
"""Words in brackets after a name that are no units."""
_SIGNS = re.compile("[\\s.\u00b7\u22c5\u2219*\u00d7_-]+")
"""Spaces, points and signs of multiplication between the parts of a unit."""
_SHOWN: Mapping[str, str] = {
    "position": "rad, mrad, deg, rev, m, cm, mm",
    "demand": "rad, mrad, deg, rev, m, cm, mm",
    "torque": "N m, N cm, mN m, N mm, kN m, N, kN",
    "current": "A, mA",
    "voltage": "V, mV",
}


SINCE = " since "
"""Between the unit of times and the date from which they count, ISO 8601 (UDUNITS, CF conventions)."""


def plain_unit(text: str) -> str:
    """Return a unit in lower case without spaces and signs of multiplication; empty if the text is no unit."""
    word = unicodedata.normalize("NFKC", text.replace("º", "°")).casefold().replace("μ", "u")
    word = _SIGNS.sub("", word.strip("[]() "))
    return "" if word in _NO_UNITS else word


def time_unit(text: str) -> str:
    """Return ``s``, ``ms``, ``us`` or ``ns`` for a unit of times in any spelling, and other units as they are."""
    unit = plain_unit(text.partition(SINCE)[0])
    return _TIMES.get(unit, unit)


def check_unit(column: str, quantity: str, unit: str) -> None:
    """Refuse a column whose unit in the file (empty: none) is not one of its quantity, such as ``position``."""
    if plain_unit(unit) not in ("", *OF_QUANTITY[quantity]):
        raise DataError(
            f"column {column} states the unit {shortened(unit)!r}, expected one of {_SHOWN[quantity]}: "
            "convert it to SI units, and name the column without a unit"
        )
