"""Commands of the bus."""

from pathlib import Path
from typing import Annotated

import typer


def bus_load(
    config: Annotated[Path, typer.Option("--config", help="Session configuration.")] = Path("tx40_cell.yaml"),
    bitrate: Annotated[
        int | None, typer.Option("--bitrate", min=10_000, help="Bit rate in bit/s, instead of the configuration's.")
    ] = None,
) -> None:
    """Compute the load of the bus from a configuration, and refuse what cannot fit.

    Example: armident bus-load --config tx40_cell.yaml --bitrate 1000000
    """
    from rich.console import Console
    from rich.table import Table

    from configs import load_session
    from drivers.bus_load import check_fits, loads

    session = load_session(config)
    if bitrate is not None:
        session = session.model_copy(update={"bus": session.bus.model_copy(update={"bitrate": bitrate})})
    virtual = session.bus.bitrate is None
    table = Table(title=f"{session.bus.channel}, SYNC every {session.sync.period_us} us")
    table.add_column("message")
    for heading in ("frames/s", "typical", "worst case"):
        table.add_column(heading, justify="right")

    def share(value: float) -> str:
        return "-" if virtual else f"{100 * value:.1f} %"

    rows = loads(session)
    for row in rows:
        table.add_row(row.message, f"{row.frames_per_s:.0f}", share(row.typical), share(row.worst))
    table.add_section()
    total = sum(row.frames_per_s for row in rows)
    table.add_row("total", f"{total:.0f}", share(sum(r.typical for r in rows)), share(sum(r.worst for r in rows)))
    console = Console()
    console.print(table)
    if virtual:
        console.print("The bus is virtual: it has no bit rate to fill (--bitrate 1000000 shows a physical one).")
    check_fits(session, str(config))
