"""Plant of `tests.faults.week`: cells with processes that are started again as systemd does, and with their files."""

import mmap
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import can
import numpy as np
import yaml
import zstandard

from armident.configs import SessionConfig, load_session
from armident.configs.loading import HERE
from armident.configs.schema.session import Bus
from armident.daq.capture.recording_files import capture_stamp
from armident.daq.identity.certificates import new_authority, read_authority, write_identity
from armident.daq.identity.plant import enrol, make_authority
from armident.daq.identity.signatures import Signer, Trust
from armident.daq.recording import mcap_records, write_recording
from armident.drivers.can.udp import open_python_can
from tests.fixtures import arms, processes
from tests.integration.test_attacks_on_wire import ROUTER, Plant, issue

RESTART_S = 2.0
"""Time after which a process that has ended is started again, s; systemd waits 10 s."""
CAPTURE_S = 20
"""Duration of a capture, s."""
WEEK = datetime(2026, 1, 5, tzinfo=UTC)
"""Begin of the week in the names of the recordings."""
DISK_MB = 512
"""Size of the disk of a cell, MB."""

_one = threading.Lock()
"""Held where a process is started, or a recording is written."""


def set_clock(path: Path, offset_s: float) -> None:
    """Write the offset of a clock, s, which a process adds to its time of the day."""
    with path.open("r+b" if path.exists() else "wb") as file:
        file.write(struct.pack("d", offset_s))


def with_clock(path: Path, words: Sequence[str]) -> None:
    """Carry out a command whose time of the day follows the clock in a file; certificates are judged by it, too."""
    with path.open("rb") as file:
        offset = mmap.mmap(file.fileno(), 8, access=mmap.ACCESS_READ)
    now_s, now_ns = time.time, time.time_ns

    def shifted_ns() -> int:
        return now_ns() + int(1e9 * struct.unpack("d", offset[:8])[0])

    time.time, time.time_ns = lambda: now_s() + struct.unpack("d", offset[:8])[0], shifted_ns
    for kind in (Signer, Trust):  # Their defaults are older than this clock.
        vars(kind)["__init__"].__defaults__ = (shifted_ns,)
    processes._command([*words])


class Service:
    """Process that is started again after it has ended, until it is closed; not while it is ``away``.

    ``lives``: resident memory (MB) and open files of each process, every second.
    """

    def __init__(self, start: Callable[[Any], Any], log: Path) -> None:
        self._closing, self.away = threading.Event(), threading.Event()
        self.pid: int | None = None
        self.lives: list[list[tuple[float, int]]] = []
        self._thread = threading.Thread(target=self._run, args=(start, log), daemon=True)
        self._thread.start()

    def kill(self, sig: int = signal.SIGKILL) -> None:
        with suppress(ProcessLookupError):
            if self.pid is not None:
                os.kill(self.pid, sig)

    def close(self) -> None:
        """End the process, by SIGKILL if it does not end by itself."""
        self._closing.set()
        self.kill(signal.SIGTERM)
        self._thread.join(60.0)
        self.kill()
        self._thread.join()

    def _run(self, start: Callable[[Any], Any], path: Path) -> None:
        while not self._closing.wait(RESTART_S if self.lives else 0.0):
            if self.away.is_set():
                continue
            with path.open("a") as log, _one:
                process = start(log)
            life: list[tuple[float, int]] = []
            self.lives.append(life)
            self.pid = process.pid
            while process.poll() is None:
                with suppress(OSError):
                    pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
                    life.append((pages * os.sysconf("SC_PAGE_SIZE") / 1e6, len(os.listdir(f"/proc/{self.pid}/fd"))))
                time.sleep(1.0)
            self.pid = None


@dataclass
class Fed:
    """File in the folder of a cell; ``sha256`` of its samples, ``None`` if it is not whole.

    ``withdrawn``: it was deleted or replaced, perhaps before anybody read it.
    """

    kind: str
    path: Path
    sha256: str | None
    withdrawn: bool = False


