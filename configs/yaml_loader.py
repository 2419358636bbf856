"""Strict YAML: duplicate keys are errors, numbers follow YAML 1.2, and there are no dates."""

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


def is_file(path: Path) -> bool:
    """Return True if the file exists; no error if its name is too long or its folder is not accessible.

    Parameters
    ----------
    path
        Path of the file.
    """
    return os.path.isfile(path)


class _Loader(yaml.SafeLoader):
    """Safe loader with the numbers of YAML 1.2, without dates and without duplicate keys."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Compose a mapping and refuse duplicate keys; keys merged in (<<) come later and do not override.

        Parameters
        ----------
        anchor
            Anchor of the node.
        """
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            name = (key.tag, key.value) if isinstance(key, yaml.ScalarNode) else None
            if name is not None and name in seen:
                problem = f"the key {key.value[:80]!r} is there twice"
                raise yaml.composer.ComposerError(None, None, problem, key.start_mark)
            seen.add(name)
        return node


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in known if tag not in _NOT_MEANT]
    for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:int", _INT, "-+0123456789"),
    ("tag:yaml.org,2002:float", _FLOAT, "-+0123456789."),
):
    _Loader.add_implicit_resolver(_tag, _pattern, list(_first))


def read_yaml(text: str, where: str) -> Any:
    """Parse a YAML text.

    Parameters
    ----------
    text
        YAML text.
    where
        Name of the text in messages.

    Raises
    ------
    ConfigError
        If the text is not valid YAML; one line that names the line of the file.
    """
    try:
        return yaml.load(text, _Loader)
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
