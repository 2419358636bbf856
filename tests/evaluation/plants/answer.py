"""A random arm that plays references: the program of ``armident investigate --robot-command``.

``python -m tests.evaluation.plants.answer --half development --case 30 TRAJECTORY.csv OUT.npz``
"""

import argparse
import zlib
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from tests.evaluation.plants.cases import answering, make_case
from tests.evaluation.plants.disk import write_case
from tests.evaluation.plants.draft import CONTROL_HZ
from tests.evaluation.plants.halves import HALVES, Half


def main() -> None:
    """Play a table of references (t, qr1, ...) and write the recording as arrays."""
    parser = argparse.ArgumentParser(prog="python -m tests.evaluation.plants.answer", description=main.__doc__)
    parser.add_argument("--half", choices=list(HALVES), default="development")
    parser.add_argument("--case", type=int, required=True, help="number of the case, from 0")
    parser.add_argument("trajectory", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    answer((options.half, options.case, options.trajectory, options.out))


def answer(task: tuple[Half, int, Path, Path]) -> None:
    """Play the references of a file with the arm of a case: half, number, file to read and file to write."""
    half, case, trajectory, out = task
    table = np.loadtxt(trajectory, delimiter=",", skiprows=1, ndmin=2)
    t, q = table[:, 0] - table[0, 0], table[:, 1:]
    rate = (t.size - 1) / t[-1]
    step = 1.0 / (rate * np.ceil(CONTROL_HZ / rate))
    fine = CubicSpline(t, q)(np.arange(round(t[-1] / step) + 1) * step)
    arrays = answering(half, case)(fine, zlib.crc32(q.tobytes()))
    # The stubs take every keyword for the flag allow_pickle.
    np.savez(out.with_suffix(".npz"), **arrays)  # type: ignore[arg-type]


def first_answer(task: tuple[Half, int, Path]) -> None:
    """Write the configuration, the recordings and the truth of a case: half, number and folder."""
    half, case, folder = task
    write_case(make_case(half, case), folder)


if __name__ == "__main__":
    main()
