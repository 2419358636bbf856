"""Claims of the thesis, tested on the reproduced tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError
from armident.identify.regression.ar_noise import whiteness
from armident.identify.regression.equations import Estimate
from tests.reproduction.cached_estimates import Case, Laboratory, Run
from tests.reproduction.chapter4 import singular_values
from tests.reproduction.chapter5 import GOOD, IMPULSE_RESPONSES, NOTHING, OWN_RESPONSES, POOR_IV, smoothed
from tests.reproduction.chapter6 import (
    COARSE,
    COARSE_CARELESS,
    COARSE_ROUGH,
    ROUGH,
    UNDECIMATED,
    degraded,
    nearest,
)
from tests.reproduction.context import Bench
from tests.reproduction.emps_controller import controllers_on_emps

Array = NDArray[np.float64]

SAME = 1.0
"""RMS difference, in standard deviations, below which two estimates agree."""
FAR = 4.0
"""Error in standard deviations that noise causes in one of 28 parameters with a probability of 1/600."""
INSENSITIVE = 1000.0
"""Least ratio of the smallest singular values of the CLIE and CLOE Jacobians: "thousands of times"."""
GEAR_ERROR = 0.2
"""Relative error of the simulator's gear ratios, and expected relative error of DIDIM."""
ABOUT = 0.5
"""Relative difference below which two numbers agree approximately."""
WHITE = 0.1
"""Largest fraction of residual autocorrelations outside their 2-sigma band for residuals that count as white.

0.05 is expected; the mean over 6 joints and 20 lags has a standard deviation of 0.02.
"""
PROPORTIONAL = ("zz", "xx", "ia", "fv")
"""Parameters that multiply velocities and accelerations, which wrong gear ratios scale."""


@dataclass(frozen=True)
class Finding:
    """One part of a claim: ``text`` with the figures, ``holds`` if they are as claimed."""

    holds: bool
    text: str


@dataclass(frozen=True)
class Claim:
    """A claim of the thesis.

    ``number``, ``text``: number and wording. ``findings``: its parts; it holds if all of them do. ``remark``:
    explanation of a part that does not hold.
    """

    number: int
    text: str
    findings: tuple[Finding, ...]
    remark: str = ""

    @property
    def holds(self) -> bool:
        """True if all parts hold."""
        return all(finding.holds for finding in self.findings)


def sensitivity(bench: Bench) -> list[Finding]:
    """Test the sensitivity of positions and torques, and the cost of DIDIM and CLIE (thesis section 4.1)."""
    lab = bench.virtual
    clie, didim = lab.run("clie", GOOD), lab.run("didim", GOOD)
    values = singular_values(lab, GOOD)
    ratio = float(values.clie[-1] / values.cloe[-1])
    each, b = didim.simulations / didim.estimate.iterations, len(lab.names)
    return [
        Finding(
            ratio > INSENSITIVE,
            f"the smallest singular value of the torques' Jacobian is {ratio:.0f} times that of the positions' "
            f"(more than {INSENSITIVE:.0f})",
        ),
        _same("CLIE", clie, "DIDIM", didim.estimate),
        Finding(
            each < 2 and clie.simulations > b,
            f"DIDIM needs {each:.1f} simulations per iteration, {didim.simulations} in all; CLIE, with {b + 1} per "
            f"Jacobian, {clie.simulations} in all",
        ),
    ]


def derivatives(bench: Bench) -> list[Finding]:
    """Test the errors of velocity and acceleration on the simulated EMPS (thesis section 5.1.4)."""
    errors = {row.label: row.ours for row in bench.emps_derivatives()}
    found = []
    for k, signal in ((1, "velocity"), (2, "acceleration")):
        for method in ("IRWSM 1", "IRWSM 2"):
            ours, bandpass = errors[method][k], errors["bandpass"][k]
            found.append(
                Finding(
                    ours < bandpass,
                    f"{signal}: {method} has an error of {ours:.2g} %, the bandpass {bandpass:.2g} % "
                    f"({bandpass / ours:.2g} times as much; claimed is less than the bandpass)",
                )
            )
    return found


