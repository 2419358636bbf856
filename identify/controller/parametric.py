"""Parametric controllers, "C" (thesis section 5.2.2): structure from held-out data, gains by refined IV."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.controller.crc import HELD_OUT, IdentifiedController, JointResponse
from armident.identify.controller.law import UNITS, Stretch, Structure, gains, loop_ratios, simulate_law, taps
from armident.identify.controller.riv import NOISE_ORDER, LawFit, fit_law, refined_iv
from armident.identify.robot.controller import DiscreteController

WORTH = 1e-5
"""Least decrease of the held-out error by a term of the law, over the torque's variance (0.3 % in amplitude); a
relative decrease by `WORTH_OF_REST` suffices, too."""

WORTH_OF_REST = 0.5
"""Relative decrease of the held-out error that always suffices for a term of the law."""

EXACT = 1e-9
"""Lower bound of both limits, over the torque's variance, where rounding errors begin."""

SIGNIFICANT = 3.0
"""Least decrease of the held-out error by a change of the law, in its standard errors."""

BLOCKS = 30
"""Number of parts of the held-out data over which this standard error is computed: it is known to 13 %."""

MOST_TAPS = 3
"""Largest number of backward differences in the velocity; a longer one is found as a filter (none of 26 drives,
simulated ones and EMPS, gets another structure with six)."""

MOST_DELAY = 2
"""Largest delay tried between position and controller output, samples: one to compute, one to transmit. With four, a
delay stands for a velocity over six samples, and kp is 40 times too small; with one, a delay of two is missed."""

COARSE = 15
"""Largest number of refined-IV iterations while structures are compared: 7 and 30 choose the same structures."""

SATURATED = 0.999
"""Torque over the saturation from which a sample is left out: within a count of drives, which report per mille of the
rated torque (CiA 402, object 6077h)."""

SHORTEST = 10 * NOISE_ORDER
"""Least number of samples of a stretch between saturated samples: the noise model's start takes a tenth of them."""


