"""Log output: none for a program that imports armident, plain lines on stderr for a command."""

import logging
import subprocess
import sys

import pytest

from armident.daq.logs import LOGGER, LineFormatter, StderrHandler, log_to

LOG_AS_A_LIBRARY = """
import logging
import armident
logging.getLogger("armident.daq.capture.health").error("the disk is full")
"""


def lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    out, err = capsys.readouterr()
    assert out == ""
    return err.splitlines()


def test_a_library_user_gets_no_output_by_default() -> None:
    done = subprocess.run([sys.executable, "-c", LOG_AS_A_LIBRARY], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_warnings_and_errors_have_their_level_in_front(capsys: pytest.CaptureFixture[str]) -> None:
    log = logging.getLogger("armident.test")
    with log_to(StderrHandler()):
        log.debug("not logged")
        log.info("recording to %s", "a.mcap")
        log.warning("the disk is slow")
        log.error("the disk is full")
    assert lines(capsys) == ["recording to a.mcap", "warning: the disk is slow", "error: the disk is full"]


def test_a_handler_replaces_that_of_the_command_and_is_removed_at_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    log, before = logging.getLogger("armident.test"), (LOGGER.level, list(LOGGER.handlers))
    with log_to(StderrHandler("armident"), logging.DEBUG):
        log.warning("outer")
        with log_to(StderrHandler()):
            log.debug("the level of the command is kept")
            log.warning("inner")
        log.warning("outer")
    log.info("no handler")
    assert (LOGGER.level, list(LOGGER.handlers)) == before
    assert lines(capsys) == [
        "armident: warning: outer",
        "the level of the command is kept",
        "warning: inner",
        "armident: warning: outer",
    ]


def test_a_formatter_keeps_the_traceback_of_an_exception() -> None:
    try:
        raise ValueError("unforeseen")
    except ValueError:
        record = logging.LogRecord("armident", logging.ERROR, __file__, 1, "failed", (), sys.exc_info())
    text = LineFormatter("armident").format(record)
    assert text.startswith("armident: error: failed\nTraceback")
    assert text.endswith("ValueError: unforeseen")
