"""Logs as tools write them: damaged, in other spellings, and with clocks that contradict the session."""

import logging
import re
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from armident.configs import ConfigError, DataError
from armident.daq.cli import application
from armident.daq.interchange import bus_log
from armident.daq.interchange.bus_log import recording_from_log, write_log
from armident.daq.interchange.log_file import read_log
from armident.daq.interchange.log_lines import asc_date_ns
from armident.daq.matching.streams import captured_streams
from armident.daq.recording import Recording
from tests.unit.daq.test_bus_log import PERIOD_NS, ROBOT, SESSION, captured

ROWS = 120


def lines_of(folder: Path, suffix: str) -> tuple[Path, list[str]]:
    """Return a log of ``ROWS`` SYNCs and its lines."""
    path = folder / f"bus{suffix}"
    write_log(captured(ROWS), path)
    return path, path.read_text().splitlines(keepends=True)


def read(path: Path) -> Recording:
    return recording_from_log(path, SESSION, ROBOT)


def same(found: Recording, rows: int = ROWS) -> bool:
    """Return ``True`` if the first rows are those that were written."""
    expected = captured(ROWS).samples.raw["position"][:rows]
    return np.array_equal(found.samples.raw["position"][:rows], expected) and len(found.samples.sync) >= rows


@pytest.mark.parametrize("suffix", [".log", ".asc", ".trc"])
@pytest.mark.parametrize("cut", [4, 12, 25])
def test_a_last_line_that_is_cut_off_is_left_out_and_said(
    tmp_path: Path, suffix: str, cut: int, caplog: pytest.LogCaptureFixture
) -> None:
    path, lines = lines_of(tmp_path, suffix)
    last = max(k for k, line in enumerate(lines) if "186" in line)
    length = len(lines[last].split("  Length")[0].rstrip())
    path.write_text("".join(lines[:last]) + lines[last][: length - cut])
    with caplog.at_level(logging.WARNING):
        found = read(path)
    assert same(found, ROWS - 1)
    assert "the last line" in caplog.text
    assert "cut off" in found.metadata["source_remarks"]
    assert found.counters["log.skipped"] == 1