@dataclass(frozen=True)
class Gain:
    """Gain of a control law: value, standard deviation and their unit."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class ControlLaw(JointResponse):
    """Identified control law of one drive.

    ``prewhitening_order``: order of its AR noise model. ``output_taps``: from past torque to torque, (m,). ``gains``:
    see :func:`armident.identify.controller.law.gains`. ``saturated``: number of saturated samples, which were left out.
    """

    output_taps: Array
    structure: Structure
    gains: dict[str, Gain]
    saturated: int
    iterations: int
    converged: bool


def identify_parametric(
    q_motor: Sequence[Array],
    reference_motor: Sequence[Array],
    torque_motor: Sequence[Array],
    dt: float,
    *,
    structure: Structure | Sequence[Structure] | None = None,
    saturation: Array | None = None,
    gain: Array | None = None,
    added_motor: Sequence[Array] | None = None,
) -> IdentifiedController:
    """Identify the control law of every drive by refined instrumental variables (thesis 3.2, 5.2.2).

    Without ``structure`` a stepwise search starts from a cascade or a PD on the error. Each step takes the change that
    reduces the held-out error most, until none is relevant and significant (`WORTH`, `WORTH_OF_REST`, `SIGNIFICANT`).

    Inputs: position, reference (rad or m) and torque (N m or N) at the motors, one (N, n) array per experiment.
    ``saturation``: largest torque (n,); samples that reach it are left out. ``gain``: motor torque per unit of the
    drive's signal (n,). ``added_motor``: known torques of other origin in the record, such as test pulses. Raises
    DataError if a motor never deviates, is always saturated, or its law is not determined.
    """
    n = q_motor[0].shape[1]
    given = [structure] * n if structure is None or isinstance(structure, Structure) else list(structure)
    limits = np.full(n, np.inf) if saturation is None else np.asarray(saturation, dtype=np.float64)
    units = np.broadcast_to(np.asarray(1.0 if gain is None else gain, dtype=np.float64), (n,))
    if len(given) != n or limits.shape != (n,):
        raise DataError(f"controller: {len(given)} structures and {limits.size} saturations for {n} motors")
    added = [np.zeros_like(t) for t in torque_motor] if added_motor is None else added_motor
    signals = list(zip(q_motor, reference_motor, torque_motor, added, strict=True))
    laws = []
    for j in range(n):
        experiments = [Stretch(*(x[:, j] for x in four)) for four in signals]
        try:
            laws.append(_identify_drive(experiments, dt, given[j], float(limits[j]), float(units[j])))
        except DataError as error:
            raise DataError(f"controller of motor {j + 1}: {error}") from error
    controller = DiscreteController(
        error_taps=_stack([law.error_taps for law in laws]),
        position_taps=_stack([law.position_taps for law in laws]),
        output_taps=_stack([law.output_taps for law in laws]),
        saturation=limits,
        dt=dt,
    )
    return IdentifiedController(controller, tuple(laws))


def _identify_drive(
    experiments: Sequence[Stretch], dt: float, structure: Structure | None, limit: float, unit: float
) -> ControlLaw:
    stretches = _unsaturated(experiments, limit)
    chosen = structure or _choose(stretches, dt)
    fit = fit_law(stretches, chosen, dt)
    error_taps, position_taps, output_taps = taps(chosen, fit.theta, dt)
    return ControlLaw(
        error_taps=error_taps,
        position_taps=position_taps,
        prewhitening_order=fit.noise.order,
        fit_pct=_held_out_fit(stretches, chosen, dt),
        output_taps=output_taps,
        structure=chosen,
        gains=_gains_with_deviations(chosen, fit, dt, unit),
        saturated=sum(int(np.sum(_saturated(e, limit))) for e in experiments),
        iterations=fit.iterations,
        converged=fit.converged,
    )


def _saturated(experiment: Stretch, limit: float) -> NDArray[np.bool_]:
    return np.abs(experiment.nu - experiment.added) >= SATURATED * limit


def _unsaturated(experiments: Sequence[Stretch], limit: float) -> list[Stretch]:
    """Return the parts of the experiments between saturated samples, which the law does not explain."""
    stretches = []
    for experiment in experiments:
        free = np.concatenate([[False], ~_saturated(experiment, limit), [False]])
        edges = np.flatnonzero(np.diff(free))
        stretches += [
            experiment.part(slice(i, k)) for i, k in zip(edges[::2], edges[1::2], strict=True) if k - i >= SHORTEST
        ]
    if not stretches:
        raise DataError(f"no {SHORTEST} samples in a row are below its saturation ({limit:g} N m or N)")
    if not any(np.ptp(s.r - s.q) > 0 for s in stretches):
        raise DataError("position and reference never differ")
    if not any(np.ptp(s.nu) > 0 for s in stretches):
        raise DataError("its torque never changes")
    return stretches


def _choose(stretches: Sequence[Stretch], dt: float) -> Structure:
    """Select the structure on held-out data: add terms, then remove those that have become superfluous."""
    first, last = _split(stretches)
    power = float(np.mean(np.concatenate([s.nu for s in last]) ** 2))
    added = any(np.ptp(s.added) > 0 for s in stretches)
    judged: dict[Structure, Array] = {}

    def judge(s: Structure) -> Array:
        if s not in judged:
            judged[s] = _held_out_errors(first, last, s, dt)
        return judged[s]

    best = min((Structure(added=added), Structure(velocity="error", added=added)), key=lambda s: judge(s).mean())
    while better := [s for s in _additions(best) if _worth_it(judge(best), judge(s), power, s.size > best.size)]:
        best = min(better, key=lambda s: judge(s).mean())
    while as_good := [s for s in _reductions(best) if not _worth_it(judge(s), judge(best), power, larger=True)]:
        best = min(as_good, key=lambda s: judge(s).mean())
    return best


def _additions(s: Structure) -> Iterator[Structure]:
    """Structures with one term more than this one, or with one term changed."""
    if s.velocity != "both":
        # With the reference's velocity fed forward, a filtered command is a filtered velocity.
        filtered: Literal["velocity"] | None = "velocity" if s.filtered else None
        yield replace(s, velocity="both", filtered=filtered)
        yield replace(s, velocity="error" if s.velocity == "position" else "position", filtered=filtered)
    if s.velocity_taps < MOST_TAPS:
        yield replace(s, velocity_taps=s.velocity_taps + 1)
    if s.filtered is None:
        yield replace(s, filtered="velocity")
        if s.velocity == "position":
            yield replace(s, filtered="command")
    if not s.integral:
        yield replace(s, integral=True)
    if not s.acceleration:
        yield replace(s, acceleration=True)
    yield from (replace(s, delay=delay) for delay in range(MOST_DELAY + 1) if delay != s.delay)


def _reductions(s: Structure) -> Iterator[Structure]:
    """Structures with one term less than this one."""
    if s.velocity == "both":
        yield replace(s, velocity="position")
        yield replace(s, velocity="error")
    if s.velocity_taps > 1:
        yield replace(s, velocity_taps=s.velocity_taps - 1)
    if s.filtered is not None:
        yield replace(s, filtered=None)
    if s.integral:
        yield replace(s, integral=False)
    if s.acceleration:
        yield replace(s, acceleration=False)


def _worth_it(before: Array, after: Array, power: float, larger: bool) -> bool:
    """Return True if the held-out error falls significantly and, for a larger law, by a relevant amount."""
    if not np.isfinite(after).all():
        return False
    if not np.isfinite(before).all():
        return True
    gain = before - after
    chance = float(np.std(gain, ddof=1)) / np.sqrt(gain.size)
    enough = max(min(WORTH * power, WORTH_OF_REST * float(before.mean())), EXACT * power) if larger else 0.0
    return bool(gain.mean() > enough and gain.mean() > SIGNIFICANT * chance)


def _split(stretches: Sequence[Stretch]) -> tuple[list[Stretch], list[Stretch]]:
    """Split every stretch into its first part and the held-out rest."""
    cuts = [int(s.nu.size * (1 - HELD_OUT)) for s in stretches]
    first = [s.part(slice(0, cut)) for s, cut in zip(stretches, cuts, strict=True)]
    last = [s.part(slice(cut, None)) for s, cut in zip(stretches, cuts, strict=True)]
    return first, last


def _held_out_errors(first: Sequence[Stretch], last: Sequence[Stretch], structure: Structure, dt: float) -> Array:
    """Mean squared simulation error (BLOCKS,) of each held-out stretch, law of the rest; inf if undetermined."""
    try:
        fit = refined_iv(first, structure, dt, noise_model=False, iterations=COARSE)
    except DataError:
        return np.full(BLOCKS, np.inf)
    # The errors of all structures are taken over the same samples.
    begin = max(structure.lead, Structure(velocity_taps=MOST_TAPS, delay=MOST_DELAY).lead)
    errors = [s.nu[begin:] - simulate_law(s, structure, fit.theta, dt)[begin - structure.lead :] for s in last]
    return np.array([block.mean() for block in np.array_split(np.concatenate(errors) ** 2, BLOCKS)])


def _held_out_fit(stretches: Sequence[Stretch], structure: Structure, dt: float) -> float:
    """Share of the held-out torque's variance that the law explains, percent."""
    first, last = _split(stretches)
    miss = float(np.mean(_held_out_errors(first, last, structure, dt)))
    power = float(np.var(np.concatenate([s.nu for s in last])))
    return 100 * (1 - miss / power) if power > 0 and np.isfinite(miss) else 0.0


