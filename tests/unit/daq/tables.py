"""Tables of a motion of the TX40, as tools write them."""

import json
from pathlib import Path

import numpy as np

from armident.daq.recording import Recording
from tests.unit.daq.test_importing import HEADER, TX40

N = TX40.n
NAMES = HEADER.split(",")


def motion(rows: int = 400, rate: float = 1000.0) -> np.ndarray:
    """Return t, positions and torques of a motion that uses a third of the velocity limits."""
    t = np.arange(rows) / rate
    phase = np.arange(N)
    amplitude = 0.05 * np.array([joint.limits.velocity for joint in TX40.joints])
    return np.column_stack([t, amplitude * np.sin(6 * t[:, None] + phase), 3 * np.cos(6 * t[:, None] + phase)])


def written(path: Path, values: np.ndarray, names: list[str] = NAMES, sep: str = ",", cell: str = "{:.9g}") -> Path:
    lines = [sep.join(names), *(sep.join(cell.format(x) for x in row) for row in values)]
    path.write_text("\n".join(lines) + "\n")
    return path


def same(found: Recording, values: np.ndarray) -> bool:
    raw = found.samples.raw
    return np.allclose(np.hstack([raw["position"], raw["torque"]]), values[:, 1:], rtol=0, atol=1e-8)


def lerobot(folder: Path, names: list[str] | None, extra: str = "observation.effort") -> Path:
    """Write a data set of two episodes at 50 Hz."""
    import pyarrow
    import pyarrow.parquet

    values = motion(300, 50.0)
    data = folder / "data" / "chunk-000" / "file-000.parquet"
    data.parent.mkdir(parents=True)
    (folder / "meta").mkdir()
    features = {} if names is None else {"observation.state": {"dtype": "float32", "names": names}}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": features}))
    columns = {
        "observation.state": values[:, 1 : N + 1].tolist(),
        "action": (values[:, 1 : N + 1] + 0.001).tolist(),
        extra: values[:, N + 1 :].tolist(),
        "timestamp": np.append(values[:200, 0], values[:100, 0]).astype(np.float32),
        "episode_index": np.append(np.zeros(200, int), np.ones(100, int)),
    }
    pyarrow.parquet.write_table(pyarrow.table(columns), data)
    return data
