"""Coverage of the 2-sigma intervals of all methods under five kinds of noise, on an axis and on the virtual TX40.

``python -m tests.statistics.noise --runs 20`` prints, for each robot, noise and method, the share of intervals that
hold the true values (nominal 95.45 %), and the number of runs whose intervals are called doubtful.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from armident.configs import RobotConfig
from armident.identify.estimators.methods import Method
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.signals.experiments import Experiment
from armident.virtual_robot.offline import simulate_recording, with_encoder_counts
from tests.statistics import axis
from tests.statistics.coverage import ESSENTIAL, SIGMAS, trajectory, truth
from tests.statistics.coverage import robot as tx40

Floats = NDArray[np.float64]

METHODS: tuple[Method, ...] = ("idim-ls", "idim-iv", "idim-piv")
SHARE = 0.02
"""Torque noise over the rms torque."""
POLE = 0.99
"""Pole of the coloured torque noise."""
ENCODER = 20e-6
"""Noise or resolution of the axis's encoder, m."""
COARSE = 3600.0
"""Encoder counts per motor turn of the TX40 (thesis section 6.3)."""
FIRST_SEED = 501


@dataclass(frozen=True)
class Setting:
    """One kind of noise.

    ``name``: name in the table; ``torque``, ``pole``: torque noise over the rms torque, and its pole; ``encoder``:
    ``fine``, ``noisy`` (white) or ``coarse`` (counts).
    """

    name: str
    torque: float = SHARE
    pole: float = 0.0
    encoder: str = "fine"


SETTINGS = (
    Setting("white torque noise"),
    Setting("AR(1) torque noise", pole=POLE),
    Setting("noisy encoder", encoder="noisy"),
    Setting("coarse encoder", encoder="coarse"),
    Setting("noisy encoder, AR(1)", pole=POLE, encoder="noisy"),
)


def axis_recording(setting: Setting, seed: int) -> Experiment:
    """A recording of the axis. ``setting``: kind of noise."""
    rms = float(np.sqrt(np.mean(axis.recorded(0).tau ** 2)))
    position = ENCODER if setting.encoder == "noisy" else 0.0
    count = ENCODER if setting.encoder == "coarse" else 1e-7
    return axis.recorded(seed, torque=setting.torque * rms, pole=setting.pole, position=position, count=count)


@cache
def _noiseless_tx40(counts: float | None) -> Experiment:
    robot = tx40() if counts is None else with_encoder_counts(tx40(), counts)
    (experiment,), _ = experiments_from_recording(simulate_recording(robot, trajectory(), seed=0, noise=0.0), robot)
    return experiment


def tx40_recording(setting: Setting, seed: int) -> Experiment:
    """A recording of the virtual TX40; noise of the encoders is added to the recorded positions only.

    ``setting``: kind of noise.
    """
    clean, rng = _noiseless_tx40(COARSE if setting.encoder == "coarse" else None), np.random.default_rng(seed)
    size = clean.tau.shape
    scale = setting.torque * np.sqrt(np.mean(clean.tau**2, axis=0)) * np.sqrt(1 - setting.pole**2)
    tau = clean.tau + signal.lfilter([1.0], [1.0, -setting.pole], rng.normal(size=size) * scale, axis=0)
    q = clean.q
    if setting.encoder == "noisy":
        step = 2 * np.pi / COARSE / np.abs(tx40().transmission_matrix).max(axis=1)
        q = q + rng.normal(size=size) * step / np.sqrt(12)
    return replace(clean, q=q, tau=tau)


@dataclass(frozen=True)
class Row:
    """Coverage of one robot, noise and method.

    ``covered``: share of intervals that hold the true value, of all runs and parameters; ``least``: share of the
    parameter with the fewest; ``scatter``: root mean square of the errors in standard deviations; ``doubtful``: share
    of runs whose intervals are called doubtful.
    """

    robot: str
    noise: str
    method: Method
    covered: float
    least: float
    scatter: float
    doubtful: float


def row(
    name: str,
    robot: RobotConfig,
    record: Callable[[Setting, int], Experiment],
    setting: Setting,
    method: Method,
    runs: int,
) -> Row:
    """Identify simulated recordings and compare the intervals with the true values.

    ``name``, ``robot``: robot and its name in the table; ``record``: ``record(setting, seed)`` to a recording;
    ``setting``, ``method``: kind of noise and method.
    """
    errors, doubts = [], 0
    for seed in range(FIRST_SEED, FIRST_SEED + runs):
        found = identify_experiment(record(setting, seed), robot, Options(method=method))
        wanted = axis.TRUTH if name == "axis" else truth()[1]
        chosen = [found.names.index(n) for n in (found.names if name == "axis" else ESSENTIAL)]
        errors.append(((found.theta - wanted) / found.std)[chosen])
        doubts += bool(found.interval_warnings)
    z = np.array(errors)
    inside = np.abs(z) <= SIGMAS
    return Row(
        name,
        setting.name,
        method,
        float(inside.mean()),
        float(inside.mean(axis=0).min()),
        float(np.sqrt(np.mean(z**2))),
        doubts / runs,
    )


ROBOTS: dict[str, tuple[Callable[[], RobotConfig], Callable[[Setting, int], Experiment]]] = {
    "axis": (axis.robot, axis_recording),
    "tx40": (tx40, tx40_recording),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.statistics.noise", description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--robot", choices=[*ROBOTS, "both"], default="both")
    chosen = parser.parse_args(arguments)
    print(
        f"{'robot':6s} {'noise':22s} {'method':9s} {'covered %':>9s} {'least %':>8s} {'rms z':>6s} {'doubtful %':>10s}"
    )
    for name, (robot, record) in ROBOTS.items():
        if chosen.robot not in (name, "both"):
            continue
        for setting in SETTINGS:
            for method in METHODS:
                r = row(name, robot(), record, setting, method, chosen.runs)
                print(
                    f"{r.robot:6s} {r.noise:22s} {r.method:9s} {100 * r.covered:9.1f} {100 * r.least:8.1f} "
                    f"{r.scatter:6.2f} {100 * r.doubtful:10.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