def _gains_with_deviations(structure: Structure, fit: LawFit, dt: float, unit: float) -> dict[str, Gain]:
    """Gains with their standard deviations, to first order from the covariance of the fit."""
    if loop_ratios(structure, fit.theta) == (0.0, 0.0):
        raise DataError(f"its torque does not answer to the velocity ({structure})")
    nominal = gains(structure, fit.theta, dt, unit)
    slopes = np.zeros((len(nominal), structure.size))
    for k, step in enumerate(1e-3 * np.sqrt(np.diag(fit.covariance))):
        move = np.zeros(structure.size)
        move[k] = step
        ahead, behind = (gains(structure, fit.theta + sign * move, dt, unit) for sign in (1, -1))
        slopes[:, k] = [(ahead[name] - behind[name]) / (2 * step) for name in nominal]
    std = np.sqrt(np.einsum("ij,jk,ik->i", slopes, fit.covariance, slopes))
    return {name: Gain(nominal[name], float(std[i]), UNITS[name]) for i, name in enumerate(nominal)}


def _stack(rows: Sequence[Array]) -> Array:
    """Rows of different lengths as (n, longest), filled up with zeros."""
    stacked = np.zeros((len(rows), max(row.size for row in rows)))
    for j, row in enumerate(rows):
        stacked[j, : row.size] = row
    return stacked
