"""Healthy life of the virtual TX40 on the recursive estimator, and the time to see 10 % more friction.

``python -m tests.statistics.recursive_life --hours 50`` plays the shipped trajectories in random order, one after
the other, with fresh torque noise (`tests.statistics.fresh_noise`). The friction of each joint follows a slow
temperature: a sine of `SWING` with a period of `CYCLE_H`. ``--simulate`` simulates and filters every second, which
takes a tenth of real time.
"""

import argparse
import copy
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from armident.configs import Trajectory, load_robot, load_trajectory
from armident.configs.schema.scenario import HiddenEffect, Scenario
from armident.daq.recording import Recording
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.identify_recording import identify_recording
from armident.identify.monitoring.recursive.estimator import RecursiveEstimator
from armident.identify.monitoring.recursive.recorded_blocks import blocks_of
from armident.virtual_robot.offline import simulate_recording
from tests.fixtures import arms
from tests.statistics.fresh_noise import FreshNoise, Motion, MotionRecorder, held, repeat

PERIOD_S = 1e-3
"""SYNC period of the recordings, s; the drives themselves run at 5 kHz."""
SWING = 0.02
"""Relative amplitude of the friction by temperature."""
CYCLE_H = 6.0
"""Period of the temperature, h."""
PLAYED = 3
"""Simulations of each motion that are repeated with fresh noise."""
MOTIONS = ("tx40_excitation", "tx40_1", "tx40_2", "tx40_3", "tx40_4")
BLOCK = 50


@dataclass(frozen=True)
class Life:
    """Outcome of a healthy life."""

    hours: float
    motion_h: float
    windows: int
    alarms: list[str]
    largest_evidence: float
    threshold: float
    largest_change: float
    scores_std: list[float]
    """Standard deviation of the last windows of the pieces less the level, in their own standard deviations."""
    cpu_share: float


@dataclass(frozen=True)
class Piece:
    """A few motions: their duration, s, and a function that lets the estimator take them."""

    seconds: float
    take: Callable[[], object]


def friction(factors: dict[str, float]) -> Scenario | None:
    """Scenario with the friction of some joints scaled."""
    effects = tuple(
        HiddenEffect(effect="friction_scale", joint=joint, parameters={"factor": factor})
        for joint, factor in factors.items()
    )
    return Scenario(schema="armident/scenario/1", effects=effects) if effects else None


def repeated(name: str, times: int) -> Trajectory:
    """A shipped trajectory, several times in a row."""
    once = load_trajectory(f"trajectories/{name}.yaml")
    return once.model_copy(update={"moves": once.moves * times})


def play(name: str, seed: int, factors: dict[str, float], times: int = 4, period: float = PERIOD_S) -> Recording:
    """Simulate one piece of life."""
    return simulate_recording(load_robot("tx40"), repeated(name, times), seed, 1.0, friction(factors), period)


@cache
def reference(period: float = PERIOD_S) -> IdentificationDocument:
    """Identification of the healthy arm on its exciting trajectory."""
    if period == arms.FAST:
        return arms.tx40_baseline()
    return identify_recording(play("tx40_excitation", 100, {}, 2, period), load_robot("tx40")).document


def factors_at(hours: float) -> dict[str, float]:
    """Friction of each joint relative to the reference, at a time of a life; every joint has its own phase."""
    joints = [joint.name for joint in load_robot("tx40").joints]
    angles = 2 * math.pi * (hours / CYCLE_H + np.arange(len(joints)) / len(joints))
    return {name: 1.0 + SWING * math.sin(angle) for name, angle in zip(joints, angles, strict=True)}


def simulated_pieces(estimator: RecursiveEstimator, hours: float, seed: int) -> Iterator[Piece]:
    """Yield recordings of healthy motion until they have a length."""
    random = np.random.default_rng(seed)
    elapsed = 0.0
    while elapsed < hours:
        name, number = MOTIONS[random.integers(len(MOTIONS))], int(random.integers(1 << 31))
        recording = play(name, number, factors_at(elapsed))
        seconds = recording.samples.sync.size / recording.sample_rate_hz
        elapsed += seconds / 3600.0
        yield Piece(seconds, partial(handle_all, estimator, recording))


def handle_all(estimator: RecursiveEstimator, recording: Recording) -> None:
    """Give all blocks of a recording to an estimator."""
    for block in blocks_of(recording, BLOCK):
        estimator.handle(block)


def repeated_pieces(estimator: RecursiveEstimator, hours: float, seed: int) -> Iterator[Piece]:
    """Yield healthy motions with fresh noise (`tests.statistics.fresh_noise`) until they have a length."""
    robot = load_robot("tx40")
    random = np.random.default_rng(seed)
    recorder = MotionRecorder(estimator, robot, PERIOD_S)
    # After the first one the lags behind the reference are known.
    recorder.record(play(MOTIONS[0], seed, {}), seed)
    motions: dict[tuple[str, int], Motion] = {}
    fresh = FreshNoise(robot, PERIOD_S, random)
    elapsed = 0.0
    while elapsed < hours:
        name, number = MOTIONS[random.integers(len(MOTIONS))], 1000 * seed + int(random.integers(PLAYED))
        if (name, number) not in motions:
            motions[name, number] = recorder.record(play(name, number, {}), number)
        motion = motions[name, number]
        noise = recorder.filtered(held(fresh.draw(motion.samples))[1:])
        factor = np.array(list(factors_at(elapsed).values()))
        elapsed += motion.seconds / 3600.0
        yield Piece(motion.seconds, partial(repeat, estimator, motion, noise, factor))


