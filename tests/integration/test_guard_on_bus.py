"""The guard on a bus: every violation is followed by a quick stop before another SYNC, and nothing else is."""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from armident.configs import ArmidentError, config_path, load_robot
from armident.configs.schema.session import Bus
from armident.configs.units import counts_per_si
from armident.daq.guard.guard_loop import guard
from armident.drivers.can.frames import frame, frames
from armident.drivers.can.udp import open_bus
from armident.drivers.canopen.objects import (
    COB_EMCY,
    COB_HEARTBEAT,
    COB_NMT,
    COB_SDO_REQUEST,
    COB_SYNC,
    rpdo_cob,
    tpdo_cob,
)

PERIOD_S = 0.02
"""SYNC period, s; long in comparison with the wake-up time of a process on a busy machine."""
HEARTBEAT_MS = 100
N = 6
QUICK_STOP = b"\x02\x00"
Change = Callable[["Cell"], None]


@dataclass
class Cell:
    """Frames of drives and master in a cycle; positions in counts, currents in per mille of the rated current."""

    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(N))
    current: NDArray[np.float64] = field(default_factory=lambda: np.zeros(N))
    demand: NDArray[np.float64] = field(default_factory=lambda: np.zeros(N))
    extra: tuple[tuple[int, bytes], ...] = ()
    beating: tuple[int, ...] = tuple(range(1, N + 1))
    setpoints: bool = True
    sync: bool = True

    def cycle(self, k: int) -> list[tuple[int, bytes]]:
        """Return the frames of cycle ``k`` in the order of the bus."""
        out = [(COB_SYNC, bytes([k % 240 + 1]))] if self.sync else []
        for j in range(N):
            sample = int(self.position[j]).to_bytes(4, "little", signed=True)
            sample += int(self.current[j]).to_bytes(2, "little", signed=True) + b"\x37\x12"
            out.append((tpdo_cob(1, j + 1), sample))
            target = int(self.demand[j]).to_bytes(4, "little", signed=True)
            out.append((tpdo_cob(2, j + 1), target))
            if self.setpoints:
                out.append((rpdo_cob(1, j + 1), target))
        out += [(COB_HEARTBEAT + node, b"\x05") for node in self.beating]
        return out + list(self.extra)


def session_file(folder: Path, bus: Bus) -> Path:
    shipped = config_path("tx40_cell.yaml")
    data = yaml.safe_load(shipped.read_text())
    data |= {"cell": "guarded", "robot": str(config_path(data["robot"]))}
    data["bus"] = {"interface": bus.interface, "channel": bus.channel}
    data |= {"sync": {"period_us": round(PERIOD_S * 1e6)}, "heartbeat_ms": HEARTBEAT_MS}
    for drive in data["drives"]:
        drive["eds"] = str(config_path(drive["eds"]))
    data["setpoints"] |= {"trajectory": str(config_path(data["setpoints"]["trajectory"])), "every": 1}
    path = folder / "guarded.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def _guarded(config: Path, log: Path) -> None:
    """Run the guard as the command does, with its output in a file."""
    with log.open("w", buffering=1) as out:
        sys.stdout = sys.stderr = out
        try:
            guard(str(config))
        except ArmidentError as error:
            print(error)
            out.flush()
            os._exit(error.exit_code)
    os._exit(0)


class Guarded:
    """The guard in a forked process, which saves the imports in every test."""

    def __init__(self, folder: Path, bus: Bus) -> None:
        self._log = folder / "guard.log"
        self._log.touch()
        config = session_file(folder, bus)
        self.process = multiprocessing.get_context("fork").Process(target=_guarded, args=(config, self._log))
        self.process.start()
        until = time.monotonic() + 60
        while "ready" not in self.text and self.process.is_alive() and time.monotonic() < until:
            time.sleep(0.02)
        assert "ready" in self.text, self.text

    @property
    def text(self) -> str:
        return self._log.read_text()

    def end(self) -> tuple[int | None, str]:
        """Return exit code and output of the process."""
        self.process.join(60)
        return self.process.exitcode, self.text


@pytest.fixture
def guarded(udp_bus: Bus, tmp_path: Path) -> Iterator[Guarded]:
    running = Guarded(tmp_path, udp_bus)
    yield running
    running.process.kill()
    running.process.join()


