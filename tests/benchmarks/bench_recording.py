"""Writing and reading recordings against the stock MCAP and protobuf packages, the same messages in the same run."""

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from armident.configs import load_robot
from armident.daq.recording import Field, RecordingWriter, StreamLayout, read_recording
from tests.benchmarks.harness import Row

SAMPLES = 50_000
BATCH = 50


def run() -> list[Row]:
    """Time ten seconds of six axes at 5 kHz."""
    robot = load_robot("tx40.yaml")
    rng = np.random.default_rng(0)
    one = (1.0,) * robot.n
    fields = (Field("position", "position", "rad", "motor", one), Field("current", "current", "A", "motor", one))
    layout = StreamLayout("samples", 1, tuple(j.name for j in robot.joints), fields, ("int32", "int16"))
    sync = np.arange(SAMPLES, dtype=np.int64)
    t_ns = 1_700_000_000_000_000_000 + sync * 200_000
    raw: dict[str, NDArray[Any]] = {
        "position": np.cumsum(rng.integers(-50, 50, (SAMPLES, robot.n)), axis=0).astype(np.int32),
        "current": rng.integers(-300, 300, (SAMPLES, robot.n)).astype(np.int16),
    }

    def write(path: Path) -> None:
        writer = RecordingWriter(path, robot, None, 5000.0, [layout], {})
        for begin in range(0, SAMPLES, BATCH):
            part = slice(begin, begin + BATCH)
            writer.append("samples", sync[part], t_ns[part], {name: values[part] for name, values in raw.items()})
        writer.close({})

    def write_stock(path: Path) -> None:
        message = _message_class(layout)
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=75_000)
            writer.start()
            schema = writer.register_schema(layout.message_name, "protobuf", layout.descriptor)
            channel = writer.register_channel("/samples", "protobuf", schema)
            for k in range(SAMPLES):
                sample = message(sync=k, t_ns=int(t_ns[k]))
                for j, joint in enumerate(layout.joints):
                    values = getattr(sample, joint)
                    values.position, values.current = int(raw["position"][k, j]), int(raw["current"][k, j])
                writer.add_message(channel, int(t_ns[k]), sample.SerializeToString(), int(t_ns[k]), k)
            writer.finish()

    def read_stock(path: Path) -> None:
        with path.open("rb") as file:
            for _ in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
                pass

    with TemporaryDirectory() as folder:
        ours, stock = Path(folder, "ours.mcap"), Path(folder, "stock.mcap")
        write(Path(folder, "warm.mcap"))
        writing, writing_stock = _cpu(lambda: write(ours)), _cpu(lambda: write_stock(stock))
        reading, reading_stock = _cpu(lambda: read_recording(ours)), _cpu(lambda: read_stock(ours))
    note = f"{SAMPLES} samples of {robot.n} axes, CPU time"
    per = 1e6 / SAMPLES
    return [
        _row("write a sample (mcap, protobuf)", writing * per, writing_stock * per, note),
        _row("read a sample (mcap, protobuf)", reading * per, reading_stock * per, note),
    ]


def _row(name: str, ours: float, alternative: float, note: str) -> Row:
    return Row(name=name, ours=ours, alternative=alternative, ratio=alternative / ours, unit="us", note=note)


def _cpu(work: Callable[[], object]) -> float:
    begin = time.process_time()
    work()
    return time.process_time() - begin


def _message_class(layout: StreamLayout) -> type:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(layout.descriptor).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(layout.message_name))
