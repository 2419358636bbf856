"""Strict YAML: duplicate keys are errors, numbers follow YAML 1.2, and there are no dates."""

import math
import os.path
import re
from pathlib import Path
from typing import Any

import yaml

from armident.configs.errors import ConfigError

_NOT_MEANT = {"tag:yaml.org,2002:timestamp", "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"}
_INT = re.compile(r"^[-+]?(?:0|[1-9][0-9_]*|0x[0-9a-fA-F_]+)$")
_FLOAT = re.compile(
    r"^[-+]?(?:(?:[0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)(?:[eE][-+]?[0-9]+)?|[0-9][0-9_]*[eE][-+]?[0-9]+)$"
    r"|^[-+]?\.(?:inf|Inf|INF)$|^\.(?:nan|NaN|NAN)$"
)
"""Numbers of YAML 1.2; YAML 1.1 reads 010 as 8, 1:30 as 90, and 1e-3 as a string."""

LARGEST = 1_000_000
"""Largest number of values that aliases may repeat: far more than in any configuration, and read in a second."""


def is_file(path: Path) -> bool:
    """Return True if the file exists; no error if its name is too long or its folder is not accessible."""
    return os.path.isfile(path)


class _Loader(yaml.SafeLoader):
    """Safe loader with the numbers of YAML 1.2, without dates and without duplicate keys."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Compose a mapping and refuse duplicate keys; keys merged in (<<) come later and do not override."""
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            name = (key.tag, key.value) if isinstance(key, yaml.ScalarNode) else None
            if name is not None and name in seen:
                problem = f"duplicate key {key.value[:80]!r}"
                raise yaml.composer.ComposerError(None, None, problem, key.start_mark)
            seen.add(name)
        return node


def _finite(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> float:
    """Return a number; refuse one that is too large for a double and does not say that it is infinite."""
    value = float(loader.construct_yaml_float(node))
    if math.isinf(value) and not node.value.lower().endswith("inf"):
        raise yaml.constructor.ConstructorError(
            None, None, f"the number {node.value[:40]} is too large", node.start_mark
        )
    return value


_Loader.add_constructor("tag:yaml.org,2002:float", _finite)
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in known if tag not in _NOT_MEANT]
    for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:int", _INT, "-+0123456789"),
    ("tag:yaml.org,2002:float", _FLOAT, "-+0123456789."),
):
    _Loader.add_implicit_resolver(_tag, _pattern, list(_first))


class _SelfReference(Exception):
    """A value that contains itself."""


def _expanded(value: Any, known: dict[int, int]) -> int:
    """Number of values in a YAML value, each as often as aliases repeat it; ``known``: by identity, 0 inside."""
    if not isinstance(value, dict | list):
        return 1
    if id(value) not in known:
        known[id(value)] = 0
        parts = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1 + sum(_expanded(part, known) for part in parts)
    elif not known[id(value)]:
        raise _SelfReference
    return known[id(value)]


def read_yaml(text: str, where: str) -> Any:
    """Parse a YAML text. Raises ConfigError if the text is not valid YAML; one line that names the line of the file."""
    try:
        data = yaml.load(text, _Loader)
        if _expanded(data, {}) > len(text) + LARGEST:
            raise ConfigError(f"{where}: aliases (*name) repeat more than {LARGEST} values")
        return data
    except _SelfReference as error:
        raise ConfigError(f"{where}: not valid YAML: an alias (*name) within the value that it names") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark is not None else ""
        problem = " ".join(str(getattr(error, "problem", None) or getattr(error, "reason", None) or error).split())
        raise ConfigError(f"{where}:{line} not valid YAML: {problem[:200]}") from error
    except RecursionError as error:
        raise ConfigError(f"{where}: not valid YAML: brackets or indentation too deep") from error
    except (ValueError, OverflowError) as error:
        raise ConfigError(
            f"{where}: not valid YAML: a number with too many digits, or a key that is no word"
        ) from error
    except AttributeError as error:
        raise ConfigError(f"{where}: not valid YAML: a tag that does not fit its value") from error
