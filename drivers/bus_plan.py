"""The nearest sessions that buses can carry: lower rate, more buses, CAN FD, packed samples, and what goes together."""

from collections.abc import Iterator
from dataclasses import dataclass

from armident.configs import SessionConfig
from armident.configs.errors import ConfigError
from armident.configs.session import Bus
from armident.drivers.bus_load import fits, fitting_period
from armident.drivers.objects import FD_PDO_BYTES, MAPPED_OBJECTS, TpdoLayout

DATA_BITRATES = (2_000_000, 5_000_000, 8_000_000)
"""Data bit rates that CAN FD controllers commonly offer."""


@dataclass(frozen=True)
class Option:
    """One way to make a session fit: what would change, in words, and how much that is."""

    text: str
    session: SessionConfig
    kinds: int
    """How many kinds of change it takes: the fewer, the nearer."""
    size: float
    """By what factor the largest of them changes something."""


def alternatives(session: SessionConfig) -> list[Option]:
    """Sessions that fit, the nearest first: fewest kinds of change, then the smallest one.

    Of each combination of kinds (rate, buses, FD, packing) the smallest change is listed, and none that only adds
    to another one.
    """
    found = sorted(_all_options(session), key=lambda option: (option.kinds, option.size))
    chosen: list[Option] = []
    for option in found:
        parts = set(_kinds(option.text))
        if not any(set(_kinds(other.text)) <= parts for other in chosen):
            chosen.append(option)
    return chosen


def _kinds(text: str) -> list[str]:
    return [part.split()[0] for part in text.split(" with ")]


def _all_options(session: SessionConfig) -> Iterator[Option]:
    slower = fitting_period(session)
    if slower is not None:
        changed = session.model_copy(update={"sync": session.sync.model_copy(update={"period_us": slower})})
        yield Option(f"sync.period_us {slower}", changed, 1, slower / session.sync.period_us)
    for fd_rate in (None, *DATA_BITRATES):
        base = session if fd_rate is None else _with_fd(session, fd_rate)
        if base is None:
            continue
        for pack in _packs(base):
            packed = _with_pack(base, pack)
            if packed is None:
                continue
            for count in range(len(session.all_buses), len(session.drives) + 1):
                spread = _spread(packed, count)
                if not fits(spread):
                    continue
                yield _option(session, spread, fd_rate, pack, count)
                break


def _option(session: SessionConfig, changed: SessionConfig, fd_rate: int | None, pack: int, count: int) -> Option:
    before = len(session.all_buses)
    parts, sizes = [], [1.0]
    if count > before:
        parts.append(f"buses {count} instead of {before}")
        sizes.append(count / before)
    if fd_rate is not None:
        parts.append(f"fd: true and data_bitrate {fd_rate}")
        sizes.append(fd_rate / (session.all_buses[0].bitrate or fd_rate))
    if pack > session.streams["samples"].pack:
        parts.append(f"pack: {pack} for samples")
        sizes.append(pack / session.streams["samples"].pack)
    return Option(" with ".join(parts), changed, len(parts), max(sizes))


def _with_fd(session: SessionConfig, data_bitrate: int) -> SessionConfig | None:
    """The session with CAN FD on every bus; ``None`` where they have it at this rate or a faster one already."""
    if all(bus.fd and (bus.data_bitrate or 0) >= data_bitrate for bus in session.all_buses):
        return None
    buses = tuple(bus.model_copy(update={"fd": True, "data_bitrate": data_bitrate}) for bus in session.all_buses)
    return _with_buses(session, buses)


def _packs(session: SessionConfig) -> list[int]:
    """Numbers of samples per TPDO that the frame and the SYNC counter allow, from the session's own on."""
    stream = session.streams["samples"]
    if not all(bus.fd for bus in session.all_buses):
        return [stream.pack]
    size = TpdoLayout.of(stream.objects).size if len(stream.objects) else 1
    most = min(FD_PDO_BYTES // size, MAPPED_OBJECTS // len(stream.objects))
    return [k for k in range(stream.pack, most + 1) if session.sync.counter % k == 0]


def _with_pack(session: SessionConfig, pack: int) -> SessionConfig | None:
    stream = session.streams["samples"].model_copy(update={"pack": pack})
    changed = session.model_copy(update={"streams": {**session.streams, "samples": stream}})
    try:
        for name, other in changed.streams.items():
            TpdoLayout.of(other.objects, name, other.pack, all(bus.fd for bus in changed.all_buses))
    except ConfigError:
        return None
    return changed


def _spread(session: SessionConfig, count: int) -> SessionConfig:
    """The drives evenly on ``count`` buses like the first one."""
    if count == len(session.all_buses):
        return session
    first = session.all_buses[0]
    buses = tuple(first.model_copy(update={"channel": f"bus {k}"}) for k in range(count))
    drives = tuple(
        drive.model_copy(update={"bus": buses[k * count // len(session.drives)].channel})
        for k, drive in enumerate(session.drives)
    )
    return _with_buses(session, buses).model_copy(update={"drives": drives})


def _with_buses(session: SessionConfig, buses: tuple[Bus, ...]) -> SessionConfig:
    return session.model_copy(update={"buses": buses})
