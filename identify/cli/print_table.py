"""Tables on a terminal of any width: no word is broken, and no column is cut off."""

import re

from rich.console import Console
from rich.table import Table
from rich.text import Text

WORD = re.compile(r"\S+(?: (?:±|\+-) \S+)*")
"""Word, or a value with its uncertainty, which stays on one line."""

FRAME = 3
"""Characters of a column beside its text: padding and border; the table has one border more."""


def print_table(table: Table, console: Console | None = None) -> None:
    """Print a table; on a terminal that is too narrow as a list, one line per cell. A file or a pipe has no width."""
    console = console or Console()
    columns = [[_plain(cell) for cell in (column.header, *column.cells)] for column in table.columns]
    least = [max((len(word) for cell in cells for word in WORD.findall(cell)), default=1) for cells in columns]
    widest = [max(map(len, cells)) for cells in columns]
    width = console.width if console.is_terminal else max(console.width, sum(least) + FRAME * len(columns) + 1)
    room = width - sum(least) - FRAME * len(columns) - 1
    if room < 0:
        _print_list(_plain(table.title or ""), columns, console)
        return
    wanted = sum(widest) - sum(least)
    for column, low, high in zip(table.columns, least, widest, strict=True):
        column.width = low + (high - low if wanted <= room else (high - low) * room // wanted)
    console.width = width
    console.print(table)


def _print_list(title: str, columns: list[list[str]], console: Console) -> None:
    """Print the rows of a table one after the other; an empty first cell repeats the one above."""
    if title:
        console.print(Text(title, style="italic"), soft_wrap=True)
    headers, *rows = zip(*columns, strict=True)
    last = ""
    for name, *values in rows:
        last = name or last
        console.print(Text(f"{headers[0]}: {last}", style="bold"), soft_wrap=True)
        for header, value in zip(headers[1:], values, strict=True):
            if value:
                console.print(Text(f"  {header}: {value}" if header else f"  {value}"), soft_wrap=True)


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else Text.from_markup(str(cell)).plain
