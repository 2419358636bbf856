"""Command ``armident bus-load``."""

from pathlib import Path
from typing import Annotated

import typer


def bus_load(
    config: Annotated[Path, typer.Option("--config", help="Session configuration.")] = Path("tx40_cell.yaml"),
    bitrate: Annotated[
        int | None, typer.Option("--bitrate", min=10_000, help="Bit rate, bit/s. [default: that of the session]")
    ] = None,
    data_bitrate: Annotated[
        int | None,
        typer.Option(
            "--data-bitrate", min=10_000, help="Data bit rate of CAN FD, bit/s, with --bitrate; makes classic buses FD."
        ),
    ] = None,
) -> None:
    """Compute the load of every bus of a session, and refuse a load that does not fit.

    The error lists the nearest configurations that fit, the smallest change first.

    Example: armident bus-load --config tx40_cell.yaml --bitrate 1000000
    """
    from rich.console import Console
    from rich.table import Table

    from armident.configs import ConfigError, load_session
    from armident.drivers.canopen.bus_load import bus_loads, check_fits

    session = load_session(config, "bus-load")
    if data_bitrate is not None and bitrate is None:
        raise ConfigError("--data-bitrate: needs --bitrate")
    if bitrate is not None:
        rates = {"bitrate": bitrate} if data_bitrate is None else {"bitrate": bitrate, "data_bitrate": data_bitrate}
        buses = tuple(
            bus.model_copy(update=rates | {"fd": bus.fd or data_bitrate is not None}) for bus in session.all_buses
        )
        unknown = [bus.channel for bus in buses if bus.fd and bus.data_bitrate is None]
        if unknown:
            raise ConfigError(f"--bitrate: {', '.join(unknown)}: a CAN FD bus needs --data-bitrate, too")
        session = session.model_copy(update={"buses": buses})
    console = Console()
    for bus in session.all_buses:
        virtual = bus.bitrate is None
        kind = "CAN FD" if bus.fd else "classic"
        table = Table(title=f"{bus.channel} ({kind}), SYNC every {session.sync.period_us} us")
        table.add_column("message", no_wrap=True)
        for heading in ("frames/s", "typical", "worst case"):
            table.add_column(heading, justify="right")

        def share(value: float, hidden: bool = virtual) -> str:
            return "-" if hidden else f"{100 * value:.1f} %"

        rows = bus_loads(session, bus)
        for row in rows:
            table.add_row(row.message, f"{row.frames_per_s:.0f}", share(row.typical), share(row.worst))
        table.add_section()
        total = sum(row.frames_per_s for row in rows)
        table.add_row("total", f"{total:.0f}", share(sum(r.typical for r in rows)), share(sum(r.worst for r in rows)))
        console.print(table)
    if all(bus.bitrate is None for bus in session.all_buses):
        fd = " --data-bitrate 5000000" if session.all_buses[0].fd else ""
        console.print(f"Virtual buses have no bit rate; for physical buses add --bitrate 1000000{fd}.")
    check_fits(session, str(config))
