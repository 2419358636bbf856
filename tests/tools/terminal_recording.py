"""Moving picture of the demo's output, as an SVG that a browser plays: the one of the README.

``armident demo --out demo > demo.log; python -m tests.tools.terminal_recording demo.log docs/images/terminal.svg``

Lines appear at the times that stand in them, ``SPEED`` times as fast, and one after the other. Working directory and
repeated progress are left out. Whoever asks the browser for less motion sees the last lines at once.
"""

import argparse
import re
from collections.abc import Iterator, Sequence
from html import escape
from itertools import accumulate
from pathlib import Path

SPEED = 10.0
"""Seconds of the demo in one second of the picture."""
STEP_S = 0.12
"""Least time between two lines, s: a table runs past instead of jumping over what does not fit."""
READING_S = 8.0
"""Time for which the end stands, s."""
COLUMNS, ROWS, LINE_PX, LETTER_PX = 112, 26, 18, 7.8
TIME = re.compile(r"\[ *([\d.]+) s\]")
PROGRESS = re.compile(r"\(\d+ %, \d+ s left\)$")
STYLE = (
    "text{font:13px ui-monospace,SFMono-Regular,Menlo,Consolas,monospace;fill:#d7dde5;white-space:pre}"
    "@media(prefers-reduced-motion:reduce){*{animation:none!important}}"
)


def lines_of(log: str, folder: str) -> Iterator[tuple[float, str]]:
    """Yield the lines of a log with their times, s; a line without a time has that of the line before."""
    now = 0.0
    for line in log.splitlines():
        if found := TIME.match(line):
            now = float(found[1])
        if line.strip() and not PROGRESS.search(line):
            yield now, line.replace(folder.rstrip("/") + "/", "")[:COLUMNS]


def picture(lines: Sequence[tuple[float, str]]) -> str:
    """Return the SVG of lines with their times, s."""
    shown = list(accumulate((time / SPEED for time, _ in lines), lambda before, time: max(before + STEP_S, time)))
    total = shown[-1] + READING_S
    width, height = round(COLUMNS * LETTER_PX) + 24, ROWS * LINE_PX + 20
    over = max(len(lines) - ROWS, 0) * LINE_PX
    shares = [100 * time / total for time in shown]
    scroll = "".join(
        f"{share:.2f}%{{transform:translateY({-LINE_PX * (k + 1 - ROWS)}px)}}"
        for k, share in enumerate(shares)
        if k >= ROWS
    )
    play = f"{total:.1f}s step-end infinite"
    styles = [
        f"g{{transform:translateY({-over}px);animation:s {play}}}@keyframes s{{0%{{transform:none}}{scroll}}}",
        *(
            f"#l{k}{{animation:k{k} {play}}}@keyframes k{k}{{0%{{opacity:0}}{share:.2f}%{{opacity:1}}}}"
            for k, share in enumerate(shares)
        ),
    ]
    texts = [
        f'<text id="l{k}" x="12" y="{LINE_PX * (k + 1) - 4}">{escape(line)}</text>' for k, (_, line) in enumerate(lines)
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">'
        f"<title>Output of armident demo, {SPEED:g} times as fast</title><style>{STYLE}{''.join(styles)}</style>"
        f'<rect width="100%" height="100%" rx="8" fill="#171c24"/>'
        f'<svg y="8" height="{ROWS * LINE_PX}"><g>{"".join(texts)}</g></svg></svg>\n'
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("svg", type=Path)
    parser.add_argument("--folder", default=str(Path.cwd()), help="folder that is left out of paths")
    given = parser.parse_args()
    given.svg.write_text(picture(list(lines_of(given.log.read_text(encoding="utf-8"), given.folder))), encoding="utf-8")


if __name__ == "__main__":
    main()