def robustness(bench: Bench) -> list[Finding]:
    """Test the robustness of DIDIM and IDIM-IV to wrong gear ratios (thesis section 4.2.3)."""
    lab = bench.virtual
    wrong = replace(GOOD, gear_ratio=1.0 - GEAR_ERROR)
    iv, didim = lab.run("idim-iv", GOOD).estimate, lab.run("didim", GOOD).estimate
    moved_iv = apart(lab.run("idim-iv", wrong).estimate.theta, iv)
    shifted = lab.run("didim", wrong).estimate.theta
    chosen = [k for k, name in enumerate(lab.names) if name.startswith(PROPORTIONAL)]
    moved = float(np.median(np.abs(shifted / didim.theta - 1)[chosen]))
    return [
        Finding(moved_iv < SAME, f"IDIM-IV changes by {moved_iv:.2f} of its standard deviations (less than {SAME:g})"),
        Finding(
            abs(moved - GEAR_ERROR) < ABOUT * GEAR_ERROR,
            f"DIDIM changes inertias and viscous friction by {100 * moved:.0f} % (median; about "
            f"{100 * GEAR_ERROR:.0f}), "
            f"all parameters by {apart(shifted, didim):.1f} of its standard deviations",
        ),
    ]


def knowledge(bench: Bench) -> list[Finding]:
    """Test IDIM-LS and IDIM-IV with IRWSM with badly chosen filters (thesis section 5.3)."""
    lab = bench.virtual
    std = lab.run("idim-iv", GOOD).estimate.std
    found = []
    for label, case in (("poor knowledge", POOR_IV), ("no filter at all", NOTHING)):
        instrumental = [lab.run("idim-iv", smooth) for smooth in smoothed(case)]
        # The effect of noise on both cancels on the same data; the bias remains.
        contrast = farthest(lab.names, lab.run("idim-ls", case), instrumental[0].estimate.theta, std)
        found.append(
            Finding(contrast.score > FAR, f"{label}: IDIM-LS differs by {contrast} from IDIM-IV (more than {FAR:g})")
        )
        for name, run in zip(("IRWSM 1", "IRWSM 2"), instrumental, strict=True):
            error = farthest(lab.names, run, lab.truth, std)
            found.append(
                Finding(
                    error.score < FAR,
                    f"{label}: IDIM-IV with {name} differs by {error} from the truth (less than {FAR:g})",
                )
            )
    return found


def controller(bench: Bench) -> list[Finding]:
    """Test impulse responses as controllers of IDIM-IV and DIDIM (thesis section 5.3.3)."""
    found = _responses("drives on the tracking error alone", bench.virtual, exact=True)
    found += _responses("drives that feed back the velocity", bench.feedback, exact=False)
    axes = [] if bench.axis is None else [("virtual", bench.axis.recording(Case()))]
    axes += [] if bench.emps is None else [("measured", bench.emps)]
    for kind, recorded in axes:
        emps = controllers_on_emps(recorded)
        (law, response), (direct, shifted) = emps.idim_iv, emps.didim
        near, moved = apart(response.theta, law), apart(shifted.theta, direct)
        found.append(
            Finding(
                near < SAME < moved,
                f"{kind} EMPS, whose drive feeds back the velocity (the response explains {emps.fit_pct:.1f} % of the "
                f"force): IDIM-IV with it differs by {near:.2f} standard deviations, DIDIM by {moved:.1f}",
            )
        )
    return found