def test_a_last_line_without_an_end_is_read_if_it_is_whole(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    path.write_text("".join(lines).rstrip("\n"))
    found = read(path)
    assert same(found)
    assert "source_remarks" not in found.metadata


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_blf_that_is_cut_off_is_read_up_to_there_and_said(
    tmp_path: Path, share: float, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "bus.blf"
    write_log(captured(3000), path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with caplog.at_level(logging.WARNING):
        found = read(path)
    rows = found.samples.sync.size
    assert 0.5 * share * 3000 < rows < 3000
    np.testing.assert_array_equal(found.samples.raw["position"], captured(3000).samples.raw["position"][:rows])
    assert "the file is cut off" in caplog.text
    assert "of 24600 frames" in found.metadata["source_remarks"]


@pytest.mark.slow
def test_a_damaged_block_of_a_blf_is_a_gap(tmp_path: Path) -> None:
    path = tmp_path / "bus.blf"
    write_log(captured(9000), path)
    data = bytearray(path.read_bytes())
    second = data.index(b"LOBJ", data.index(b"LOBJ") + 4)
    data[second + 4000 : second + 4400] = b"\xff" * 400
    path.write_bytes(data)
    found = read(path)
    assert "1 damaged block left out" in found.metadata["source_remarks"]
    assert 5000 < found.samples.sync.size < 9000
    assert found.samples.sync[-1] == 8999
    assert found.gaps


def test_screen_formats_of_candump_are_read(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    shown, extra = [], []
    for k, line in enumerate(lines):
        stamp, channel, frame = line.split()[:3]
        identifier, data = frame.split("#")
        octets = " ".join(data[j : j + 2] for j in range(0, len(data), 2))
        shown.append(f" {stamp}  {channel}  {identifier}   [{len(data) // 2}]  {octets}\n")
        extra.append(f" {stamp}  {channel}  {'TX' if k % 2 else 'RX'} - -  {shown[-1].split('  ', 2)[2][:-1]}   '..'\n")
    untimed = [line.split(")")[1] for line in shown]
    for text in (shown, extra):
        path.write_text("".join(text))
        assert same(read(path))
    path.write_text("".join(untimed))
    with pytest.raises(DataError, match=r"frames have no times.*candump -l. or .candump -L"):
        read(path)


def test_other_frames_and_lines_of_a_log_are_counted_and_named(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    stamp = lines[10].split()[0]
    lines[10:10] = [
        f"{stamp} vcan0 7A1#1122334455667788_B\n",
        f"{stamp} vcan0 123##3001122\n",
        f"{stamp} vcan0 18FF50E5#01\n",
        f"{stamp} vcan0 20000080#0000000000000000\n",
        f"{stamp} vcan0 321#R4\n",
        "# a comment\n",
        "\n",
    ]
    lines.insert(0, "Disabled standard output while logging.\n")
    path.write_text("".join(lines))
    found = read(path)
    assert same(found)
    assert found.counters["log.foreign"] == 4
    assert found.counters["log.skipped"] == 1
    assert found.metadata["source_remarks"] == (
        "line 1 is not a line of a candump log and left out: 'Disabled standard output while logging.'"
    )


def test_a_tpdo_of_another_length_is_named_with_both_lengths(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    short = [line.split()[0] + f" vcan0 {line.split()[2][:-4]}\n" if " 183#" in line else line for line in lines]
    path.write_text("".join(short))
    with pytest.raises(DataError, match=r"TPDO 183h of joint_3 has 6 bytes, the session maps 8 \(position, current"):
        read(path)
    place = lines.index(next(line for line in lines[900:] if " 183#" in line))
    lines[place] = short[place]
    path.write_text("".join(lines))
    found = read(path)
    assert "183h of joint_3 has 6 bytes" in found.metadata["source_remarks"]
    assert f"1 of {ROWS} frames" in found.metadata["source_remarks"]
    assert {gap.joint for gap in found.gaps if gap.stream == "samples"} == {"joint_3"}


def test_a_joint_that_is_not_in_the_log_is_named(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    path.write_text("".join(line for line in lines if " 184#" not in line))
    with pytest.raises(DataError, match=r"answered by all drives.*there is none of joint_4$"):
        read(path)


def test_a_log_with_another_sync_period_than_the_session_is_refused(tmp_path: Path) -> None:
    path, _ = lines_of(tmp_path, ".log")
    for period_us, said in ((1000, "1 ms"), (250, "0.25 ms"), (100, "0.1 ms")):
        other = SESSION.model_copy(update={"sync": SESSION.sync.model_copy(update={"period_us": period_us})})
        with pytest.raises(
            DataError, match=rf"SYNC comes every 0\.2 ms \(5000 Hz\).*every {said} in the session \(sync\.period_us"
        ):
            recording_from_log(path, other, ROBOT)
        command = ["import", str(path), "--config", "tx40_cell.yaml", "--out", str(tmp_path / "a.mcap")]
        assert CliRunner().invoke(application(["import"]), command).exit_code == 0


@pytest.mark.slow
def test_missing_syncs_and_jitter_are_no_other_period(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    write_log(captured(3000, lost=slice(500, 1200)), path)
    rng = np.random.default_rng(2)
    late = 0.0
    moved = []
    for line in path.read_text().splitlines():
        stamp, rest = line.split(" ", 1)
        # A host that is late now and then, by up to 20 SYNCs.
        late = rng.uniform(0, 20 * PERIOD_NS * 1e-9) if rng.random() < 0.001 else late * 0.9
        moved.append(f"({float(stamp[1:-1]) + late:.6f}) {rest}\n")
    path.write_text("".join(moved))
    found = read(path)
    assert found.sample_rate_hz == 5000
    assert found.counters["samples.rows"] + found.counters["samples.in_gaps"] == found.counters["samples.expected"]


@pytest.mark.parametrize("screen", [False, True])
def test_differences_of_times_in_candump_are_added_up(tmp_path: Path, screen: bool) -> None:
    path, lines = lines_of(tmp_path, ".log")
    times = np.maximum.accumulate([float(line.split()[0][1:-1]) for line in lines])
    steps = np.diff(times, prepend=times[0])
    relative = []
    for step, line in zip(steps, lines, strict=True):
        _, channel, frame = line.split()[:3]
        name, data = frame.split("#")
        octets = " ".join(data[j : j + 2] for j in range(0, len(data), 2))
        body = f"{channel}  {name}   [{len(data) // 2}]  {octets}" if screen else f"{channel} {frame}"
        relative.append(f"({step:010.6f}) {body}\n")
    path.write_text("".join(relative))
    found = read(path)
    assert same(found)
    assert "added up" in found.metadata["source_remarks"]
    assert found.samples.t_ns[-1] - found.samples.t_ns[0] == pytest.approx((ROWS - 1) * PERIOD_NS, rel=0.02)


@pytest.mark.parametrize("step_s", [3600, -3600])
def test_a_clock_that_was_set_while_the_syncs_went_on_is_said(tmp_path: Path, step_s: int) -> None:
    path, lines = lines_of(tmp_path, ".log")
    stamps = [float(line.split(")")[0][1:]) + (step_s if k >= len(lines) // 2 else 0) for k, line in enumerate(lines)]
    path.write_text("".join(f"({t + 7200:.6f}){line.split(')')[1]}" for t, line in zip(stamps, lines, strict=True)))
    found = read(path)
    assert f"times step by {step_s:+d} s at SYNC" in found.metadata["source_remarks"]


def test_an_asc_log_may_have_decimal_commas(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".asc")
    path.write_text("".join(line.replace(".", ",", 1) if " Rx " in line else line for line in lines))
    assert same(read(path))


def test_lines_of_another_candump_format_name_the_one_that_is_read(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    path.write_text(" (1.0)  can0  181   [2]  00010000 00010000\n" * 9)
    with pytest.raises(DataError, match=r"line 1 is .*; `candump -l` or `candump -L` writes"):
        read(path)


def test_times_from_zero_in_candump_stay_as_they_are(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    zero = float(lines[0].split()[0][1:-1])
    path.write_text("".join(f"({float(li.split()[0][1:-1]) - zero:010.6f}) {li.split(' ', 1)[1]}" for li in lines))
    found = read(path)
    assert same(found)
    assert "source_remarks" not in found.metadata


def test_times_of_an_asc_log_since_the_event_before_are_added_up(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".asc")
    before = 0.0
    made = []
    for k, line in enumerate(lines):
        words = line.split()
        if not words or not words[0][0].isdigit():
            made.append(line.replace("timestamps absolute", "timestamps relative"))
            continue
        now = float(words[0])
        if k % 7 == 0:
            # Other events count too; events of two buses may be in another order.
            made.append(f"   {now - before + 0.000030:.6f} CAN 1 Status: chip status error active\n")
            before = now + 0.000030
        made.append(f"   {now - before:.6f} {line.strip().split(' ', 1)[1]}\n")
        before = now
    path.write_text("".join(made))
    found = read(path)
    assert same(found)
    assert "timestamps relative" in found.metadata["source_remarks"]
    assert found.samples.t_ns[-1] - found.samples.t_ns[0] == pytest.approx((ROWS - 1) * PERIOD_NS, rel=0.02)


@pytest.mark.parametrize(
    "date",
    [
        "Fr Mrz 6 15:00:01.5 2026", "Fre Mär 06 03:00:01.5 pm 2026", "ven. mars 6 15:00:01.500 2026",
        "Fri Mar 6 03:00:01.500 p.m. 2026", "6.3.2026 15:00:01.5", "vie mar 6 15:00:01.5 2026",
    ],
)  # fmt: skip
def test_a_date_in_another_language_is_understood(tmp_path: Path, date: str) -> None:
    assert asc_date_ns(f"date {date}") == asc_date_ns("date Fri Mar 6 15:00:01.500 2026")
    path, lines = lines_of(tmp_path, ".asc")
    for encoding in ("utf-8", "cp1252", "utf-16"):
        text = "".join(f"date {date}\n" if line.startswith("date") else line for line in lines)
        path.write_text(text, encoding=encoding)
        assert same(read(path))


@pytest.mark.parametrize(
    "date", ["2026-03-25 15:00:01.500", "3/25/2026 3:00:01.500 PM", "25.03.2026 15:00:01.500", "2026/03/25 15:00:01.5"]
)
def test_dates_in_numbers_are_understood_in_their_order(date: str) -> None:
    assert asc_date_ns(f"date {date}") == asc_date_ns("date Wed Mar 25 15:00:01.500 2026")


def test_a_date_that_is_not_understood_is_not_needed(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".asc")
    text = "".join(lines)
    for line in lines:
        if line.startswith(("date", "Begin")):
            text = text.replace(line, f"{line.split()[0]} Triggerblock 2026 年 3 月 6 日\n")
    assert "年" in text
    path.write_text(text, encoding="utf-8")
    found = read(path)
    assert same(found)
    assert "times begin at zero" in found.metadata["source_remarks"]


TRC = {
    "1.0": ("{n})", "{ms:.0f}", "{id:04X}", "{size}", "{data}"),
    "1.1": ("{n})", "{ms:.1f}", "Rx", "{id:04X}", "{size}", "{data}"),
    "1.2": ("{n})", "{ms:.3f}", "1", "Rx", "{id:04X}", "{size}", "{data}"),
    "1.3": ("{n})", "{ms:.3f}", "1", "Rx", "{id:04X}", "-", "{size}", "{data}"),
    "2.0": ("{n}", "{ms:.3f}", "DT", "{id:04X}", "Rx", "{size}", "{data}"),
    "2.1": ("{n}", "{ms:.3f}", "DT", "1", "{id:04X}", "Rx", "-", "{size}", "{data}"),
}
COLUMNS = {"2.0": ";$COLUMNS=N,O,T,I,d,l,D\n", "2.1": ";$COLUMNS=N,O,T,B,I,d,R,L,D\n"}


@pytest.mark.parametrize("version", TRC)
def test_every_version_of_trc_is_read(tmp_path: Path, version: str) -> None:
    source, _ = lines_of(tmp_path, ".log")
    path = tmp_path / "bus.trc"
    frames = read_log(source).frames
    made = [f";$FILEVERSION={version}\n;$STARTTIME=46351.25\n{COLUMNS.get(version, '')};\n"]
    for n, frame in enumerate(frames, start=1):
        entries = {
            "n": n, "ms": (frame["t_ns"] - frames["t_ns"][0]) * 1e-6, "id": frame["can_id"], "size": frame["length"],
            "data": bytes(frame["data"][: frame["length"]]).hex(" ").upper(),
        }  # fmt: skip
        made.append("  ".join(part.format(**entries) for part in TRC[version]) + "\n")
    made.insert(50, f"    50)  3.0  {'1 ' if version > '1.1' else ''}Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY\n")
    path.write_text("".join(made if version < "2" else made[:50] + made[51:]))
    found = read_log(path)
    assert found.notes == ()
    np.testing.assert_array_equal(found.frames["can_id"], frames["can_id"])
    np.testing.assert_array_equal(found.frames["data"], frames["data"])
    if version != "1.0":
        # Whole milliseconds are longer than a SYNC period.
        assert same(read(path))


def test_an_unknown_version_of_trc_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bus.trc"
    path.write_text(";$FILEVERSION=7.5\n" + "1;2;3\n" * 20)
    with pytest.raises(DataError, match=r"FILEVERSION='7\.5' is not read; versions 1\.0 to 2\.1 are"):
        read(path)


def test_a_single_frame_with_an_odd_time_is_left_out(tmp_path: Path) -> None:
    path, lines = lines_of(tmp_path, ".log")
    lines[700] = "(0000000012.000000) " + lines[700].split(" ", 1)[1]
    path.write_text("".join(lines))
    found = read(path)
    assert "time is far from that of both neighbours: 1, the first is 701" in found.metadata["source_remarks"]
    assert found.counters["samples.in_gaps"] <= 2
    assert found.samples.sync.size >= ROWS - 2


def messages(**changes: Any) -> list[can.Message]:
    """Return the frames of ``ROWS`` SYNCs, with changes to every one."""
    found = bus_log._messages(captured(ROWS), SESSION, captured_streams(SESSION, ROBOT))
    plain: dict[str, Any] = {"is_extended_id": False, "channel": 0}
    return [
        can.Message(**plain | {"timestamp": m.timestamp, "arbitration_id": m.arbitration_id, "data": m.data} | changes)
        for m in found
    ]


def logged(path: Path, frames: Iterable[can.Message]) -> Path:
    with can.Logger(path) as logger:
        for frame in frames:
            logger.on_message_received(frame)
    return path


def test_classic_frames_of_a_can_fd_channel_are_read(tmp_path: Path) -> None:
    text = logged(tmp_path / "a.asc", messages(is_fd=True)).read_text()
    with pytest.raises(DataError, match=r"no data frames with 11-bit identifiers.*CAN FD, extended, remote or error"):
        read(tmp_path / "a.asc")
    # The flag of extended data length is 1000h.
    (tmp_path / "b.asc").write_text(re.sub(r" 1000( +0){5}$", r"    0\1", text, flags=re.MULTILINE))
    assert same(read(tmp_path / "b.asc"))
    (tmp_path / "c.asc").write_text(
        re.sub(r"(CANFD +1 [TR]x +[0-9A-F]+) {6}", r"\1 Servo", text).replace(" 1000 ", " 0 ")
    )
    assert same(read(tmp_path / "c.asc"))


@pytest.mark.parametrize("kind", [100, 101])
@pytest.mark.parametrize("extended", [False, True])
def test_classic_frames_of_a_can_fd_channel_in_blf_are_read(tmp_path: Path, kind: int, extended: bool) -> None:
    path = tmp_path / "a.blf"
    with can.BLFWriter(path) as writer:
        for m in messages():
            head: tuple[int, ...] = (1, 0, len(m.data), m.arbitration_id, 0, 0, int(extended), len(m.data))
            body = struct.pack("<HBBLLBBB5x64s", *head, bytes(m.data))
            if kind == 101:
                # Zeros at the end of the data may be absent, and further data may follow.
                data = bytes(m.data).rstrip(b"\0")
                head = (1, len(m.data), len(m.data), 0, m.arbitration_id, 0, 0x1000 * extended, 0, 0, 0, 0, 0, 0)
                body = struct.pack("<BBBBLLLLLLLHBBL", *head, 32 + 40 + len(data), 0) + data + b"\x55" * 8
            writer._add_object(kind, body, m.timestamp)
    if extended:
        with pytest.raises(DataError, match="no data frames"):
            read(path)
    else:
        assert same(read(path))


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc"])
def test_the_bus_that_has_the_tpdos_is_read_where_names_of_buses_are_numbers(tmp_path: Path, suffix: str) -> None:
    ours = messages(channel=1)
    others = [can.Message(timestamp=m.timestamp, arbitration_id=0x7A0, is_extended_id=False, channel=0) for m in ours]
    both = [frame for pair in zip(ours, others, strict=True) for frame in pair]
    found = read(logged(tmp_path / f"a{suffix}", both))
    assert same(found)
    assert "is read: only it has SYNC and the TPDOs" in found.metadata["source_remarks"]
    twice = [frame for pair in zip(ours, messages(), strict=True) for frame in pair]
    with pytest.raises(ConfigError, match=r"holds the buses \d, \d; .*name the one to read.*bus\.channel"):
        read(logged(tmp_path / f"b{suffix}", twice))
