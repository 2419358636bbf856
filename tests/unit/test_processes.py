"""Child processes: output, end, signals and failures."""

import signal
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from subprocess import PIPE, Popen
from typing import IO, Any

import pytest

from armident.configs import ArmidentError
from armident.processes import CommandProcess, ProcessEnded, ProcessTimeout, start_command

DEAF = "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('ready', flush=True)\ntime.sleep(60)"


def python(script: str, **options: Any) -> CommandProcess:
    """A process that runs a script instead of a command."""

    def start(words: Sequence[str], out: IO[bytes], err: IO[bytes]) -> "Popen[bytes]":
        return Popen([sys.executable, "-u", "-c", *words], stdout=out, stderr=err)

    return CommandProcess([script], name="script", start=start, **options)


def test_lines_are_returned_in_order_and_output_stays_after_the_end() -> None:
    with python("print('one'); print('two'); import sys; sys.exit(3)") as process:
        assert process.wait_for_line("o", 20) == "one"
        assert process.wait_for_line("", 20) == "two"
        with pytest.raises(ProcessEnded, match="script ended with exit code 3 before it printed 'three'"):
            process.wait_for_line("three", 20)
    assert process.output() == "one\ntwo\n"
    assert process.exit_code == 3
    assert not process.running


def test_a_failure_names_the_log_and_the_last_lines_of_standard_error(tmp_path: Path) -> None:
    log = tmp_path / "logs" / "script.log"
    with (
        python("import sys; print('a\\n\\nb', file=sys.stderr); sys.exit('c')", log=log) as process,
        pytest.raises(ProcessEnded, match=r"exit code 1 .*\(log: .*script\.log\): a \| b \| c"),
    ):
        process.wait_for_line("ready", 20)
    assert process.tail(1) == "c"
    assert str(process.failure("failed")).startswith("script failed (log: ")


def test_a_second_run_appends_to_the_log_and_reads_its_own_part(tmp_path: Path) -> None:
    log = tmp_path / "script.log"
    for word in ("first", "second"):
        with python(f"print('{word}')", log=log, merge=True) as process:
            assert process.wait_for_line("", 20) == word
        assert process.errors() == f"{word}\n"
    assert log.read_text() == "first\nsecond\n"


def test_a_process_without_output_is_a_timeout() -> None:
    begin = time.monotonic()
    with (
        python("import time; time.sleep(60)") as process,
        pytest.raises(ProcessTimeout, match="script did not print 'ready' within 0 s: it printed nothing"),
    ):
        process.wait_for_line("ready", 0.2)
    assert process.exit_code == -signal.SIGTERM
    assert time.monotonic() - begin < 20


def test_a_process_that_ignores_the_signal_is_killed() -> None:
    process = python(DEAF).start()
    process.wait_for_line("ready", 20)
    with pytest.raises(ArmidentError, match="is running already"):
        process.start()
    process.stop(0.2)
    assert process.exit_code == -signal.SIGKILL


def test_a_command_runs_with_the_interpreter_and_the_environment_that_were_given() -> None:
    start = partial(start_command, module="platform", niceness=1, own_session=True, environment={"TERM": "dumb"})
    with CommandProcess(["terse"], start=start) as process:
        assert process.wait_for_line("", 20).startswith("Linux")
        process.process.wait(20)
    assert process.exit_code == 0


def test_a_process_ends_when_the_process_that_started_it_is_killed() -> None:
    sleeper = "from armident.processes import end_with_parent; end_with_parent(); print('on', flush=True); "
    parent = (
        "import os, subprocess, sys, time\n"
        "words = [sys.executable, '-c', sys.argv[1] + 'import time; time.sleep(60)']\n"
        "subprocess.Popen(words, env=dict(os.environ, ARMIDENT_PARENT=str(os.getpid())))\n"
        "time.sleep(60)"
    )
    with Popen([sys.executable, "-c", parent, sleeper], stdout=PIPE) as started:
        assert started.stdout is not None
        assert started.stdout.readline() == b"on\n"
        started.kill()
        begin = time.monotonic()
        # The pipe ends when nobody has it.
        assert started.stdout.read() == b""
    assert time.monotonic() - begin < 20.0
