"""Docstrings are complete where somebody outside calls (`DOOR`) and short elsewhere."""

import ast
import fnmatch
import importlib.metadata
import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import pytest

import armident
import armident.configs
import armident.daq.recording
from armident.daq.cli import GROUP
from armident.identify.api.identification_api import identify
from armident.identify.estimators.methods import METHODS

PACKAGES = ("configs", "drivers", "daq", "identify", "virtual_robot", "src/armident", "src/armident/testing")
WRITERS = {"QueuedSeries", "RecordingSeries", "RecordingWriter", "StreamLayout", "TriggeredSeries"}
"""Classes that write the files of a capture: the capture alone uses them."""
DOOR: dict[str, set[str] | None] = {
    "configs/__init__.py": None,
    "configs/errors.py": None,
    "configs/loading.py": set(armident.configs.__all__),
    "configs/schema/*": None,
    "daq/api.py": None,
    "daq/recording/*": set(armident.daq.recording.__all__) - WRITERS,
    "identify/api/*": None,
    "identify/documents/*": None,
    "identify/effects/effect.py": None,
    "identify/estimators/problem.py": None,
    **{f"identify/estimators/{name}.py": {name} for name in (method.replace("-", "_") for method in METHODS)},
    "identify/model_export/exported_model.py": None,
    "identify/robot/motion.py": {"Motion"},
    "identify/identification/robot_model.py": None,
    "src/armident/__init__.py": None,
    "src/armident/testing/__init__.py": {"capture", "virtual_arm", "virtual_bus"},
    "src/armident/testing/virtual_arm.py": None,
    "virtual_robot/api.py": None,
}
"""Files whose public objects have complete docstrings, with the names of these objects; ``None``: all."""
INSIDE = {
    "identify/api/arguments.py",
    "identify/documents/files.py",
    "identify/documents/signing.py",
    "src/armident/testing/guest.py",
}
"""Files behind the door although a pattern of `DOOR` has them: only the package calls their functions."""
FEW_LINES = 10
"""Lines of code of a short function."""
ENOUGH = 10
"""Lines of a docstring that before the parameters that a short function may have even if its code is shorter."""
FILLERS = re.compile(
    r"an?|the|of|to|for|with|and|or|from|as|by|in|on|at|is|are|be|its?|their|this|that|these|which|each|every|given|used"
    r"|values?|object|s|si"
)
"""Words that say nothing."""
ROOT = Path(__file__).resolve().parents[2]
RIDDLE = re.compile(r"(What|Whether|Which|How|Where|Who|That)\b")


def section(docstring: str | None) -> str:
    """Text of the Parameters section of a numpydoc docstring; empty if it has none."""
    match = re.search(
        r"Parameters\n-+\n(.*?)(?=\n\n[A-Z][A-Za-z ]+\n-+\n|\Z)", inspect.cleandoc(docstring or ""), re.DOTALL
    )
    return match[1] if match else ""


def documented(docstring: str | None) -> set[str]:
    """Names in the Parameters section of a numpydoc docstring."""
    lines = [line for line in section(docstring).splitlines() if line and not line.startswith(" ")]
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


@dataclass(frozen=True)
class Place:
    """A class, function or method, its names from the module on, and the parameters that base classes document."""

    path: str
    names: tuple[str, ...]
    node: ast.ClassDef | ast.FunctionDef
    inherited: frozenset[str] = frozenset()

    def __str__(self) -> str:
        return f"{self.path}:{self.node.lineno} {'.'.join(self.names)}"

    @property
    def docstring(self) -> str:
        return ast.get_docstring(self.node) or ""

    @property
    def is_at_door(self) -> bool:
        if self.path in INSIDE or any(name.startswith("_") for name in self.names):
            return False
        rows = [names for pattern, names in DOOR.items() if fnmatch.fnmatch(self.path, pattern)]
        return any(names is None or self.names[0] in names for names in rows)


@cache
def places() -> tuple[Place, ...]:
    """Top-level functions, classes and methods of every package."""
    return tuple(_places())


