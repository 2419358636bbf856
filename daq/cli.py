"""Root of the command line: finds the registered commands and loads the one that is called.

A command is an entry point of group ``armident.commands`` that names a function with typer annotations; it may return
an exit code. Its module must import quickly: heavy imports belong into the function.
"""

import atexit
import functools
import gc
import importlib.metadata
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand

from armident.daq.logs import StderrHandler, log_to

GROUP = "armident.commands"
DEBUG_VARIABLE = "ARMIDENT_DEBUG"
"""Environment variable with the effect of ``--debug``."""
INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 plus SIGINT, as shells have it."""

EPILOG = (
    "Exit codes: 0 done, 2 usage or configuration, 3 the data cannot support the request, "
    "4 changed or unexplained, 1 any other error."
)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command, by default with the arguments of the process, and exit with its status."""
    if "ARMIDENT_PARENT" in os.environ:
        from armident.processes import end_with_parent

        end_with_parent()
    # The last search for cycles of a process would take 0.2 s to free what ends with it.
    atexit.register(gc.freeze)
    words = list(sys.argv[1:] if arguments is None else arguments)
    application(words)(args=words, prog_name="armident")
    raise SystemExit(0)


def application(
    words: Sequence[str], entry_points: Iterable[importlib.metadata.EntryPoint] | None = None
) -> typer.Typer:
    """Return the command line with the command that is called, or with all if none is (help, completion)."""
    app = typer.Typer(
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        epilog=EPILOG,
    )
    app.callback()(_root)
    known = importlib.metadata.entry_points(group=GROUP) if entry_points is None else entry_points
    registered = {entry.name: entry for entry in known}
    called = next((word for word in words if not word.startswith("-")), None)
    for name in [called] if called in registered else sorted(registered):
        _add(app, registered[name])
    return app


def _add(app: typer.Typer, entry: importlib.metadata.EntryPoint) -> None:
    try:
        function: Callable[..., Any] = entry.load()
    except (ImportError, AttributeError) as error:
        reason = f"{entry.value} cannot be loaded: {_one_line(error)}"

        def unavailable() -> None:
            print(f"armident: {entry.name} is unavailable: {reason}", file=sys.stderr)
            raise typer.Exit(1)

        anything = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
        app.command(entry.name, help="(unavailable)", context_settings=anything)(unavailable)
    else:
        app.command(entry.name, cls=_Command)(_reported(function, entry.name))


class _Command(TyperCommand):
    """A command that refuses a list of values, ``NAME,...``, that is given twice: the last would replace the first."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        given = self.make_parser(ctx).parse_args(args=list(args))[2]
        for option in given:
            if (option.metavar or "").endswith(",...") and given.count(option) > 1:
                raise typer.BadParameter(f"{option.opts[0]} is given twice; give it once: {option.metavar}", ctx)
        return super().parse_args(ctx, args)


def _interrupted() -> typer.Exit:
    print("armident: interrupted", file=sys.stderr)
    return typer.Exit(INTERRUPTED)


def _reported(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """Return a command whose log goes to stderr, and whose exceptions become one line on stderr and an exit code."""

    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> None:
        level = logging.DEBUG if os.environ.get(DEBUG_VARIABLE) else logging.INFO
        interrupts: list[int] = []
        try:
            with log_to(StderrHandler("armident"), level), _noted(interrupts):
                code = function(*args, **kwargs)
            if code:
                raise typer.Exit(code)
        except (typer.Exit, typer.Abort, typer.BadParameter, BrokenPipeError):
            raise
        except KeyboardInterrupt:
            raise _interrupted() from None
        except Exception as error:
            from armident.configs.errors import ArmidentError, ConfigError
            from armident.configs.reasons import reason_of
            from armident.extras import install_line, missing_library, needed_extra

            if interrupts:
                # A compiler or a callback in C can turn the interrupt into another error.
                raise _interrupted() from None
            if os.environ.get(DEBUG_VARIABLE):
                traceback.print_exc()
            if isinstance(error, ImportError) and (extra := needed_extra(error, function.__module__)) is not None:
                print(f"armident: {install_line(f'armident {name}', [extra])}", file=sys.stderr)
                raise typer.Exit(ConfigError.exit_code) from None
            if isinstance(error, ImportError) and (line := missing_library(error)) is not None:
                print(f"armident: {line}", file=sys.stderr)
                raise typer.Exit(ConfigError.exit_code) from None
            if isinstance(error, ArmidentError):
                print(f"armident: {_one_line(error)}", file=sys.stderr)
                raise typer.Exit(error.exit_code) from None
            if isinstance(error, OSError) and error.strerror:
                print(f"armident: {reason_of(error, step=True)}", file=sys.stderr)
                raise typer.Exit(1) from None
            hint = f" (--debug or {DEBUG_VARIABLE}=1 prints the traceback)"
            print(f"armident: {type(error).__name__}: {_one_line(error)}{hint}", file=sys.stderr)
            raise typer.Exit(1) from None

    return command


@contextmanager
def _noted(interrupts: list[int]) -> Iterator[None]:
    """Append SIGINT to a list when it arrives, beside its usual effect; a handler of somebody else stays."""

    def note(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        signal.default_int_handler(number, frame)

    usual = threading.current_thread() is threading.main_thread()
    usual = usual and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if usual:
        signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        if usual and signal.getsignal(signal.SIGINT) is note:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"armident {importlib.metadata.version('armident')}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Log debug messages and the traceback of an error.")] = False,
) -> None:
    """Record robot arms over CANopen at 5 kHz and identify their dynamic models.

    Start with: armident demo
    """
    if debug:
        os.environ[DEBUG_VARIABLE] = "1"


if __name__ == "__main__":
    main()