def _responses(drives: str, lab: Laboratory, *, exact: bool) -> list[Finding]:
    """Test IDIM-IV and DIDIM with the impulse responses of the thesis; DIDIM needs ``exact`` ones."""
    actual = {method: lab.run(method, Case()).estimate for method in ("idim-iv", "didim")}
    near = apart(lab.run("idim-iv", IMPULSE_RESPONSES).estimate.theta, actual["idim-iv"])
    try:
        responses = lab.run("didim", IMPULSE_RESPONSES)
    except DataError:
        works, text = False, "has no closed loop that can be simulated"
    else:
        moved = apart(responses.estimate.theta, actual["didim"])
        works = responses.estimate.converged and moved < SAME
        converges = "converges" if responses.estimate.converged else "does not converge"
        farther = farthest(lab.names, responses, lab.truth, actual["didim"].std)
        text = (
            f"{converges} and differs by {moved:.2f} standard deviations "
            f"({'less' if exact else 'more'} than {SAME:g}), {farther} from the truth"
        )
    fits = [response.fit_pct for response in lab.identified(IMPULSE_RESPONSES).responses]
    found = [
        Finding(
            near < SAME,
            f"{drives}: IDIM-IV with impulse responses differs by {near:.2f} standard deviations (less than {SAME:g})",
        ),
        Finding(
            works is exact,
            f"{drives}: DIDIM with impulse responses {text}; they explain {min(fits):.0f} to {max(fits):.0f} % of the "
            "torque",
        ),
    ]
    if exact:
        return found
    own = apart(lab.run("didim", OWN_RESPONSES).estimate.theta, actual["didim"])
    return [
        *found,
        Finding(
            own < SAME,
            f"{drives}: with our responses, from the velocity too, DIDIM differs by {own:.2f} "
            f"standard deviations (less than {SAME:g})",
        ),
    ]


def noise(bench: Bench) -> list[Finding]:
    """Test noise models: white residuals, equal parameters, gain with degraded encoders (thesis section 6.3)."""
    lab = bench.virtual
    didim, sep = lab.run("didim", GOOD).estimate, lab.run("sep-pem", UNDECIMATED)
    iv, piv = lab.run("idim-iv", Case()).estimate, lab.run("idim-piv", ROUGH)
    found = [
        _same("SEP-PEM", sep, "DIDIM", didim),
        _white("SEP-PEM", sep, lab.run("didim", UNDECIMATED).estimate, "DIDIM without decimation"),
        _same("IDIM-PIV", piv, "IDIM-IV", iv),
        _white("IDIM-PIV", piv, lab.run("idim-iv", ROUGH).estimate, "IDIM-IV with that decimation"),
    ]
    plain = lab.run("idim-iv", COARSE).estimate
    refined = lab.run("idim-piv", COARSE_ROUGH).estimate
    ratio = float(np.median(refined.std / plain.std))
    found.append(
        Finding(ratio < 1, f"degraded encoders: standard deviations of IDIM-PIV are {ratio:.2f} of those of IDIM-IV")
    )
    for drives, arm in (("", lab), (", velocity feedback", bench.feedback)):
        found += _biased(f"degraded encoders{drives}", arm)
    return found


def _biased(what: str, lab: Laboratory) -> list[Finding]:
    """Test the bias of IDIM-LS with degraded encoders for several parallel filters."""
    known, *others = tried = degraded(lab)
    near = nearest(others)
    hz = near.case.cutoff_hz
    runs = near.run, known.run, lab.run("idim-ls", COARSE_CARELESS)
    # In its own standard deviations, which include the rounding.
    bias, rest, careless = (farthest(lab.names, run, lab.truth, run.estimate.std) for run in runs)
    return [
        Finding(
            bias.score > FAR and nearest(tried) is near,
            f"{what}, parallel filter of {hz:.0f} Hz, the closest to the published column (correlation "
            f"of the errors {near.correlation:.2f}): IDIM-LS differs by {bias} from the truth (more than {FAR:g})",
        ),
        Finding(
            rest.score < FAR,
            f"{what}, the {known.case.cutoff_hz:.0f} Hz of a known bandwidth (correlation {known.correlation:.2f}): "
            f"IDIM-LS differs by {rest} from the truth (less than {FAR:g})",
        ),
        Finding(
            careless.score > FAR,
            f"{what} and poor knowledge: IDIM-LS differs by {careless} from the truth (more than {FAR:g})",
        ),
    ]


@dataclass(frozen=True)
class Farthest:
    """Parameter with the largest error in standard deviations."""

    name: str
    error_pct: float
    score: float

    def __str__(self) -> str:
        """Return name, error in percent and error in standard deviations."""
        return f"{self.name} {self.error_pct:+.0f} %, {self.score:.1f} standard deviations"


