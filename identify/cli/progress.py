"""Progress and warnings of the commands, on stderr."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event

SHOW_AFTER_S = 2.0
"""Duration after which progress is shown, s."""

Report = Callable[[str, float], None]


class _Compilation(event.Listener):
    """Prints one line when kernels are compiled: the first run on a machine waits for the compiler."""

    def __init__(self, what: str) -> None:
        self._what, self._printed = what, False

    def on_start(self, event: event.Event) -> None:
        """Print the line before the first compilation."""
        if not self._printed:
            self._printed = True
            print(f"{self._what}: compiling for this machine, once: later runs find it", file=sys.stderr)

    def on_end(self, event: event.Event) -> None:
        """Do nothing at the end of a compilation."""


@contextmanager
def progress(what: str) -> Iterator[Report]:
    """Report stages and the share done, 0 to 1, from two seconds on: a bar on a terminal, otherwise plain lines."""
    begin = time.monotonic()
    with event.install_listener("numba:compile", _Compilation(what)), _stages(what, begin) as report:
        yield report


@contextmanager
def _stages(what: str, begin: float) -> Iterator[Report]:
    if not sys.stderr.isatty():
        yield _plain_lines(what, begin)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=1.0, visible=False)

        def show(stage: str, share: float) -> None:
            visible = time.monotonic() - begin > SHOW_AFTER_S
            bar.update(task, completed=share, description=f"{what}: {stage}", visible=visible)

        yield show


def warn(lines: list[str]) -> None:
    """Print one line per warning on stderr."""
    for line in lines:
        print(f"armident: warning: {line}", file=sys.stderr)


def time_left(elapsed_s: float, share: float) -> str:
    """Return the time left at a constant rate, in words."""
    seconds = round(elapsed_s * (1.0 - share) / share)
    return f"{seconds} s" if seconds < 120 else f"{seconds // 60} min"


def _plain_lines(what: str, begin: float) -> Report:
    """Print lines on stderr: one per stage, and one for every further fifth of the work."""
    last: tuple[str, int] | None = None

    def show(stage: str, share: float) -> None:
        nonlocal last
        now = stage, int(5 * share)
        if now != last and time.monotonic() - begin > SHOW_AFTER_S:
            left = f", {time_left(time.monotonic() - begin, share)} left" if share > 0.0 else ""
            print(f"{what}: {stage} ({100 * share:.0f} %{left})", file=sys.stderr, flush=True)
            last = now

    return show
