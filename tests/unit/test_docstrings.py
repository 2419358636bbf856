"""Every parameter of a public function and of a command is documented; no docstring begins with a question word."""

import ast
import importlib.metadata
import inspect
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import pytest

import armident
from armident.daq.cli import GROUP
from armident.identify.api import identify

PACKAGES = ("configs", "drivers", "daq", "identify", "virtual_robot", "src/armident")
ROOT = Path(__file__).resolve().parents[2]
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


@cache
def functions() -> tuple[tuple[str, ast.FunctionDef, set[str]], ...]:
    """Top-level functions and methods of every package, with their places and what base classes document of them."""
    return tuple(_functions())


def _functions() -> Iterator[tuple[str, ast.FunctionDef, set[str]]]:
    modules = {
        path.relative_to(ROOT): ast.parse(path.read_text(encoding="utf-8")).body
        for package in PACKAGES
        for path in sorted((ROOT / package).glob("**/*.py" if package != "src/armident" else "*.py"))
    }
    classes = {node.name: node for body in modules.values() for node in body if isinstance(node, ast.ClassDef)}

    def inherited(one: ast.ClassDef, method: str) -> set[str]:
        found: set[str] = set()
        for base in (classes[b.id] for b in one.bases if isinstance(b, ast.Name) and b.id in classes):
            own = [m for m in base.body if isinstance(m, ast.FunctionDef) and m.name == method]
            found |= inherited(base, method).union(*(documented(ast.get_docstring(m)) for m in own))
        return found

    for path, body in modules.items():
        for node in body:
            for member in node.body if isinstance(node, ast.ClassDef) else [node]:
                if isinstance(member, ast.FunctionDef):
                    above = inherited(node, member.name) if isinstance(node, ast.ClassDef) else set()
                    yield f"{path}:{member.lineno} {member.name}", member, above


def commands() -> dict[str, Callable[..., Any]]:
    """Functions of the command line by the text ``module:function`` of their entry points."""
    return {point.value: point.load() for point in importlib.metadata.entry_points(group=GROUP)}


@pytest.mark.slow
def test_every_parameter_of_a_public_function_is_documented() -> None:
    of_commands = {f"{value.partition(':')[0].replace('.', '/')} {value.partition(':')[2]}" for value in commands()}
    lacking = []
    for place, node, inherited in functions():
        path, _, rest = place.partition(":")
        module = path.removeprefix("src/armident/").removesuffix(".py")
        if f"armident/{module} {rest.partition(' ')[2]}" in of_commands:
            continue
        names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
        names = [name for name in names if name not in ("self", "cls")]
        missing = set(names) - documented(ast.get_docstring(node)) - inherited
        if len(names) > 1 and not node.name.startswith("_") and missing:
            lacking.append(f"{place}: {', '.join(sorted(missing))}")
    assert not lacking, "\n".join(lacking)


def test_every_parameter_of_a_command_has_a_help_text() -> None:
    """Its docstring is the help of the command, so that parameters are described where they are declared."""
    lacking = []
    for value, command in commands().items():
        for name, annotation in get_type_hints(command, include_extras=True).items():
            information = [each for each in getattr(annotation, "__metadata__", ()) if hasattr(each, "help")]
            if name != "return" and not any(each.help for each in information):
                lacking.append(f"{value}: {name}")
    assert not lacking, "\n".join(lacking)


def test_no_docstring_begins_with_a_question_word() -> None:
    found = [place for place, node, _ in functions() if RIDDLE.match(ast.get_docstring(node) or "")]
    assert not found, "\n".join(found)
