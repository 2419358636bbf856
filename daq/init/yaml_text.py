"""YAML text with a remark beside a value."""

import math
from dataclasses import dataclass
from typing import Any

import yaml

LONGEST = 130
"""Longest line with its remark; a longer remark stands on a line of its own above."""


@dataclass(frozen=True)
class Noted:
    """Value with a remark. ``note``: remark, one line."""

    value: Any
    note: str


def yaml_text(content: dict[str, Any], depth: int = 0) -> str:
    """Return a mapping as YAML: nested mappings and lists of them as blocks, other values (or `Noted`) on one line."""
    return "".join(_entry(key, value, depth) for key, value in content.items())


def _entry(key: str, value: Any, depth: int) -> str:
    note = value.note if isinstance(value, Noted) else ""
    bare = value.value if isinstance(value, Noted) else value
    indent = " " * depth
    if isinstance(bare, dict) and any(isinstance(each, dict | Noted) for each in bare.values()):
        return _line(f"{indent}{key}:", note, indent) + yaml_text(bare, depth + 2)
    if isinstance(bare, list) and bare and all(isinstance(each, dict | Noted) for each in bare):
        return _line(f"{indent}{key}:", note, indent) + "".join(_item(each, depth + 2) for each in bare)
    if isinstance(bare, list) and bare and all(isinstance(each, list) for each in bare):
        return _line(f"{indent}{key}:", note, indent) + "".join(f"{indent}  - {_flow(each)}\n" for each in bare)
    return _line(f"{indent}{key}: {_flow(bare)}", note, indent)


def _item(item: Any, depth: int) -> str:
    """One entry of a list of mappings."""
    note = item.note if isinstance(item, Noted) else ""
    lines = yaml_text(item.value if isinstance(item, Noted) else item, depth + 2).splitlines(keepends=True)
    first = next(k for k, line in enumerate(lines) if not line.lstrip().startswith("#"))
    lines[first] = f"{' ' * depth}- {lines[first].lstrip()}"
    return (f"{' ' * depth}# {note}\n" if note else "") + "".join(lines)


def _line(text: str, note: str, indent: str) -> str:
    if not note:
        return f"{text}\n"
    if len(text) + len(note) + 4 > LONGEST:
        return f"{indent}# {note}\n{text}\n"
    return f"{text}  # {note}\n"


def _flow(value: Any) -> str:
    """One value on one line; floats with the shortest digits."""
    text = yaml.safe_dump(_plain(value), default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
