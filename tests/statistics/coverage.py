"""Do the 2-sigma intervals of an estimator cover the truth as often as they say? Monte Carlo on the virtual TX40.

``python -m tests.statistics.coverage --runs 200 --cache FOLDER`` simulates and identifies one recording per seed, noise
in the loop, and prints for every essential parameter how often the interval covered. Every run is a file of its own
under ``FOLDER/<hash of the code and settings>``: an interrupted campaign goes on where it stopped, and runs of another
version of the code are never mixed in.
"""

import argparse
import hashlib
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.configs import RobotConfig, Trajectory, load_robot, load_trajectory
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.methods import METHODS, Method
from armident.identify.identification.from_recording import experiments_from_recording
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.virtual_robot.inertias import plant_parameters
from armident.virtual_robot.offline import simulate_recording
from tests.tx40_reference import TABLE_B4

Floats = NDArray[np.float64]

SIGMAS = 2.0
"""Half width of the intervals, in standard deviations."""
NOMINAL = float(stats.norm.cdf(SIGMAS) - stats.norm.cdf(-SIGMAS))
"""What an interval of that width promises: 0.9545."""
WANTED = (0.92, 0.98)
"""Coverage that counts as right."""
FIRST_SEED = 1001
"""Seeds of the campaign; those below 1000 belong to other tests."""
ESSENTIAL = tuple(TABLE_B4)
PACKAGES = ("configs", "daq", "identify", "virtual_robot")
ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, eq=False)
class Runs:
    """Estimates of R runs and the truth.

    ``names``, ``truth``: base parameters and their true values (b,); ``seeds``: shape (R,); ``theta``, ``covariance``:
    shapes (R, b) and (R, b, b); ``converged``, ``stepped_back``: shape (R,): whether the iterations ended, and whether
    IDIM-PIV handed over to IDIM-IV.
    """

    names: tuple[str, ...]
    truth: Floats
    seeds: NDArray[np.int64]
    theta: Floats
    covariance: Floats
    converged: NDArray[np.bool_]
    stepped_back: NDArray[np.bool_]

    @property
    def std(self) -> Floats:
        """Standard deviations (R, b)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def deviations(self) -> Floats:
        """Errors in units of their own standard deviations, (R, b)."""
        return np.asarray((self.theta - self.truth) / self.std)

    def columns(self, names: Sequence[str] = ESSENTIAL) -> list[int]:
        """Where these parameters are."""
        return [self.names.index(name) for name in names]


@dataclass(frozen=True)
class Coverage:
    """Coverage of one parameter.

    Parameters
    ----------
    covered, runs
        Intervals that held the truth, of how many.
    low, high
        95 % interval of Clopper and Pearson for the probability of covering.
    surprising
        Whether so many or so few would come by chance in less than one of twenty campaigns, all parameters counted.
    bias
        Mean error in units of the mean reported standard deviation.
    inflation
        Scatter of the estimates over the root mean square of the reported standard deviations.
    """

    name: str
    covered: int
    runs: int
    low: float
    high: float
    surprising: bool
    bias: float
    inflation: float

    @property
    def share(self) -> float:
        """Share of the intervals that held the truth."""
        return self.covered / self.runs

    @property
    def verdict(self) -> str:
        """``ok`` inside ``WANTED``; else on which side, and whether chance explains it."""
        if WANTED[0] <= self.share <= WANTED[1]:
            return "ok"
        side = "low" if self.share < WANTED[0] else "high"
        return side if self.surprising else f"{side}, within chance"


@cache
def robot() -> RobotConfig:
    """The virtual TX40."""
    return load_robot("tx40")


@cache
def trajectory() -> Trajectory:
    """Its exciting trajectory."""
    return load_trajectory("trajectories/tx40_excitation.yaml")


@cache
def truth() -> tuple[tuple[str, ...], Floats]:
    """Names and values (b,) of the base parameters that the plant has."""
    model = arm_model(robot())
    plant = plant_parameters(robot())
    return model.base.names, np.asarray(model.base.regroup @ np.array([plant[name] for name in model.names]))


def run_once(seed: int, method: Method, noise: float, folder: Path) -> Path:
    """Simulate and identify with one seed; the file it is stored in, which is left alone if it is there."""
    path = folder / f"{seed:06d}.npz"
    if path.exists():
        return path
    experiments, _ = experiments_from_recording(
        simulate_recording(robot(), trajectory(), seed=seed, noise=noise), robot()
    )
    result = identify_experiment(experiments, robot(), Options(method=method))
    partial_file = path.with_suffix(".part.npz")
    np.savez(
        partial_file,
        theta=result.theta,
        covariance=result.covariance,
        converged=result.converged,
        stepped_back=any("a noise model would move" in reason.message for reason in result.verdict.reasons),
        orders=[joint["order"] for joint in result.noise_model["joints"]],
        outside=[joint.fraction_outside_2sigma for joint in result.whiteness],
    )
    partial_file.replace(path)
    return path


def campaign(
    seeds: Sequence[int], folder: Path, method: Method = "idim-piv", noise: float = 1.0, jobs: int = 1
) -> Runs:
    """Run every seed that is not stored yet and gather all of them.

    ``folder``: cache; the runs go into a subfolder named after :func:`fingerprint`. ``noise``: scale of the plant's
    noise; 1 is that of table B.4's standard deviations. ``jobs``: processes at once.
    """
    folder = folder / fingerprint(method, noise)
    folder.mkdir(parents=True, exist_ok=True)
    once = partial(run_once, method=method, noise=noise, folder=folder)
    begin, paths = time.perf_counter(), []
    if jobs > 1:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            paths = list(pool.map(once, seeds))
    else:
        for number, seed in enumerate(seeds, start=1):
            paths.append(once(seed))
            spent = time.perf_counter() - begin
            print(f"\r{number}/{len(seeds)} runs, {spent:.0f} s", end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)
    return gather(paths)


def gather(paths: Sequence[Path]) -> Runs:
    """Stored runs as arrays."""
    names, values = truth()
    runs = []
    for path in paths:
        with np.load(path) as stored:
            runs.append({key: stored[key] for key in ("theta", "covariance", "converged", "stepped_back")})
    return Runs(
        names,
        values,
        np.array([int(path.stem) for path in paths], dtype=np.int64),
        *(np.stack([run[key] for run in runs]) for key in ("theta", "covariance", "converged", "stepped_back")),
    )


def fingerprint(method: Method, noise: float) -> str:
    """Hash of the settings and of all code and configuration that a run depends on."""
    digest = hashlib.sha256(f"{method} {noise!r}".encode())
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix in (".py", ".yaml"):
                digest.update(str(path.relative_to(ROOT)).encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def coverage(runs: Runs, names: Sequence[str] = ESSENTIAL) -> list[Coverage]:
    """Coverage of each parameter of ``names``."""
    deviations, count = runs.deviations, len(runs.seeds)
    rows = []
    for name, k in zip(names, runs.columns(names), strict=True):
        covered = int(np.sum(np.abs(deviations[:, k]) <= SIGMAS))
        test = stats.binomtest(covered, count, NOMINAL)
        interval, surprising = test.proportion_ci(0.95, "exact"), test.pvalue < 0.05 / len(names)
        error = runs.theta[:, k] - runs.truth[k]
        rms = float(np.sqrt(np.mean(runs.std[:, k] ** 2)))
        scatter = float(np.std(error, ddof=1)) if count > 1 else float("nan")
        bounds = float(interval.low), float(interval.high)
        rows.append(Coverage(name, covered, count, *bounds, bool(surprising), float(error.mean()) / rms, scatter / rms))
    return rows


def distances(runs: Runs, names: Sequence[str] = ESSENTIAL) -> Floats:
    """Squared Mahalanobis distance (R,) of the truth from each estimate: chi-square of ``len(names)`` degrees."""
    k = runs.columns(names)
    errors = (runs.theta - runs.truth)[:, k]
    return np.array([e @ np.linalg.solve(c[np.ix_(k, k)], e) for e, c in zip(errors, runs.covariance, strict=True)])


def table(runs: Runs, rows: Sequence[Coverage]) -> str:
    """The coverage of every parameter and of all of them together, as text."""
    chi2, degrees = distances(runs), len(rows)
    rms = float(np.sqrt(np.mean(runs.deviations[:, runs.columns([row.name for row in rows])] ** 2)))
    lines = [
        f"{'parameter':<10} {'truth':>9} {'covered':>9} {'%':>6} {'95 % bounds':>14} {'bias/std':>9} {'scatter':>8}"
    ]
    for row in rows:
        value = runs.truth[runs.names.index(row.name)]
        lines.append(
            f"{row.name:<10} {value:>9.4g} {row.covered:>4}/{row.runs:<4} {100 * row.share:>6.1f} "
            f"{100 * row.low:>6.1f} {100 * row.high:>6.1f}  {row.bias:>+9.3f} {row.inflation:>8.3f}  {row.verdict}"
        )
    shares = np.array([row.share for row in rows])
    lines += [
        "",
        f"runs {len(runs.seeds)}, not converged {int((~runs.converged).sum())}, "
        f"handed over to idim-iv {int(runs.stepped_back.sum())}",
        f"intervals of +-{SIGMAS:g} std promise {100 * NOMINAL:.2f} %; mean {100 * shares.mean():.2f} %, "
        f"least {100 * shares.min():.1f} %, most {100 * shares.max():.1f} %",
        f"root mean square of the errors in standard deviations: {rms:.3f}",
        f"within {100 * WANTED[0]:.0f} to {100 * WANTED[1]:.0f} %: "
        f"{int(sum(row.verdict == 'ok' for row in rows))} of {degrees}",
        f"joint: mean squared distance of the truth {chi2.mean():.2f} of {degrees} degrees of freedom "
        f"(ratio {chi2.mean() / degrees:.3f}, standard error {np.sqrt(2 / degrees / chi2.size):.3f})",
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign and print the table; 1 if a parameter is outside and chance does not explain it."""
    parser = argparse.ArgumentParser(prog="python -m tests.statistics.coverage", description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--method", choices=METHODS, default="idim-piv")
    parser.add_argument("--noise", type=float, default=1.0, help="scale of the plant's noise")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    parser.add_argument("--cache", type=Path, default=ROOT / ".cache" / "coverage", help="folder of finished runs")
    chosen = parser.parse_args(arguments)
    if chosen.runs < 1 or chosen.jobs < 1:
        parser.error("--runs and --jobs must be at least 1")
    seeds = range(chosen.first_seed, chosen.first_seed + chosen.runs)
    runs = campaign(seeds, chosen.cache, chosen.method, chosen.noise, chosen.jobs)
    rows = coverage(runs)
    print(table(runs, rows))
    return int(any(row.verdict in ("low", "high") for row in rows))


if __name__ == "__main__":
    sys.exit(main())
