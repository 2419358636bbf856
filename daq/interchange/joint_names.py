"""Assignment of the joint names of a file to the joints of a robot."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from armident.configs import DataError
from armident.configs.schema.robot import Joint
from armident.daq.interchange.text_files import listed

_WORD = re.compile(r"[^\W\d_]+|\d+")
"""A run of letters of any alphabet, or a run of digits."""

_NOT_OF_SOURCE = "joints matched by the names of the configuration, not by those of its URDF"

Words = tuple[str, ...]


@dataclass(frozen=True)
class JointMatch:
    """Index and name of each joint of a robot in a file, in the robot's order; remarks if names are not equal."""

    index: tuple[int, ...]
    names: tuple[str, ...]
    remarks: tuple[str, ...] = ()


def match_joints(
    found: Sequence[str],
    wanted: Sequence[Joint],
    *,
    by_position: bool = False,
    joints: Sequence[str] | None = None,
) -> JointMatch:
    """Return the index of each of a robot's n joints among the names of a file; order is no evidence.

    Compared in this order: names of the source (``Joint.source_name``, those of a URDF), names of the configuration,
    both without case and separators, both with one common prefix. ``by_position`` takes n names in order where they do
    not match; ``joints`` (n) replaces all comparison. A DataError has both lists of names.
    """
    twice = sorted({name for name in found if list(found).count(name) > 1})
    if twice:
        raise DataError(f"duplicate joint name {', '.join(twice)}: {listed(found)}")
    if joints is not None:
        return _as_chosen(found, wanted, joints)
    if by_position:
        return _in_order(found, wanted)
    match = _by_name(found, wanted)
    if match is None:
        raise DataError(_refusal(found, wanted, _missing(found, wanted)))
    return match


def _as_chosen(found: Sequence[str], wanted: Sequence[Joint], joints: Sequence[str]) -> JointMatch:
    """Return the joints that the user has named."""
    if len(joints) != len(wanted) or len(set(joints)) != len(joints):
        raise DataError(
            f"--joints: expected {len(wanted)} different names, one for each of {listed(_names(wanted))}; "
            f"found {listed(joints)}"
        )
    unknown = [name for name in joints if name not in found]
    if unknown:
        raise DataError(f"--joints: no joint {', '.join(unknown)}; the file has {listed(found) or 'no names'}")
    return JointMatch(tuple(found.index(name) for name in joints), tuple(joints))


def _in_order(found: Sequence[str], wanted: Sequence[Joint]) -> JointMatch:
    """Return the joints in the order of the file."""
    try:
        match = _by_name(found, wanted)
    except DataError:
        match = None
    if match is not None and match.index == tuple(range(len(found))):
        return match
    if match is not None:
        raise DataError(
            f"--by-position contradicts the names: the file has {listed(found)}, the robot {listed(_names(wanted))}; "
            "omit --by-position to match by name, or give the order with --joints"
        )
    if len(found) != len(wanted):
        raise DataError(
            f"--by-position needs {len(wanted)} joints, the file has {len(found)}: {listed(found)}; "
            f"the robot has {listed(_names(wanted))}; --joints NAME,... chooses"
        )
    pairs = ", ".join(f"{name} as {joint.name}" for name, joint in zip(found, wanted, strict=True))
    return JointMatch(tuple(range(len(found))), tuple(found), (f"joints taken by position: {pairs}",))


def _by_name(found: Sequence[str], wanted: Sequence[Joint]) -> JointMatch | None:
    return _exact(found, wanted) or _without_case(found, wanted) or _with_prefix(found, wanted)


def _exact(found: Sequence[str], wanted: Sequence[Joint]) -> JointMatch | None:
    """Return the match of equal names: those of the source, or else those of the configuration."""
    index = {name: k for k, name in enumerate(found)}
    for names, remark in zip(_spellings(wanted), ((), (_NOT_OF_SOURCE,)), strict=False):
        if all(name in index for name in names):
            return JointMatch(tuple(index[name] for name in names), tuple(names), remark)
    return None


def _without_case(found: Sequence[str], wanted: Sequence[Joint]) -> JointMatch | None:
    """Return the match of names that differ in case and separators only."""
    by_letters = _grouped([_letters(name) for name in found], found)
    for names in _spellings(wanted):
        keys = [_letters(name) for name in names]
        if all(key in by_letters for key in keys) and len(set(keys)) == len(keys):
            return _unique([by_letters[key] for key in keys], found, wanted, "without regard to case and separators")
    return None


