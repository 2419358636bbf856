"""Root of the command line: finds commands, imports only the one called, one line for every error."""

import errno
import importlib.metadata
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from armident.configs.errors import ArmidentError, ConfigError, DataError
from armident.daq.cli import DEBUG_VARIABLE, GROUP, application

HEAVY = {"numpy", "scipy", "numba", "pydantic", "yaml", "zenoh", "matplotlib", "canopen", "can", "pinocchio", "rich"}
ROOT_IN_A_PROCESS = [sys.executable, "-m", "armident.daq.cli"]


def refuse(kind: str) -> None:
    """Raise the error that is asked for.

    Example: armident refuse config
    """
    raise {
        "config": ConfigError("cell.yaml: sync.rate_hz:\n expected a number"),
        "data": DataError("too short"),
        "other": ArmidentError("bus is down"),
        "full": OSError(errno.ENOSPC, "No space left on device", "a.json"),
        "device": OSError(errno.EIO, "Input/output error"),
        "library": ImportError("libgomp.so.1: cannot open shared object file: No such file or directory"),
        "bug": ValueError("unforeseen"),
        "interrupt": KeyboardInterrupt(),
        "changed": typer.Exit(4),
    }[kind]


def greet(name: Annotated[str, typer.Option(help="Whom to greet.")] = "arm") -> None:
    """Greet somebody."""
    print(f"hello {name}")


def changed() -> int:
    """Return an exit code."""
    return 4


def join(words: Annotated[str, typer.Option(metavar="WORD,...")] = "", name: str = "arm") -> None:
    """Print the words that are given."""
    print(words, name)


def compile_while_interrupted() -> None:
    """Lose an interrupt in a callback, as a compiler does, and fail for that reason."""
    with suppress(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)
    raise RuntimeError("no compiled object yet")


ENTRIES = [
    importlib.metadata.EntryPoint(name, f"{__name__}:{function}", GROUP)
    for name, function in [
        ("refuse", "refuse"),
        ("greet", "greet"),
        ("changed", "changed"),
        ("join", "join"),
        ("compile", "compile_while_interrupted"),
    ]
]
ABSENT = importlib.metadata.EntryPoint("absent", "daq.no_such_module:absent", GROUP)


@pytest.fixture(autouse=True)
def without_debug(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DEBUG_VARIABLE, "")


def call(*words: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(application(words, [*ENTRIES, ABSENT]), list(words))
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.parametrize(
    ("kind", "code", "line"),
    [
        ("config", 2, "armident: cell.yaml: sync.rate_hz: expected a number"),
        ("data", 3, "armident: too short"),
        ("other", 1, "armident: bus is down"),
        ("library", 2, "armident: libgomp.so.1 is missing on this system (Debian, Ubuntu: apt-get install libgomp1)"),
        ("full", 1, "armident: a.json: No space left on device; free space on the disk, or choose another folder"),
        ("device", 1, "armident: Input/output error"),
    ],
)
def test_an_expected_error_is_one_line_on_stderr_and_its_own_exit_code(kind: str, code: int, line: str) -> None:
    assert call("refuse", kind) == (code, "", line + "\n")


def test_an_error_because_of_an_interrupt_is_an_interrupt() -> None:
    # A shell starts its background jobs with SIGINT ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert call("compile") == (130, "", "armident: interrupted\n")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_unforeseen_error_is_one_line_and_exit_code_1() -> None:
    code, out, err = call("refuse", "bug")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert err.startswith("armident: ValueError: unforeseen")


def test_debug_prints_the_traceback_of_an_error() -> None:
    code, _, err = call("--debug", "refuse", "bug")
    assert code == 1
    assert "Traceback" in err
    assert "in refuse" in err


def test_an_interrupt_exits_with_130_and_says_so() -> None:
    assert call("refuse", "interrupt") == (130, "", "armident: interrupted\n")


def test_a_command_chooses_its_own_exit_code() -> None:
    assert call("refuse", "changed")[0] == 4
    assert call("changed")[0] == 4


def test_options_reach_the_command() -> None:
    assert call("greet", "--name", "robot") == (0, "hello robot\n", "")


def test_a_list_of_values_that_is_given_twice_is_refused_for_the_last_would_replace_the_first() -> None:
    assert call("join", "--words", "a=b,c=d", "--name", "x", "--name", "y") == (0, "a=b,c=d y\n", "")
    for repeated in (["--words=c=d"], ["--words", "a=b"]):
        code, out, err = call("join", "--words", "a=b", *repeated)
        assert (code, out) == (2, "")
        assert "--words is given twice; give it once: WORD,..." in err


@pytest.mark.parametrize("words", [["greet", "--nmae", "x"], ["no-such-command"], ["refuse"], ["--no-such-option"]])
def test_wrong_usage_is_exit_code_2(words: list[str]) -> None:
    code, out, err = call(*words)
    assert (code, out) == (2, "")
    assert "Usage: " in err


def test_help_lists_every_command_with_its_first_line() -> None:
    code, out, _ = call("--help")
    assert code == 0
    assert [line.split(maxsplit=1) for line in out.splitlines() if line.startswith("  greet")] == [
        ["greet", "Greet somebody."]
    ]
    assert "Exit codes: 0 done" in out


def test_a_command_with_a_missing_module_is_listed_as_unavailable_and_reports_the_module() -> None:
    assert "(unavailable)" in call("--help")[1]
    code, out, err = call("absent", "--whatever", "it", "is")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "no_such_module" in err


def test_calling_one_command_does_not_load_the_others() -> None:
    loaded: list[str] = []

    class Watched(importlib.metadata.EntryPoint):
        def load(self) -> object:
            loaded.append(self.name)
            return super().load()

    application(["greet", "refuse"], [Watched(e.name, e.value, e.group) for e in ENTRIES])
    assert loaded == ["greet"]


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys\n"
        "from armident.daq.cli import main\n"
        "try:\n    main(['--help'])\n"
        "except SystemExit as end:\n    assert not end.code\n"
        f"print('HEAVY', sorted({HEAVY!r} & sys.modules.keys()))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "HEAVY []"


def test_every_registered_command_can_be_loaded() -> None:
    done = subprocess.run([*ROOT_IN_A_PROCESS, "--help"], capture_output=True, text=True, check=True)
    registered = importlib.metadata.entry_points(group=GROUP)
    assert {"capture", "demo", "identify", "robot", "worker"} <= registered.names
    assert "(unavailable)" not in done.stdout


def test_the_version_is_that_of_the_distribution() -> None:
    done = subprocess.run([*ROOT_IN_A_PROCESS, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"armident {importlib.metadata.version('armident')}\n"


def test_every_command_shows_an_example(tmp_path: Path) -> None:
    names = sorted(importlib.metadata.entry_points(group=GROUP).names)
    # One process imports for all commands.
    script = (
        "import sys\n"
        "from armident.daq.cli import main\n"
        "for name in sys.argv[1:]:\n"
        "    print('COMMAND')\n"
        "    try:\n        main([name, '--help'])\n"
        "    except SystemExit as end:\n        assert not end.code, name\n"
    )
    done = subprocess.run([sys.executable, "-c", script, *names], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for name, shown in zip(names, done.stdout.split("COMMAND\n")[1:], strict=True):
        assert f"armident {name}" in shown.split("Options:")[0].split("\n", 1)[1], f"{name} shows no example"