@dataclass
class Dump:
    """Frames on the bus, as candump shows them: kernel time (ns), identifier, data."""

    rows: list[tuple[int, int, bytes]]

    def first(self, wanted: Callable[[int, bytes], bool]) -> int | None:
        return next((k for k, (_, can_id, data) in enumerate(self.rows) if wanted(can_id, data)), None)

    def orders(self) -> list[int]:
        """Return the indices of quick stop commands, by RPDO and by SDO."""
        words = {rpdo_cob(2, node): QUICK_STOP for node in range(1, N + 1)}
        words |= {COB_SDO_REQUEST + node: b"\x2b\x40\x60\x00" + QUICK_STOP + b"\0\0" for node in range(1, N + 1)}
        return [k for k, (_, can_id, data) in enumerate(self.rows) if words.get(can_id) == data]


def play(
    bus: Bus,
    guarded: Guarded,
    cell: Cell,
    fault: Change,
    quiet: int = 15,
    after: int = 150,
    stops: bool = False,
) -> Dump:
    """Run ``quiet`` cycles without and ``after`` cycles with a fault; return all frames on the bus.

    The run ends three cycles after the guard. If a frame of the first cycle with the fault ``stops`` the arm, no SYNC
    is sent before the guard has ended, however busy the machine is.
    """
    with open_bus(bus, filters=()) as sender, open_bus(bus) as listener:
        batch, rows, ended = frames(4096), [], None
        k = 0
        while k < quiet + after and (ended is None or k < ended + 3):
            if k == quiet:
                fault(cell)
            for can_id, data in cell.cycle(k):
                sender.send(frame(can_id, data))
            time.sleep(PERIOD_S)
            if stops and k == quiet:
                guarded.process.join(60)
            if ended is None and guarded.process.exitcode is not None:
                ended = k
            k += 1
        while listener.poll(0.05):
            got = listener.receive(batch)
            rows += [
                (int(row["t_ns"]), int(row["can_id"]), row["data"][: row["length"]].tobytes()) for row in batch[:got]
            ]
    return Dump(rows)


def check(dump: Dump, offending: int | None, most_syncs: int = 0) -> float:
    """Check that all six drives got both stop commands within ``most_syncs`` SYNCs of a frame; return the delay, ms."""
    assert offending is not None
    orders = dump.orders()
    assert len(orders) == 2 * N, f"{len(orders)} orders"
    assert orders[0] > offending
    syncs = sum(1 for _, can_id, _ in dump.rows[offending + 1 : orders[-1]] if can_id == COB_SYNC)
    late = (dump.rows[orders[-1]][0] - dump.rows[offending][0]) * 1e-6
    print(f"last stop order {late:.2f} ms and {syncs} SYNC after the offending frame")
    assert syncs <= most_syncs
    return late


ROBOT = load_robot("tx40.yaml")
COUNTS = counts_per_si(ROBOT)


def motor_counts(*joints: float) -> NDArray[np.float64]:
    """Return the motor positions (n,), counts, of joint positions, rad."""
    counts: NDArray[np.float64] = np.rint(ROBOT.transmission_matrix @ np.array(joints) * COUNTS)
    return counts


def jumping(cell: Cell) -> None:
    cell.position[:] = cell.demand[:] = motor_counts(0, 1.5, 0, 0, 0, 0)


def overloaded(cell: Cell) -> None:
    cell.current[0] = 32000


def off_its_demand(cell: Cell) -> None:
    cell.demand[:] = motor_counts(0, 0, 1.0, 0, 0, 0)


def sample_of(j: int, changed: bytes) -> Callable[[int, bytes], bool]:
    return lambda can_id, data: can_id == tpdo_cob(1, j + 1) and data[: len(changed)] == changed


@pytest.mark.parametrize(
    ("fault", "says", "offending"),
    [
        (
            jumping,
            "joint_2: velocity",
            sample_of(1, int(motor_counts(0, 1.5, 0, 0, 0, 0)[1]).to_bytes(4, "little", signed=True)),
        ),
        (overloaded, "joint_1: torque", sample_of(0, b"\0\0\0\0" + (32000).to_bytes(2, "little"))),
        (
            off_its_demand,
            "joint_3: following error 1.0000 rad, allowed is 0.75",
            lambda can_id, data: can_id == tpdo_cob(2, 3) and data != b"\0\0\0\0",
        ),
        (
            lambda cell: setattr(cell, "extra", ((COB_EMCY + 4, b"\x10\x43\x08\0\0\0\0\0"),)),
            "joint_4: EMCY 4310h, excess drive temperature",
            lambda can_id, data: can_id == COB_EMCY + 4,
        ),
        (
            lambda cell: setattr(cell, "extra", ((COB_HEARTBEAT + 5, b"\0"),)),
            "joint_5: its drive has left the NMT state operational (state 0)",
            lambda can_id, data: can_id == COB_HEARTBEAT + 5 and data == b"\0",
        ),
    ],
    ids=["velocity", "torque", "following_error", "emcy", "reboot"],
)
def test_an_offending_frame_is_followed_by_a_stop_before_another_sync(
    udp_bus: Bus, guarded: Guarded, fault: Change, says: str, offending: Callable[[int, bytes], bool]
) -> None:
    dump = play(udp_bus, guarded, Cell(), fault, stops=True)
    code, err = guarded.end()
    assert code == 1
    assert says in err
    check(dump, dump.first(offending))