def _with_prefix(found: Sequence[str], wanted: Sequence[Joint]) -> JointMatch | None:
    """Return the match of names that have one prefix in the file, or in the configuration."""
    by_words = _grouped([_words(name) for name in found], found)
    for names in _spellings(wanted):
        keys = [_words(name) for name in names]
        added = [
            (prefix, [by_words[prefix + key] for key in keys])
            for prefix in {words[: len(words) - len(keys[0])] for words in by_words if _ends_with(words, keys[0])}
            if all(prefix + key in by_words for key in keys)
        ]
        if len(added) > 1:
            choices = ", ".join(sorted(_prefix_text(groups[0][0], prefix) for prefix, groups in added))
            raise DataError(_refusal(found, wanted, f"joints of several arms: prefixes {choices}"))
        for prefix, groups in added:
            return _unique(groups, found, wanted, f"with the prefix {_prefix_text(groups[0][0], prefix)}")
        for length in range(1, min(len(key) for key in keys)):
            shorter = [key[length:] for key in keys]
            if len({key[:length] for key in keys}) == 1 and all(key in by_words for key in shorter):
                groups = [by_words[key] for key in shorter]
                text = _prefix_text(names[0], keys[0][:length])
                return _unique(groups, found, wanted, f"without the prefix {text} of the configuration")
    return None


def _unique(groups: Sequence[Sequence[str]], found: Sequence[str], wanted: Sequence[Joint], how: str) -> JointMatch:
    """Return the match of one name for each joint; refuse several."""
    for group in groups:
        if len(group) > 1:
            raise DataError(_refusal(found, wanted, f"{' and '.join(group)} fit the same joint {how}"))
    names = tuple(group[0] for group in groups)
    pairs = ", ".join(f"{name} as {joint.name}" for name, joint in zip(names, wanted, strict=True))
    return JointMatch(tuple(found.index(name) for name in names), names, (f"joints matched {how}: {pairs}",))


def _spellings(wanted: Sequence[Joint]) -> list[list[str]]:
    """Return the names to look for: those of the source first, then those of the configuration."""
    own = [joint.name for joint in wanted]
    source = _names(wanted)
    return [own] if source == own else [source, own]


def _names(wanted: Sequence[Joint]) -> list[str]:
    """Return the names of the joints in their source, or else in the configuration."""
    return [joint.source_name or joint.name for joint in wanted]


def _words(name: str) -> Words:
    """Return the runs of letters and digits of a name, in lower case."""
    return tuple(word.casefold() for word in _WORD.findall(name)) or (name,)


def _letters(name: str) -> Words:
    """Return the letters and digits of a name as one word, in lower case."""
    return ("".join(_words(name)),)


def _ends_with(words: Words, key: Words) -> bool:
    return len(words) > len(key) and words[-len(key) :] == key


def _prefix_text(name: str, prefix: Words) -> str:
    """Return the prefix of a name as it is written there."""
    ends = [match.end() for match in _WORD.finditer(name)]
    return repr(name[: ends[len(prefix) - 1]])


def _grouped(keys: Sequence[Words], names: Sequence[str]) -> Mapping[Words, list[str]]:
    groups: dict[Words, list[str]] = {}
    for key, name in zip(keys, names, strict=True):
        groups.setdefault(key, []).append(name)
    return groups


def _missing(found: Sequence[str], wanted: Sequence[Joint]) -> str:
    """Return the reason of a refusal: the joints without a name in the file."""
    if not found:
        return "no joint names"
    known = {_letters(name) for name in found}
    absent = [name for name in _names(wanted) if _letters(name) not in known]
    return f"no joint {', '.join(absent)}"


def _refusal(found: Sequence[str], wanted: Sequence[Joint], reason: str) -> str:
    """Return a message with both lists of names and the options that decide."""
    position = ", or --by-position takes them in this order" if len(found) == len(wanted) else ""
    return (
        f"{reason}; the file has {listed(found) or 'no names'}; the robot has {listed(_names(wanted))}; "
        f"--joints NAME,... names those of the file in the robot's order{position}"
    )