def farthest(names: Sequence[str], run: Run, wanted: Array, std: Array) -> Farthest:
    """Return the parameter with the largest error in given standard deviations.

    ``wanted``: correct parameters (b,); ``std``: standard deviations (b,).
    """
    score = np.abs(run.estimate.theta - wanted) / std
    k = int(np.argmax(score))
    return Farthest(names[k], 100 * float(run.estimate.theta[k] / wanted[k] - 1), float(score[k]))


def apart(theta: Array, other: Estimate) -> float:
    """Return the RMS difference of parameters from another estimate in its standard deviations.

    ``theta``: parameters (b,), SI units.
    """
    return float(np.sqrt(np.mean(((theta - other.theta) / other.std) ** 2)))


def serial(estimate: Estimate) -> float:
    """Return the fraction of residual autocorrelations outside their 2-sigma band, mean over the joints."""
    return float(np.mean([whiteness(series).fraction_outside for series in estimate.residuals]))


def _same(name: str, run: Run, other: str, estimate: Estimate) -> Finding:
    difference = apart(run.estimate.theta, estimate)
    return Finding(
        difference < SAME, f"{name} differs from {other} by {difference:.2f} standard deviations (less than {SAME:g})"
    )


def _white(name: str, run: Run, plain: Estimate, other: str) -> Finding:
    outside, without = serial(run.estimate), serial(plain)
    return Finding(
        outside < WHITE < without,
        f"{name} leaves {100 * outside:.0f} % of the residual autocorrelations outside 2 sigma, "
        f"{other} {100 * without:.0f} % (white: 5)",
    )


@dataclass(frozen=True)
class Judgement:
    """Test of a claim.

    ``number``, ``text``: number and wording of the claim; ``tables``: numbers of the tables that the test needs;
    ``remark``: explanation, printed if the claim does not hold.
    """

    number: int
    text: str
    tables: tuple[str, ...]
    look: Callable[[Bench], list[Finding]]
    remark: str = ""


JUDGEMENTS = (
    Judgement(
        1,
        "positions are thousands of times less sensitive than torques (CLOE, CLIE); CLIE and DIDIM agree; DIDIM needs "
        "one simulation per iteration",
        ("4.4", "4.5"),
        sensitivity,
    ),
    Judgement(
        2,
        "with wrong gear ratios in the simulator IDIM-IV does not change and DIDIM changes by about as much",
        ("4.6", "4.7"),
        robustness,
    ),
    Judgement(
        3,
        "the errors of IRWSM 1 and 2 in velocity and acceleration of the simulated EMPS are very small and less than "
        "those of the bandpass",
        ("5.2",),
        derivatives,
        "the bandpass here has no delay; the published errors of 0.55 % and 1.15 % have the ratio 1 to 2.1 of forward "
        "differences, half a sample late (velocity) and one sample late (acceleration); with such differences the "
        "protocol inferred from table 5.2 has errors one to two orders of magnitude above those of IRWSM 1",
    ),
    Judgement(
        4,
        "IDIM-LS fails with badly chosen filters, IDIM-IV with IRWSM does not, even without any filter",
        ("5.8", "5.10", "5.11"),
        knowledge,
    ),
    Judgement(
        5,
        "IDIM-IV works with impulse responses for the controller, DIDIM does not: true for drives with velocity "
        "feedback; for drives on the tracking error alone such a response is exact, and both work",
        ("5.13", "5.14"),
        controller,
    ),
    Judgement(
        6,
        "SEP-PEM equals DIDIM, IDIM-PIV equals IDIM-IV, both whiten the residuals; with degraded encoders IDIM-PIV "
        "has smaller standard deviations while IDIM-LS is biased: true if the cut-off of the parallel filter is above "
        "twice the bandwidth, as the published IDIM-LS column implies",
        ("6.1", "6.7"),
        noise,
        "with the filters of a known bandwidth little of the rounding errors passes into the accelerations, and "
        "IDIM-LS is not biased",
    ),
)


def judged(bench: Bench, numbers: Sequence[str]) -> list[Claim]:
    """Test the claims whose tables are all among ``numbers``.

    ``bench``: arms with their cached estimates; ``numbers``: numbers of the reproduced tables.
    """
    return [
        Claim(j.number, j.text, tuple(j.look(bench)), j.remark) for j in JUDGEMENTS if set(j.tables) <= set(numbers)
    ]