@dataclass
class Cell:
    """Cell of the plant: its folders, and the files that it was given."""

    name: str
    place: Path
    config: Path
    has_disk: bool
    fed: list[Fed] = field(default_factory=list)

    @property
    def recordings(self) -> Path:
        return self.place / "recordings"

    @property
    def results(self) -> Path:
        return self.place / "results"

    @property
    def clock(self) -> Path:
        return self.config.with_suffix(".clock")

    @property
    def session(self) -> SessionConfig:
        return load_session(self.config)

    def resize(self, *, full: bool) -> None:
        """Leave no space on the disk of the cell, or give it back."""
        now = os.statvfs(self.place)
        size = (now.f_blocks - now.f_bfree) * now.f_frsize if full else DISK_MB << 20
        subprocess.run(["mount", "-o", f"remount,size={size}", self.place], check=True)

    def feed(self, kind: str, slot: int, size: float, stop: threading.Event) -> None:
        """Put a file of a kind into the folder; ``size``, from 0 to 1, sets where it is torn and how long it takes."""
        path = self.recordings / f"emps-{capture_stamp(WEEK + timedelta(minutes=30 * slot))}.mcap"
        data, digest = self._content(2 * slot, kind)
        whole = kind not in ("torn", *POISON)
        fed = Fed(kind, path, digest if whole else None)
        begun = int(len(data) * (0.1 + 0.8 * size))
        if kind in ("half", "torn"):
            until_done(lambda: path.write_bytes(data[:begun]))
        else:
            self._place(path, POISON[kind](data) if kind in POISON else data)
        if kind == "huge":
            os.truncate(path, 6 << 30)
        if kind in ("half", "replaced", "deleted"):
            stop.wait(3.0 + 12.0 * size)
        if kind == "half":
            until_done(lambda: _write_at(path, begun, data[begun:]))
        self.fed.append(fed)
        if kind == "deleted":
            path.unlink()
        if kind in ("replaced", "copy"):
            # A copy stays beside the first file, under the next name.
            fed.withdrawn = kind == "replaced"
            data, digest = (data, digest) if kind == "copy" else self._content(2 * slot + 1, kind)
            path = path if kind == "replaced" else path.with_stem(f"{path.stem[:-2]}1Z")
            self._place(path, data)
            self.fed.append(Fed(kind, path, digest))
        fed.withdrawn = fed.withdrawn or kind == "deleted"

    def _content(self, number: int, kind: str) -> tuple[bytes, str]:
        """Return a recording whose first samples make it differ from all others, and the hash of its samples."""
        base = arms.recording("emps", "emps_excitation", int(self.name[-1]), period=4e-3)
        streams = {}
        for name, stream in base.streams.items():
            raw = {key: values.copy() for key, values in stream.raw.items()}
            for values in raw.values():
                values[:2] += np.asarray([[number % 100], [number // 100]], values.dtype)
            streams[name] = replace(stream, raw=raw)
        session = self.session.model_copy(update={"cell": "elsewhere" if kind == "other cell" else self.name})
        made, path = replace(base, streams=streams, session=session), self.config.with_suffix(".mcap")
        with _one:
            write_recording(made, path)
            return path.read_bytes(), made.sha256

    def _place(self, path: Path, data: bytes) -> None:
        until_done(lambda: (self.place / path.name).write_bytes(data))
        until_done(lambda: os.replace(self.place / path.name, path))


def until_done(action: Callable[[], Any]) -> None:
    """Do what a full disk refuses, again and again."""
    while True:
        with suppress(OSError):
            action()
            return
        time.sleep(1.0)


def _write_at(path: Path, offset: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(data)


def _bomb(data: bytes) -> bytes:
    """Return a recording whose chunks unpack to 10.7 GB."""
    raw = bytes(1 << 26)
    chunk = mcap_records.chunk(0, 1, raw, zstandard.compress(raw))
    records = mcap_records.records(memoryview(data), len(mcap_records.MAGIC))
    first = next(at for opcode, at, _ in records if opcode == 6)
    return data[:first] + 160 * chunk + mcap_records.MAGIC


POISON: dict[str, Callable[[bytes], bytes]] = {
    "bomb": _bomb,
    "damaged": lambda data: data[: len(data) // 3] + bytes(2000) + data[len(data) // 3 + 2000 :],
    "no recording": lambda _: b"no recording" + mcap_records.MAGIC,
    "empty": lambda _: b"",
    "huge": lambda data: data[: len(data) // 2],
}
"""Contents that are no recordings, made from that of one."""
KINDS = ("half", "torn", "replaced", "deleted", "copy", "other cell", *POISON)
"""Kinds of files beside whole ones."""


class WeekPlant(Plant):
    """Three cells with workers, the router between them, the keys of all, and in the last cell a capture and its arm.

    ``bus``: of the arm; ``None`` where there is no multicast, and no capture.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "plant")
        self.logs = folder / "logs"
        self.logs.mkdir(parents=True)
        self._make_keys()
        self.bus = _udp_bus()
        self.cells = [self._cell(folder, f"week_{k}") for k in (1, 2, 3)]
        self.services: dict[str, Service] = {}
        self._serve("router", self._router)
        for cell in self.cells:
            words = ["worker", "--config", str(cell.config), "--out", str(cell.results)]
            self._serve(cell.name, with_clock, cell.clock, words)
        words = ["--config", str(cell.config)]
        if self.bus is not None:
            self._serve("robot", processes._command, ["robot", *words, "--noise", "0"])
            own = ["--out", str(cell.recordings), "--duration", str(CAPTURE_S)]
            self._serve("capture", processes._command, ["capture", *words, *own])

    def close(self) -> None:
        """End all processes, the router last; keep the ledgers, and give the disks back."""
        for service in reversed(self.services.values()):
            service.close()
        for cell in self.cells:
            for path in cell.results.glob("worker.sqlite*"):
                shutil.copy(path, self.logs / f"{cell.name}.{path.name}")
            if cell.has_disk:
                subprocess.run(["umount", "-l", cell.place], check=True)

    def install(self, name: str) -> None:
        """Copy a key and then its certificate from the authority to the hosts."""
        for suffix in ("key", "pem"):
            shutil.copy(self.folder / f"{name}.{suffix}", self.host / f".{name}.{suffix}")
            os.replace(self.host / f".{name}.{suffix}", self.host / f"{name}.{suffix}")

    def shorten(self, cell: Cell, seconds: float) -> None:
        """Replace the certificate of a worker on its host by one that ends soon."""
        begin = datetime.now(UTC) - timedelta(days=9, seconds=-seconds)
        write_identity(
            self.host, read_authority(self.folder).issue("worker", cell.name, f"worker.{cell.name}", [], 9, begin)
        )

    def _make_keys(self) -> None:
        make_authority(self.folder, "werk")
        enrol(self.folder, "router", None, None, ["localhost"], 365)
        for cell in ("week_1", "week_2", "week_3"):
            enrol(self.folder, "capture", cell, None, [], 365)
            enrol(self.folder, "worker", cell, None, [], 365)
        enrol(self.folder, "viewer", None, "control", [], 365)
        enrol(self.folder, "viewer", "week_1", "anna", [], 365)
        self.host.mkdir()
        self.stolen.mkdir()
        for path in [*self.folder.glob("*.pem"), *self.folder.glob("*.*.key")]:
            shutil.copy(path, self.stolen if "anna" in path.name else self.host)
        issue(read_authority(self.folder), self.stolen, "expired", now=datetime.now(UTC) - timedelta(days=10))
        issue(new_authority("werk", 9), self.stolen, "foreign")

    def _cell(self, folder: Path, name: str) -> Cell:
        place = folder / name
        place.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "disk", str(place)]
        has_disk = os.geteuid() == 0 and subprocess.run(mount, check=False, capture_output=True).returncode == 0
        data = yaml.safe_load((HERE / "cells" / "emps_cell.yaml").read_text(encoding="utf-8")) | {
            "cell": name,
            "recording": {"directory": str(place / "recordings")},
            "zenoh": {"connect": [self.place], "keys": str(self.host), "commands": True},
            "identification": {"method": "idim-ls"},
        }
        if self.bus is not None:
            data |= {
                "bus": {"interface": "udp_multicast", "channel": self.bus.channel, "bitrate": 1_000_000},
                "sync": {"role": "producer", "period_us": 20_000, "counter": 240},
                "setpoints": None,
            }
        cell = Cell(name, place, folder / f"{name}.yaml", has_disk)
        cell.config.write_text(yaml.safe_dump(data))
        set_clock(cell.clock, 0.0)
        cell.recordings.mkdir()
        cell.results.mkdir()
        return cell

    def _router(self, log: Any) -> Any:
        command = [sys.executable, "-c", ROUTER, self.place]
        return subprocess.Popen(command, cwd=self.folder, stdin=subprocess.PIPE, stdout=log, stderr=log)

    def _serve(self, name: str, function: Callable[..., Any], *arguments: Any) -> None:
        def start(log: Any) -> Any:
            return function(log) if not arguments else processes.start(function, *arguments, stdout=log, stderr=log)

        self.services[name] = Service(start, self.logs / f"{name}.log")


def _udp_bus() -> Bus | None:
    bus = Bus(interface="udp_multicast", channel=f"239.77.{os.getpid() >> 8 & 255}.{os.getpid() & 255}")
    with suppress(can.CanError):
        open_python_can(bus).shutdown()
        return bus
    return None
