"""Table 5.2 by a protocol inferred from its figures, where the thesis states none (section 5.1.4).

Unknown are motion, sampling rate, noise-variance ratio, kind of differences, and use of the two states of IRWSM 1. The
figures constrain them:

- The error of the bandpass is due to its differences. If its velocity and acceleration were exact derivatives of its
  position, ``|q| |qdd| / |qd|^2`` of the motion would exceed 4000. This follows from Cauchy-Schwarz (summation by parts
  from rest to rest), see :func:`least_product`. The motions here have less than ten.
- The differences are forward ones. Their error in the acceleration is twice that in the velocity for a motion of a
  single frequency: a delay of one sample, and of half a sample. Section 2.3.1 states central differences, which have
  no delay.
- An error of 0.55 % by half a sample of delay means that sampling rate over angular frequency is about 90.
- IRWSM has velocity errors of thousandths of a percent. So its states were compared at their own instants. The motion
  is slow, as the reversals of Coulomb friction, which a smoother rounds off, had no effect.
- A signal-to-noise ratio of 100 dB and the position error of the bandpass agree at such a sampling rate on two
  conditions. The noise is relative to the motion, and errors are relative to positions with a distant origin.
- Noise-variance ratios by likelihood or cross-validation give larger velocity errors of IRWSM than one given ratio for
  both models.

These constraints are not fully compatible. ``INFERRED`` is a compromise in round numbers that is close to all nine
figures; the thesis states none of it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armident.identify.signals.bandpass import butterworth, central_difference
from armident.identify.signals.choices import NvrRule
from armident.identify.signals.differentiate import Derivatives, differentiate
from armident.identify.signals.irwsm import irwsm
from tests.reproduction.emps_derivatives import (
    CUTOFF_HZ,
    SNR_DB,
    THESIS,
    EmpsRun,
    Errors,
    Row,
    follow,
    forward,
    mean,
    relative_errors,
    simulate_emps,
)

Array = NDArray[np.float64]

SUFFIX = ", inferred"
"""Suffix of the names of methods with the inferred protocol."""
VARIANT_SIMULATIONS = 1
"""Noise realisations of a variant. Their errors scatter by a few percent, which is small against the factors."""


@dataclass(frozen=True)
class Protocol:
    """Conditions that the thesis does not state.

    Parameters
    ----------
    sampling_hz
        Sampling rate of the simulated position, Hz.
    frequency_hz, stroke, duration
        Reference ``stroke (1 - cos) / 2``, m, for ``duration``, s; ``None``: the moves of ``emps_derivatives``.
    origin
        Distance of the origin of the positions from the start of the motion, m.
    differences
        Differences of the bandpass.
    nvr
        Noise-variance ratio of both models and both passes, or the rule that chooses it.
    velocity
        Velocity of IRWSM 1: slope of the first pass, or the same after the second pass.
    border
        Samples omitted at either end, as in the scripts published with the measured EMPS.
    """

    sampling_hz: float = 500.0
    frequency_hz: float | None = 0.45
    stroke: float = 0.01
    duration: float = 20.0
    origin: float = 0.02
    differences: Literal["forward", "central"] = "forward"
    nvr: float | NvrRule = 4e-4
    velocity: Literal["first pass", "second pass"] = "second pass"
    border: int = 50


INFERRED = Protocol()

VARIANTS: Mapping[str, Protocol] = {
    "central differences": replace(INFERRED, differences="central"),
    "velocity of IRWSM 1 from the first pass": replace(INFERRED, velocity="first pass"),
    "NVR by likelihood": replace(INFERRED, nvr="likelihood"),
    "NVR by cross-validation": replace(INFERRED, nvr="cross-validation"),
    "NVR automatic": replace(INFERRED, nvr="automatic"),
    "sampled at 1 kHz": replace(INFERRED, sampling_hz=1000.0),
    "sampled at 200 Hz": replace(INFERRED, sampling_hz=200.0),
    "origin where the motion begins": replace(INFERRED, origin=0.0),
    "stroke of 0.25 m": replace(INFERRED, stroke=0.25),
    "moves of 0.25 m from rest to rest": replace(INFERRED, frequency_hz=None, origin=0.0),
    "ends included": replace(INFERRED, border=0),
}
"""Protocols that differ from ``INFERRED`` in one condition."""


def inferred_rows(simulations: int, protocol: Protocol = INFERRED, seed: int = 0) -> list[Row]:
    """Return mean relative errors of the three methods of the table with a protocol.

    ``simulations``: number of noise realisations.
    """
    run = motion(protocol)
    random = np.random.default_rng(seed)
    deviation = float(np.std(run.q)) * 10 ** (-SNR_DB / 20)
    errors: dict[str, list[Errors]] = {label: [] for label in THESIS}
    for _ in range(simulations):
        measured = run.q + deviation * random.standard_normal(run.q.size)
        for label, method in METHODS.items():
            found = method(measured[:, None], run.dt, protocol)
            errors[label].append(relative_errors(run, found, protocol.border))
    return [Row(label + SUFFIX, THESIS[label], mean(values)) for label, values in errors.items()]


def motion(protocol: Protocol) -> EmpsRun:
    """Return the noise-free motion of a protocol."""
    run = _from_rest(1.0 / protocol.sampling_hz, protocol.frequency_hz, protocol.stroke, protocol.duration)
    return replace(run, q=run.q + protocol.origin, q_ref=run.q_ref + protocol.origin)


@cache
def _from_rest(dt: float, frequency_hz: float | None, stroke: float, duration: float) -> EmpsRun:
    if frequency_hz is None:
        return simulate_emps(dt)
    omega = 2 * np.pi * frequency_hz
    midway = (np.arange(round(duration / dt)) + 0.5) * dt
    return follow(0.5 * stroke * omega**2 * np.cos(omega * midway), dt)


def worst_factor(rows: list[Row]) -> tuple[float, str]:
    """Return the largest ratio between our and the published figures, above 1, and the name of that figure."""
    signals = ("position", "velocity", "acceleration")
    factors = [
        (max(ours / thesis, thesis / ours), f"{signal} of {row.label.removesuffix(SUFFIX)}")
        for row in rows
        if row.thesis is not None
        for signal, ours, thesis in zip(signals, row.ours, row.thesis, strict=True)
    ]
    return max(factors)


def same_ranking(rows: list[Row]) -> bool:
    """Return True if the methods have the published ranking in all three signals."""
    thesis, ours = np.array([row.thesis for row in rows]), np.array([row.ours for row in rows])
    return bool((np.argsort(thesis, axis=0) == np.argsort(ours, axis=0)).all())


def least_product(errors: Errors) -> float:
    """Return the least ``|q| |qdd| / |qd|^2`` of a motion whose errors are derivatives of the position error."""
    q, qd, qdd = errors
    return qd**2 / (q * qdd)


def product(run: EmpsRun) -> float:
    """Return ``|q| |qdd| / |qd|^2`` of a motion."""
    return float(np.linalg.norm(run.q) * np.linalg.norm(run.qdd) / np.linalg.norm(run.qd) ** 2)


def evidence(rows: list[Row]) -> list[str]:
    """Return the evidence for the inferred protocol, one line with figures each."""
    factor, which = worst_factor(rows)
    p, moves = INFERRED, VARIANTS["moves of 0.25 m from rest to rest"]
    lines = [
        f"inferred, chosen to fit the nine figures and not stated by the thesis: {p.sampling_hz:g} Hz, reference of "
        f"{p.frequency_hz} Hz and {1e3 * p.stroke:g} mm starting {1e3 * p.origin:g} mm from the origin, forward "
        f"differences, NVR {p.nvr:g} for both models, {p.border} samples left out at either end",
        f"all nine figures are within a factor of {factor:.2g} (largest: {which}), ranking {_kept(rows)}",
        "no filter explains the published bandpass: if its velocity and acceleration were derivatives of its position, "
        f"|q||qdd|/|qd|^2 would be {least_product(THESIS['bandpass']):.0f} or more; the motions here have "
        f"{product(motion(p)):.0f} and {product(motion(moves)):.1f}",
    ]
    for label, protocol in VARIANTS.items():
        changed = inferred_rows(VARIANT_SIMULATIONS, protocol)
        factor, which = worst_factor(changed)
        lines.append(f"inferred but {label}: factor {factor:.2g} ({which}), ranking {_kept(changed)}")
    return lines


def _kept(rows: list[Row]) -> str:
    return "kept" if same_ranking(rows) else "not kept"


def _bandpass(y: Array, dt: float, protocol: Protocol) -> Derivatives:
    smooth = butterworth(y, dt, CUTOFF_HZ)
    if protocol.differences == "forward":
        return forward(smooth, dt)
    qd = central_difference(smooth, dt)
    return Derivatives(smooth, qd, central_difference(qd, dt), None)


def _irwsm1(y: Array, dt: float, protocol: Protocol) -> Derivatives:
    found = differentiate(y, dt, "irwsm", protocol.nvr)
    if protocol.velocity == "first pass":
        return found
    assert found.nvr is not None
    first = irwsm(y[:, 0], 2, float(found.nvr[0, 0]))
    between = irwsm(first.slope, 2, float(found.nvr[0, 1])).level / dt
    qd = np.concatenate([between[:1], (between[1:] + between[:-1]) / 2, between[-1:]])
    return replace(found, qd=qd[:, None])


def _irwsm2(y: Array, dt: float, protocol: Protocol) -> Derivatives:
    return differentiate(y, dt, "irwsm2", protocol.nvr)


METHODS: Mapping[str, Callable[[Array, float, Protocol], Derivatives]] = {
    "bandpass": _bandpass,
    "IRWSM 1": _irwsm1,
    "IRWSM 2": _irwsm2,
}