def test_a_position_beyond_its_limit_stops_the_arm(udp_bus: Bus, guarded: Guarded) -> None:
    """From 2.16 rad to 2.19 rad: a step within the limit of velocity."""
    cell = Cell()
    cell.position[:] = cell.demand[:] = motor_counts(0, 2.16, 0, 0, 0, 0)

    def fault(cell: Cell) -> None:
        cell.position[:] = cell.demand[:] = motor_counts(0, 2.19, 0, 0, 0, 0)

    dump = play(udp_bus, guarded, cell, fault, stops=True)
    _, err = guarded.end()
    assert "joint_2: position 2.1900 rad, allowed is -2.18 to 2.18" in err
    wanted = int(motor_counts(0, 2.19, 0, 0, 0, 0)[1]).to_bytes(4, "little", signed=True)
    check(dump, dump.first(sample_of(1, wanted)))


def test_a_lost_heartbeat_stops_the_arm_after_its_timeout(udp_bus: Bus, guarded: Guarded) -> None:
    """The timeout is three periods and 0.1 s."""
    dump = play(udp_bus, guarded, Cell(), lambda cell: setattr(cell, "beating", (1, 2, 4, 5, 6)), after=3000)
    _, err = guarded.end()
    assert "joint_3: no heartbeat for " in err
    beats = [k for k, (_, can_id, _) in enumerate(dump.rows) if can_id == COB_HEARTBEAT + 3]
    late = check(dump, beats[-1], most_syncs=len(dump.rows))
    # The guard takes the time of its last wake-up before the frame, at most a period of SYNC earlier.
    assert late >= 3 * HEARTBEAT_MS + 100 - 1000 * PERIOD_S


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_arm_at_once(udp_bus: Bus, guarded: Guarded, number: signal.Signals) -> None:
    sent = []

    def interrupt(_: Cell) -> None:
        sent.append(time.time_ns())
        assert guarded.process.pid is not None
        os.kill(guarded.process.pid, number)

    dump = play(udp_bus, guarded, Cell(), interrupt, stops=True)
    code, err = guarded.end()
    assert code == 0, err
    before = [k for k, (t, _, _) in enumerate(dump.rows) if t < sent[0]]
    # the cycle in which the signal comes sends its SYNC
    check(dump, before[-1], most_syncs=1)
    print(f"last stop order {(dump.rows[dump.orders()[-1]][0] - sent[0]) * 1e-6:.2f} ms after the signal")


def test_a_capture_that_dies_during_the_motion_is_detected(udp_bus: Bus, guarded: Guarded) -> None:
    def die(cell: Cell) -> None:
        cell.sync = cell.setpoints = False

    dump = play(udp_bus, guarded, Cell(), die)
    _, err = guarded.end()
    assert "no SYNC for " in err
    assert len(dump.orders()) == 2 * N


@pytest.mark.slow
def test_the_regular_end_of_a_motion_is_no_alarm(udp_bus: Bus, guarded: Guarded) -> None:
    """SYNC continues after the last set point, NMT ends the state operational, then no frames follow."""
    cell = Cell()
    play(udp_bus, guarded, cell, lambda cell: setattr(cell, "setpoints", False), quiet=20, after=20)

    def over(cell: Cell) -> None:
        cell.sync = False
        cell.beating = ()
        cell.extra = ((COB_NMT, b"\x80\x01"), (COB_HEARTBEAT + 1, b"\x7f"))

    dump = play(udp_bus, guarded, cell, over, quiet=0, after=40)
    assert guarded.process.is_alive()
    assert dump.orders() == []


def test_there_is_no_alarm_before_the_arm_moves(udp_bus: Bus, guarded: Guarded) -> None:
    """Excess velocity before the first set point: the arm is moved by hand, for example."""
    dump = play(udp_bus, guarded, Cell(setpoints=False), jumping, quiet=10, after=20)
    assert guarded.process.is_alive()
    assert dump.orders() == []
