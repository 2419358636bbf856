"""Tables and claims as Markdown and JSON."""

import json
import math
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from tests.reproduction.claims import Claim
from tests.reproduction.tables import Cell, Column, Source, Table
from tests.tools.markdown import table as markdown_table

SCHEMA = "armident/reproduction/1"
SOURCES: tuple[Source, ...] = ("thesis", "virtual", "measured", "arm")
HEADINGS = {"thesis": "thesis", "virtual": "ours", "measured": "ours, measured arm", "arm": "virtual arm"}


def side_by_side(table: Table) -> list[Column]:
    """Return the columns of a table by method: that of the thesis, then ours."""
    names = list(dict.fromkeys(column.name for column in table.columns if column.source != "arm"))
    order = {name: k for k, name in enumerate(names)}
    return sorted(table.columns, key=lambda c: (order.get(c.name, len(order)), SOURCES.index(c.source)))


def text_of(cell: Cell | None) -> str:
    """Return a figure with four digits and its relative standard deviation, or the text of a cell."""
    if cell is None or cell.value is None:
        return cell.text if cell is not None else ""
    value = f"{cell.value:.4g}"
    return value if cell.std_pct is None else f"{value} ({cell.std_pct:.3g} %)"


def markdown(tables: Sequence[Table], claims: Sequence[Claim]) -> str:
    """Return tables and claims as a Markdown page. ``tables``: reproduced tables; ``claims``: tested claims."""
    lines = ["# Tables of the thesis and their reproduction", ""]
    lines += ["Estimates: value (relative standard deviation); SI, joint side.", ""]
    if claims:
        lines += ["## Claims", ""]
    for claim in claims:
        lines += [f"{claim.number}. **{_verdict(claim.holds)}**: {claim.text}"]
        lines += [f"   - {_verdict(finding.holds)}: {finding.text}" for finding in claim.findings]
        lines += [f"   - why: {claim.remark}"] if claim.remark and not claim.holds else []
    lines += [""] if claims else []
    for table in tables:
        columns = side_by_side(table)
        lines += [f"## Table {table.number}: {table.title}", ""]
        headings = ["", *(f"{c.name}, {HEADINGS[c.source]}" for c in columns)]
        rows = ([label, *(text_of(c.cells.get(label)) for c in columns)] for label in table.labels)
        lines += [
            markdown_table(headings, rows),
            "",
            *(f"- {note}" for note in table.notes),
            *([""] if table.notes else []),
        ]
    return "\n".join(lines)


def document(tables: Sequence[Table], claims: Sequence[Claim], *, quick: bool) -> str:
    """Return tables and claims as JSON; figures that are not finite become null.

    ``tables``: reproduced tables; ``claims``: tested claims; ``quick``: recorded in the document: True if fewer
    simulations were made, without the slow tables.
    """
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "version": version("armident"),
        "quick": quick,
        "claims": [
            {
                "number": claim.number,
                "claim": claim.text,
                "holds": claim.holds,
                "remark": claim.remark if not claim.holds else "",
                "findings": [{"holds": f.holds, "finding": f.text} for f in claim.findings],
            }
            for claim in claims
        ],
        "tables": [
            {
                "number": table.number,
                "title": table.title,
                "rows": list(table.labels),
                "columns": [_column(column, table.labels) for column in side_by_side(table)],
                "notes": list(table.notes),
            }
            for table in tables
        ],
    }
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _column(column: Column, labels: Sequence[str]) -> dict[str, Any]:
    cells = [column.cells.get(label, Cell(None)) for label in labels]
    content: dict[str, Any] = {
        "source": column.source,
        "name": column.name,
        "values": [_number(c.value) for c in cells],
    }
    if any(cell.std_pct is not None for cell in cells):
        content["std_pct"] = [_number(cell.std_pct) for cell in cells]
    if any(cell.text for cell in cells):
        content["texts"] = [cell.text for cell in cells]
    return content


def _number(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _verdict(holds: bool) -> str:
    return "holds" if holds else "does not hold"
