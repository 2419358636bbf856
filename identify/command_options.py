"""Options declared once: fields of a dataclass with their help text, from which command lines and docstrings derive."""

import functools
import inspect
import textwrap
from collections.abc import Callable
from dataclasses import MISSING, Field, field, fields, is_dataclass
from typing import Annotated, Any, TypeVar, get_type_hints

M = TypeVar("M")
R = TypeVar("R")


def option(help: str, default: Any = MISSING, *, flag: str | None = None, **typer_options: Any) -> Any:
    """Field of a dataclass of options: its help text, default, name on the command line, and arguments of typer."""
    return field(default=default, metadata={"help": help, "flag": flag, "typer": typer_options})


def documented(model: type[M]) -> type[M]:
    """Append the help texts of the fields to the docstring of a dataclass, as its section of parameters."""
    lines = [f"{one.name}\n{textwrap.indent(one.metadata['help'], '    ')}" for one in fields(model)]  # type: ignore[arg-type]
    model.__doc__ = "\n".join([inspect.cleandoc(model.__doc__ or ""), "", "Parameters", "----------", *lines])
    return model


def with_options(command: Callable[..., R]) -> Callable[..., R]:
    """Return a command of typer with one option for each field of the dataclasses among its parameters."""
    signature = inspect.signature(command)
    models: dict[str, Any] = {p.name: p.annotation for p in signature.parameters.values() if is_dataclass(p.annotation)}
    expanded = inspect.Signature(
        [q for p in signature.parameters.values() for q in (_parameters(models[p.name]) if p.name in models else [p])]
    )

    @functools.wraps(command)
    def wrapper(*args: Any, **kwargs: Any) -> R:
        bound = expanded.bind(*args, **kwargs)
        bound.apply_defaults()
        given = bound.arguments
        for name, model in models.items():
            given[name] = model(**{one.name: given.pop(one.name) for one in fields(model)})
        return command(**given)

    wrapper.__signature__ = expanded  # type: ignore[attr-defined]
    wrapper.__annotations__ = {p.name: p.annotation for p in expanded.parameters.values()}
    return wrapper


def _parameters(model: type) -> list[inspect.Parameter]:
    """Parameters of a command for the fields of a dataclass."""
    hints = get_type_hints(model)
    return [_parameter(one, hints[one.name]) for one in fields(model)]


def _parameter(one: "Field[Any]", kind: Any) -> inspect.Parameter:
    import typer

    given = one.metadata["typer"]
    flags = [one.metadata["flag"]] if one.metadata["flag"] else []
    declared = typer.Option(*flags, help=one.metadata["help"], **given)
    default = inspect.Parameter.empty if one.default is MISSING else one.default
    given_as = str if "parser" in given else kind
    return inspect.Parameter(
        one.name,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        default=default,
        annotation=Annotated[given_as, declared],
    )