def _places() -> Iterator[Place]:
    modules = {
        path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8")).body
        for package in PACKAGES
        for path in sorted((ROOT / package).glob("*.py" if package.startswith("src") else "**/*.py"))
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
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                yield Place(path, (node.name,), node)
            if not isinstance(node, ast.ClassDef):
                continue
            for member in node.body:
                if isinstance(member, ast.FunctionDef):
                    above = frozenset(inherited(node, member.name))
                    yield Place(path, (node.name, member.name), member, above)


def words(text: str) -> set[str]:
    """Words of a text without fillers and endings; names are split."""
    text = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", text).replace("_", " ").lower()
    return {
        re.sub(r"(?<=...)(s|es|ed|ing)$", "", word)
        for word in re.findall(r"[a-z]+", text)
        if not FILLERS.fullmatch(word)
    }


def restating(place: Place) -> Iterator[str]:
    """Entries of a Parameters section whose words are all those of the name, the type and the summary."""
    if not (entries := section(place.docstring)):
        return
    types = {a.arg: ast.unparse(a) for a in ast.walk(place.node) if isinstance(a, ast.arg)}
    types |= {
        ast.unparse(a.target): ast.unparse(a.annotation) for a in ast.walk(place.node) if isinstance(a, ast.AnnAssign)
    }
    summary = place.docstring.partition("\n")[0]
    for names, text in re.findall(r"^(\S.*)\n((?:    .*\n?)+)", entries, re.MULTILINE):
        own = words(names) | words(" ".join(types.get(name.strip(" *"), "") for name in names.split(",")))
        said = words(re.sub(r",? (s|Hz|ns|us|ms)\.?$", "", text.strip()))
        if (
            not re.search(r"[\d`(:]|None|[Dd]efault|\bnot\b|\bonly\b", text)
            and said & own
            and said <= own | words(summary)
        ):
            yield f"{names}: {text.strip()}"


@cache
def commands() -> dict[str, Callable[..., Any]]:
    """Functions of the command line by the text ``module:function`` of their entry points."""
    return {point.value: point.load() for point in importlib.metadata.entry_points(group=GROUP)}


def is_fixture(node: ast.FunctionDef) -> bool:
    """True for the fixtures of pytest, whose arguments are fixtures."""
    return any("fixture" in ast.unparse(each) for each in node.decorator_list)


def is_command(place: Place) -> bool:
    """True for the functions of commands, whose docstrings are help texts."""
    module = place.path.removeprefix("src/armident/").removesuffix(".py").replace("/", ".")
    return f"armident.{module}:{place.names[-1]}" in commands() or any(
        "typer" in ast.unparse(each) for each in place.node.decorator_list
    )


def test_every_parameter_at_the_door_is_documented() -> None:
    lacking = []
    for place in places():
        if place.is_at_door and isinstance(place.node, ast.FunctionDef) and not is_fixture(place.node):
            names = [a.arg for a in (*place.node.args.posonlyargs, *place.node.args.args, *place.node.args.kwonlyargs)]
            names = [name for name in names if name not in ("self", "cls")]
            missing = set(names) - documented(place.docstring) - place.inherited
            if len(names) > 1 and missing:
                lacking.append(f"{place}: document {', '.join(sorted(missing))}")
    assert not lacking, "\n".join(lacking)


def test_no_entry_behind_the_door_restates_its_name() -> None:
    found = [
        f"{place}: drop the entry {entry}" for place in places() if not place.is_at_door for entry in restating(place)
    ]
    assert not found, "\n".join(found)


def test_returns_and_raises_behind_the_door_are_sentences() -> None:
    found = [
        f"{place}: write the section {match[1]} as a sentence, or drop it"
        for place in places()
        if not place.is_at_door
        and (match := re.search(r"^(Returns|Yields|Raises)\n-+$", place.docstring, re.MULTILINE))
    ]
    assert not found, "\n".join(found)


def test_text_of_a_short_function_is_not_longer_than_its_code() -> None:
    """Without its Parameters section, whose entries each say something."""
    found = []
    for place in places():
        if isinstance(place.node, ast.ClassDef) or place.is_at_door or not place.docstring or is_command(place):
            continue
        first = place.node.body[0]
        code = (place.node.end_lineno or 0) - (first.end_lineno or 0)
        if code < FEW_LINES and (lines := len(place.docstring.partition("\n\nParameters\n")[0].splitlines())) > max(
            code, ENOUGH
        ):
            found.append(f"{place}: {lines} lines of text for {code} lines of code")
    assert not found, "\n".join(found)


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
    found = [str(place) for place in places() if RIDDLE.match(place.docstring)]
    assert not found, "\n".join(found)
