"""Names of demands in tables of other tools: the words for a reference position, and the rest of such a name."""

import re

_WORDS = (
    r"demand(?:s|ed)?", r"desired", r"des", r"references?", r"refs?", r"targets?", r"set[\W_]?points?",
    r"command(?:s|ed)?", r"cmds?", r"goals?",
)  # fmt: skip
_POSITION = r"(?:q|pos|positions?)?"
_DEMAND = re.compile(
    rf"(?<![^\W\d_])(?P<before>{_POSITION})(?:{'|'.join(_WORDS)})(?P<after>{_POSITION})(?![^\W\d_])", re.IGNORECASE
)
"""A word for a demand, alone or joined to one for a position (``qref``); digits and separators end it."""
_CAPITAL = re.compile(r"(?<=[a-z\d])(?=[A-Z])")
_SEPARATORS = " ./_-:[]()"
_NO_POSITION = re.compile(
    r"(?<![^\W\d_])(?:dq|ddq|qd|qdd|vel|velocit(?:y|ies)|speeds?|acc|accelerations?|tau|torques?|efforts?|moments?|"
    r"forces?|currents?|voltages?)(?![^\W\d_])",
    re.IGNORECASE,
)


def without_demand(name: str) -> str | None:
    """Return the rest of the name of a demand; ``None`` if no word in it names a demand.

    >>> [without_demand(name) for name in ("q1_ref", "elbow/desired/position", "reference2", "q1")]
    ['q1', 'elbow/position', '2', None]
    """
    found = _DEMAND.search(separated := _CAPITAL.sub("_", name))
    if found is None:
        return None
    before, after = separated[: found.start()], separated[found.end() :]
    after = found["before"] + found["after"] + after.lstrip(_SEPARATORS)
    return (before + after if after else before).strip(_SEPARATORS)


def of_another_quantity(name: str) -> bool:
    """Return ``True`` if a name has a word for a velocity, an acceleration or an effort. ``name``: name of a column."""
    return _NO_POSITION.search(name) is not None
