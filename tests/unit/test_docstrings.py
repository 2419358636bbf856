"""Every parameter of the public API is documented; elsewhere the number of gaps may only fall."""

import ast
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import armident
from armident.identify.api import identify

PACKAGES = ("configs", "drivers", "daq", "identify", "virtual_robot", "src/armident")
ROOT = Path(__file__).resolve().parents[2]
WITHOUT_PARAMETERS_SECTION = 141
"""Public functions and methods with two or more parameters whose docstring has no Parameters section; lower it only."""
RIDDLES = 16
"""Docstrings that begin with What, Whether, Which, How, Where, Who or That; lower it only."""
RIDDLE = re.compile(r"(What|Whether|Which|How|Where|Who|That)\b")


def documented(docstring: str | None) -> set[str]:
    """Names in the Parameters section of a numpydoc docstring."""
    match = re.search(
        r"Parameters\n-+\n(.*?)(?=\n\n[A-Z][A-Za-z ]+\n-+\n|\Z)", inspect.cleandoc(docstring or ""), re.DOTALL
    )
    if match is None:
        return set()
    lines = [line for line in match[1].splitlines() if line and not line.startswith(" ")]
    return {name.strip().lstrip("*") for line in lines for name in line.split(" : ")[0].split(",")}


def public_callables() -> Iterator[tuple[str, Callable[..., Any], str | None]]:
    """Public functions, constructors and methods with the docstring that describes their parameters."""
    for name in armident.__all__:
        value = getattr(armident, name) if name != "identify" else identify
        if inspect.isfunction(value):
            yield name, value, value.__doc__
        elif inspect.isclass(value) and not issubclass(value, Exception):
            yield name, value, value.__doc__
            for key, method in vars(value).items():
                if inspect.isfunction(method) and not key.startswith("_"):
                    yield f"{name}.{key}", method, method.__doc__


@pytest.mark.parametrize(("name", "call", "docstring"), [pytest.param(*c, id=c[0]) for c in public_callables()])
def test_every_parameter_of_the_public_api_is_documented(
    name: str, call: Callable[..., Any], docstring: str | None
) -> None:
    parameters = [p for p in inspect.signature(call).parameters if p != "self"]
    missing = [p for p in parameters if p not in documented(docstring)]
    assert docstring
    assert not missing, f"{name}: not in its Parameters section: {', '.join(missing)}"


def functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    for package in PACKAGES:
        for path in sorted(
            (ROOT / package).glob("**/*.py") if package != "src/armident" else (ROOT / package).glob("*.py")
        ):
            module = ast.parse(path.read_text(encoding="utf-8"))
            classes = [node for node in module.body if isinstance(node, ast.ClassDef)]
            for node in [*module.body, *(member for one in classes for member in one.body)]:
                if isinstance(node, ast.FunctionDef):
                    yield f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", node


def test_fewer_public_functions_lack_a_parameters_section() -> None:
    lacking = []
    for place, node in functions():
        names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
        names = [name for name in names if name not in ("self", "cls")]
        if len(names) > 1 and not node.name.startswith("_") and not documented(ast.get_docstring(node)):
            lacking.append(place)
    assert len(lacking) <= WITHOUT_PARAMETERS_SECTION, "\n".join(lacking)


def test_fewer_docstrings_begin_with_a_question_word() -> None:
    found = [place for place, node in functions() if RIDDLE.match(ast.get_docstring(node) or "")]
    assert len(found) <= RIDDLES, "\n".join(found)