def healthy_life(hours: float, seed: int = 1, *, simulated: bool = False, progress: bool = False) -> Life:
    """Let a healthy arm live on the estimator.

    ``hours``: length, h. ``seed``: seed of the noise and of the order of motions. ``simulated``: True: every second is
    simulated and filtered; otherwise simulated motions are repeated with fresh noise. ``progress``: True to print a
    line for every tenth of an hour.
    """
    robot = load_robot("tx40")
    estimator = RecursiveEstimator(robot, reference(), 1.0 / PERIOD_S)
    elapsed, cpu, evidence, change, shown, scores = 0.0, 0.0, 0.0, 0.0, 0.0, []
    pieces = simulated_pieces if simulated else repeated_pieces
    for piece in pieces(estimator, hours, seed):
        estimator.start_capture()
        began = time.process_time()
        piece.take()
        cpu += time.process_time() - began
        elapsed += piece.seconds
        result = estimator.result()
        evidence = max(evidence, float(result.evidence.max()))
        if result.motion_s:
            change = max(change, float(np.nanmax(np.abs(result.filtered))))
            scores.append((result.raw - result.level) / result.raw_std)
        if progress and elapsed - shown > 360:
            shown = elapsed
            print(f"{elapsed / 3600:.2f} h, evidence {evidence:.2f}, alarms {result.alarm.sum()}", flush=True)
    result = estimator.result()
    alarms = [joint.name for joint, alarm in zip(robot.joints, result.alarm, strict=True) if alarm]
    return Life(
        elapsed / 3600, result.motion_s / 3600, estimator.test.windows, alarms, evidence, result.threshold, change,
        np.nanstd(scores, axis=0).round(2).tolist(), cpu / elapsed,
    )  # fmt: skip


def lived_for(hours: float, seed: int) -> RecursiveEstimator:
    """Return an estimator after a healthy life of repeated motions at 1 kHz."""
    estimator = RecursiveEstimator(load_robot("tx40"), reference(), 1.0 / PERIOD_S)
    for piece in repeated_pieces(estimator, hours, seed):
        estimator.start_capture()
        piece.take()
    return estimator


def seconds_to_alarm(
    joint: str,
    motion: str,
    seed: int,
    factor: float = 1.1,
    period: float = PERIOD_S,
    lived: tuple[RecursiveEstimator, dict[str, float]] | None = None,
) -> float | None:
    """Time from the change of a joint's friction to its alarm, s; ``None``: no alarm, or one of another joint.

    ``joint``, ``motion``, ``seed``: the joint, the trajectory that is repeated, and the seed of the noise. ``factor``:
    the new friction, relative to that before. ``lived``: estimator after a healthy life (which is copied) and the
    friction factors of the joints at its end; without it, a new estimator sees the motion four times before the change.
    """
    robot = load_robot("tx40")
    syncs = round(BLOCK * PERIOD_S / period)
    if lived is None:
        estimator, factors = RecursiveEstimator(robot, reference(period=period), 1.0 / period), dict[str, float]()
        for block in blocks_of(play(motion, 1000 * seed, {}, period=period), syncs):
            estimator.handle(block)
    else:
        estimator, factors = copy.deepcopy(lived[0]), lived[1]
    worn = {**factors, joint: factor * factors.get(joint, 1.0)}
    elapsed, k = 0.0, 1
    while elapsed < 90.0:
        estimator.start_capture()
        for block in blocks_of(play(motion, 1000 * seed + k, worn, period=period), syncs):
            estimator.handle(block)
            if block.layout.name == "samples":
                elapsed += len(block.sync) * period
            alarm = estimator.test.alarm >= 0
            if alarm.any():
                names = [j.name for j, a in zip(robot.joints, alarm, strict=True) if a]
                return elapsed if names == [joint] else None
        k += 1
    return None


def cost(period: float = 2e-4) -> float:
    """CPU time of the estimator over the time of the stream, compiled, in blocks of 10 ms."""
    recording = play("tx40_1", 31, {}, 8, period)
    estimator = RecursiveEstimator(load_robot("tx40"), reference(period=period), 1.0 / period)
    blocks = list(blocks_of(recording, round(0.01 / period)))
    for block in blocks:
        estimator.handle(block)
    estimator.reset()
    began = time.process_time()
    for block in blocks:
        estimator.handle(block)
    return (time.process_time() - began) / (recording.samples.sync.size * period)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=50.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--period", type=float, default=PERIOD_S, help="SYNC period with --changes, s")
    parser.add_argument("--changes", action="store_true", help="time to see 10 %% more friction, every joint")
    parser.add_argument("--healthy", type=float, help="hours of healthy life before each change, 1 kHz, with --changes")
    parser.add_argument("--simulate", action="store_true", help="simulate and filter every second of a life")
    parser.add_argument("--cost", action="store_true", help="CPU time of a replay at 5 kHz against real time")
    asked = parser.parse_args()
    if asked.healthy is not None and asked.period != PERIOD_S:
        parser.error("--healthy is for the default --period")
    if asked.cost:
        print(f"{100 * cost():.1f} % of a core")
        return
    if asked.changes:
        lived = None if asked.healthy is None else (lived_for(asked.healthy, asked.seed), factors_at(asked.healthy))
        for motion in MOTIONS:
            for joint in load_robot("tx40").joints:
                seconds = seconds_to_alarm(joint.name, motion, asked.seed, period=asked.period, lived=lived)
                print(motion, joint.name, seconds, flush=True)
        return
    print(json.dumps(vars(healthy_life(asked.hours, asked.seed, simulated=asked.simulate, progress=True)), indent=1))


if __name__ == "__main__":
    main()
