"""Options of an import, declared once: for the command line, for ``armident init`` and for the Python API."""

import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, TypedDict, TypeVar, cast, get_args, get_type_hints

import typer

Function = TypeVar("Function", bound=Callable[..., Any])


def pairs(text: str) -> dict[str, str]:
    """Return the pairs of an option, ``QUANTITY=NAME,...``."""
    found = [pair.partition("=") for pair in text.split(",") if pair]
    for key, equals, value in found:
        if not (key and equals and value):
            raise typer.BadParameter(f"expected QUANTITY=NAME,..., found {key + equals + value!r}")
    return {key: value for key, _, value in found}


def names_in(text: str) -> list[str]:
    """Return the words of an option, ``NAME,NAME,...``."""
    return [word.strip() for word in text.split(",") if word.strip()]


class ImportOptions(TypedDict, total=False):
    """Options of `armident.import_recording` and ``armident import``; an option that is absent has no effect."""

    effort: Annotated[
        Path | None, typer.Option("--effort", help="Second CSV file with one effort column per joint; no headers.")
    ]
    motor_side: Annotated[bool, typer.Option("--motor-side", help="Values are on the motor side, not the joint side.")]
    rate_hz: Annotated[
        float | None,
        typer.Option(
            "--rate",
            help="Sampling rate, Hz; default: column t, or the session of a log. A recording is resampled to it.",
            min=0.001,
        ),
    ]
    names: Annotated[
        Mapping[str, str] | None,
        typer.Option(
            "--map",
            parser=pairs,
            metavar="QUANTITY=NAME,...",
            help="Names in the file: position=qm,voltage=vir,...; a word beside joint names too; demand=- omits it.",
        ),
    ]
    polled: Annotated[
        bool,
        typer.Option("--polled", help="Samples were polled from a controller of --rate: put them on its clock."),
    ]
    resample_hz: Annotated[
        float | None,
        typer.Option(
            "--resample",
            help="Put samples with uneven times, or polled ones, on an even clock of this rate, Hz; holes are gaps.",
            min=0.001,
        ),
    ]
    time_unit: Annotated[
        str | None, typer.Option("--time-unit", help="Unit of the times: s, ms, us or ns; default: s.")
    ]
    topic: Annotated[
        str | None, typer.Option("--topic", help="Topic of joint states, if a bag has several with the robot's joints.")
    ]
    joints: Annotated[
        Sequence[str] | None,
        typer.Option(
            "--joints", parser=names_in, metavar="NAME,...", help="Joint names in the file, in the robot's order."
        ),
    ]
    by_position: Annotated[
        bool, typer.Option("--by-position", help="Take joints of other names in the order of the file.")
    ]
    units: Annotated[
        Mapping[str, str] | None,
        typer.Option(
            "--units",
            parser=pairs,
            metavar="QUANTITY=UNIT,...",
            help="Units other than SI: position=deg,torque=mnm,current=ma; mm, deg|mm, mv; FILE.json of LeRobot.",
        ),
    ]


_HINTS = get_type_hints(ImportOptions, include_extras=True)
FLAGS: Mapping[str, str] = {name: hint.__metadata__[0].default for name, hint in _HINTS.items()}
"""Flag of the command line of each option."""


def given(options: Mapping[str, Any], names: Collection[str] = tuple(FLAGS)) -> ImportOptions:
    """Return the options that have an effect, of some names."""
    chosen = {name: value for name, value in options.items() if name in names and value not in (None, False, {}, [])}
    return cast(ImportOptions, chosen)


def with_import_options(*without: str) -> Callable[[Function], Function]:
    """Give a function with ``**options`` the parameters of `ImportOptions`, and their texts in its docstring."""

    def decorate(function: Function) -> Function:
        names = [name for name in _HINTS if name not in without]
        signature = inspect.signature(function)
        parameters = [each for each in signature.parameters.values() if each.kind is not each.VAR_KEYWORD]
        for name in names:
            default = None if NoneType in get_args(get_args(_HINTS[name])[0]) else False
            parameters.append(
                inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=_HINTS[name])
            )
        function.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        kept = {each.name for each in parameters} | {"return"}
        function.__annotations__ = {key: hint for key, hint in function.__annotations__.items() if key in kept}
        function.__annotations__ |= {name: _HINTS[name] for name in names}
        texts = "\n".join(f"    {name}\n        {_HINTS[name].__metadata__[0].help}" for name in names)
        function.__doc__ = (function.__doc__ or "").replace("    options\n        Options of an import.", texts)
        return function

    return decorate
