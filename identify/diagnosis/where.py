"""Dependences of the residual of each joint on each variable, with their shapes (thesis 7.3.2)."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armident.identify.diagnosis.bursts import Bursts, bursts
from armident.identify.diagnosis.candidates import Candidate, Workshop
from armident.identify.diagnosis.excess import Excess, excesses
from armident.identify.diagnosis.hints import hint_of, unit_of
from armident.identify.diagnosis.lines import lowest_frequency, of_references, residuals, strongest_line
from armident.identify.diagnosis.maps import Kind, Map, maps
from armident.identify.diagnosis.regression import Equation, Equations, Fit, solved
from armident.identify.diagnosis.screening import noise_beyond_shapes
from armident.identify.diagnosis.smoothing import smoothed
from armident.identify.diagnosis.trial import Trial, directions_beside, judge, noise_with, score_statistic
from armident.identify.effects.effect import Place
from armident.identify.effects.terms import effect_terms
from armident.identify.regression.ar_noise import ArModel

Array = NDArray[np.float64]

HELD_OUT_LEVEL = 0.05
"""Significance level of the held-out data alone for a dependence."""

SCREEN = 1e-3
"""Significance level on the training residual for a test on the held-out data."""

LOOKS = 6
"""Most maps of one joint with a test on held-out data, best fit of the training residual first."""

MATERIAL = 0.02
"""Share of a joint's held-out residual power that an unexplained dependence must have to be reported."""

SLOWEST = 0.25
"""Lowest frequency of a line at a joint with nothing else left, over the bandwidth of the motion."""

OF_OTHERS: tuple[Kind, ...] = ("velocity of another joint", "torque of another joint")
"""Variables that belong to another joint."""

MOST = 2
"""Most unexplained dependences of one joint."""


@dataclass(frozen=True)
class Curve:
    """A shape with its uncertainty.

    Parameters
    ----------
    x
        Values of the variable, (G,).
    value
        Missing torque of the model there, N m or N, (G,).
    band
        Two standard deviations, (G,).
    """

    x: Array
    value: Array
    band: Array


@dataclass(frozen=True)
class Disagreement:
    """Dependence of one joint's residual on one variable.

    Parameters
    ----------
    joint
        Its name.
    kind, other
        Variable; the joint or motor to which it belongs, if it is another one.
    unit
        Unit of the variable.
    share
        Share of the power of the joint's whitened held-out residual that the dependence, fitted on the training data,
        predicts. For a frequency: share of the residual at the working rate. For the motion: share that is not noise.
        For transients: share of the smoothed residual beyond noise of its usual power.
    p_value
        Probability of so clear a result without the dependence, of this one test.
    curve
        Its shape. For a frequency: the spectrum around it. For the motion: the root of the spectral density of the
        residual, per root of a hertz, with that of the noise as band. For transients: the root mean square in each
        window, with that of noise as band.
    """

    joint: str
    kind: Kind
    other: str | None
    unit: str
    share: float
    p_value: float
    curve: Curve

    @property
    def varies_with(self) -> str:
        """The variable in words."""
        if self.other is None:
            return self.kind
        if self.kind == "motor angle":
            return f"motor angle of {self.other}"
        return f"{self.kind.removesuffix(' of another joint')} of {self.other}"

    @property
    def of_noise(self) -> bool:
        """True if the band of the curve is the level of noise instead of the uncertainty of the curve."""
        return self.kind in ("frequency", "motion", "transients")

    @property
    def hint(self) -> str:
        """Maintenance hint: probable causes and checks at the machine."""
        height = np.abs(self.curve.value)
        if self.kind in ("motion", "transients"):
            height = height / np.maximum(self.curve.band, 1e-300)
        at = self.curve.x[int(np.argmax(height))]
        return hint_of(self.kind, self.joint, self.other, f"{at:.3g} {self.unit}")


@dataclass(frozen=True, eq=False)
class Survey:
    """All significant dependences of the residual of a fit.

    Parameters
    ----------
    bench
        Cache of the columns of the maps.
    level
        Significance level of one test.
    significant
        Maps with significant trials.
    lines
        Spectral lines.
    """

    bench: Workshop
    level: float
    significant: tuple["_Found", ...]
    lines: tuple[Disagreement, ...]


def survey(fit: Fit, workshop: Workshop, alpha: float = 0.01) -> Survey:
    """All significant dependences of the residual of a fit, over all variables and joints.

    Parameters
    ----------
    fit
        Fit of the model.
    workshop
        Cache of the columns of the same fit.
    alpha
        Probability of a false alarm over all variables and joints.
    """
    own = _bench(workshop)
    level = alpha / _tests(fit, own)
    return Survey(
        own, level, tuple(_significant(fit, own, level)), tuple(_lines(fit, level, lowest_frequency(fit.study)))
    )


def where(fit: Fit, workshop: Workshop, alpha: float = 0.01, *, seen: Survey | None = None) -> list[Disagreement]:
    """All variables on which a residual depends, ordered by the share they explain on held-out data.

    Every variable is one effect with a free shape, and passes the same test as the effects of the catalogue. Lines in
    the spectrum are tested against the spectrum around them.

    Parameters
    ----------
    fit
        Fit of the model.
    workshop
        Cache of the columns of the same fit.
    alpha
        Probability of a false alarm over all variables and joints.
    seen
        Survey of this fit, if there is one.
    """
    seen = seen or survey(fit, workshop, alpha)
    best: dict[tuple[int, Kind, int | None], _Found] = {}
    for f in sorted(seen.significant, key=lambda f: -f.trial.share):
        best.setdefault((f.map.joint, f.map.kind, f.map.other), f)
    found = [f.disagreement(fit, seen.bench) for f in best.values()]
    return sorted([*found, *seen.lines], key=lambda d: -d.share)


def unexplained(fit: Fit, workshop: Workshop, alpha: float = 0.01, *, seen: Survey | None = None) -> list[Disagreement]:
    """Remaining material dependences, at most `MOST` of each joint, each in addition to the ones before it.

    A variable that is merely correlated with a stronger one (speed with torque, for example) is not listed again.

    Parameters
    ----------
    fit
        Fit of the model.
    workshop
        Cache of the columns of the same fit.
    alpha
        Probability of a false alarm over all variables and joints.
    seen
        Survey of this fit, if there is one.
    """
    study, seen = fit.study, seen or survey(fit, workshop, alpha)
    own, level, significant, lines = seen.bench, seen.level, seen.significant, seen.lines
    found: list[Disagreement] = []
    for j, joint in enumerate(study.joints):
        here: list[Disagreement] = [line for line in lines if line.joint == joint and line.share >= MATERIAL]
        rivals = [f for f in significant if f.map.joint == j and f.trial.share >= MATERIAL]
        base = fit
        while rivals and len(here) < MOST:
            best = max(rivals, key=lambda f: f.trial.share)
            here.append(best.disagreement(base, own))
            base = _with(base, best, own)
            again = [_judged(base, f.map, own) for f in rivals if f is not best]
            rivals = [f for f in again if f is not None and f.passes(level) and f.trial.share >= MATERIAL]
        found += here
    return sorted(found, key=lambda d: -d.share)


def strangers(fit: Fit, workshop: Workshop, joints: Collection[int], alpha: float = 0.01) -> list["Stranger"]:
    """Dependences of the residuals of some joints on variables of other joints, of any shape.

    They are unnamed rivals of effects of the catalogue at these joints: their scores are comparable.

    Parameters
    ----------
    fit
        Fit of the model.
    workshop
        Cache of the columns of the same fit.
    joints
        Numbers of the joints.
    alpha
        Probability of a false alarm over all variables and joints.
    """
    own = _bench(workshop)
    every = _maps(fit, workshop)
    mine = [m for m in every if m.other is not None and m.kind in OF_OTHERS and m.joint in joints]
    return [Stranger(fit, f, own) for f in _passing(fit, mine, own, alpha / (len(every) + fit.study.robot.n))]


def beyond_noise(fit: Fit, left: Sequence[Disagreement], alpha: float = 0.01) -> list[Disagreement]:
    """Remaining dependences, with the joints whose lack of fit no named dependence explains for the most part.

    Joints without any dependence are also tested for lines among the frequencies of the motion and for transients; a
    missing effect of another kind may cause either.

    Parameters
    ----------
    fit
        Fit of the model.
    left
        Remaining named dependences.
    alpha
        Probability of a false alarm over all joints and tests.
    """
    found = list(left)
    for excess in excesses(fit, alpha / 2):
        joint = fit.study.joints[excess.joint]
        named = sum(d.share for d in left if d.joint == joint and d.kind != "frequency")
        if named < 0.5 * excess.share:
            found.append(_moving(joint, excess))
    slow = _lines(fit, alpha / 6 / fit.study.robot.n, SLOWEST * lowest_frequency(fit.study))
    found += [line for line in slow if line.share >= MATERIAL and line.joint not in {d.joint for d in found}]
    # Effects with jumps have heavy tails themselves.
    told = {d.joint for d in found} | {
        fit.study.joints[t.place.joint] for t in effect_terms(fit.study.model) if t.effect.sudden
    }
    found += [
        _bursting(fit.study.joints[j], own)
        for j, own in bursts(fit, alpha / 3).items()
        if fit.study.joints[j] not in told
    ]
    return sorted(found, key=lambda d: -d.share)


def _moving(joint: str, excess: Excess) -> Disagreement:
    curve = Curve(excess.f, excess.amplitude, excess.noise)
    return Disagreement(joint, "motion", None, unit_of("motion", ""), excess.share, excess.p_value, curve)


def _bursting(joint: str, own: Bursts) -> Disagreement:
    kind: Kind = "transients"
    return Disagreement(
        joint, kind, None, unit_of(kind, ""), own.share, own.p_value, Curve(own.t, own.amplitude, own.noise)
    )


@dataclass(frozen=True, eq=False)
class _Found:
    """A map and its trial."""

    map: Map
    trial: Trial

    def passes(self, level: float) -> bool:
        return self.trial.p_value < level and self.trial.p_held < HELD_OUT_LEVEL and self.trial.gain > 0

    def disagreement(self, fit: Fit, workshop: Workshop) -> Disagreement:
        """Return the dependence of the residual on the variables of the map, as a smoothed curve.

        Parameters
        ----------
        fit
            Fit of the model.
        workshop
            Columns of the model and of the effects.
        """
        study, m = fit.study, self.map
        other = None if m.other is None else study.joints[m.other]
        x = np.linspace(m.low, m.high, 121)
        side = np.sign(x) if m.kind == "velocity" else np.ones_like(x)
        basis = m.shape(x, side)
        own = fit.renoised(_noise(fit, self.trial, workshop))
        columns = workshop.columns(m.effect(), Place(m.joint), (), own.noise)
        # The kink of dry friction at standstill is no roughness.
        pieces = [basis[x <= 0], basis[x >= 0]] if m.kind == "velocity" else [basis]
        value, band = smoothed(own, columns, basis, pieces)
        return Disagreement(
            study.joints[m.joint],
            m.kind,
            other,
            unit_of(m.kind, study.robot.joints[m.joint if m.other is None else m.other].type),
            min(self.trial.share, 1.0),
            self.trial.p_value,
            Curve(x, value, band),
        )


@dataclass(frozen=True, eq=False)
class Stranger:
    """Dependence of a residual on a variable of another joint.

    Parameters
    ----------
    fit
        Fit of the model.
    found
        Map and its trial.
    bench
        Cache of the columns of the maps.
    """

    fit: Fit
    found: _Found
    bench: Workshop

    @property
    def score(self) -> float:
        """Score of its trial."""
        return self.found.trial.score

    def disagreement(self) -> Disagreement:
        """The dependence with its curve."""
        return self.found.disagreement(self.fit, self.bench)

    def beside(self, fit: Fit, workshop: Workshop) -> float:
        """Score of the map in addition to another model; zero if it has none.

        Parameters
        ----------
        fit
            Fit of the other model.
        workshop
            Cache of the columns of the other fit.
        """
        again = _judged(fit, self.found.map, _bench(workshop))
        return 0.0 if again is None else max(again.trial.score, 0.0)


def _bench(workshop: Workshop) -> Workshop:
    """Cache with the same motions, without columns of effects of the catalogue."""
    return replace(workshop, kept={})


def _maps(fit: Fit, workshop: Workshop) -> list[Map]:
    return list(maps(fit.study, [workshop.motion(s, "simulated") for s in fit.study.train]))


def _tests(fit: Fit, workshop: Workshop) -> int:
    """Number of tests that share the error rate: every map, and the spectrum of every joint."""
    return len(_maps(fit, workshop)) + fit.study.robot.n


def _significant(fit: Fit, workshop: Workshop, level: float) -> list[_Found]:
    """Maps with significant trials, among those selected by the training data."""
    return _passing(fit, _maps(fit, workshop), workshop, level)


def _passing(fit: Fit, tried: Sequence[Map], workshop: Workshop, level: float) -> list[_Found]:
    calm = fit.renoised(noise_beyond_shapes(fit, workshop))
    looks: dict[int, list[tuple[float, Map]]] = {}
    for m in tried:
        effect = m.effect()
        statistic = score_statistic(calm, workshop.grid(effect, Place(m.joint), ((),), calm.noise, keep=False))
        if statistic is None:
            continue
        p = float(stats.chi2.sf(statistic, len(effect.linear)))
        if p < SCREEN:
            looks.setdefault(m.joint, []).append((p, m))
    chosen = [m for look in looks.values() for _, m in sorted(look, key=lambda pm: pm[0])[:LOOKS]]
    judged = (_judged(fit, m, workshop) for m in chosen)
    return [f for f in judged if f is not None and f.passes(level)]


def _judged(fit: Fit, m: Map, workshop: Workshop) -> _Found | None:
    trial = judge(fit, Candidate(m.effect(), Place(m.joint), ((),)), (), workshop)
    return None if trial is None else _Found(m, trial)


def _noise(fit: Fit, trial: Trial, workshop: Workshop) -> list[ArModel]:
    return noise_with(fit, trial.candidate, trial.shapes, workshop, trial.values, trial.away)


def _with(fit: Fit, found: _Found, workshop: Workshop) -> Fit:
    """Fit with a map among the terms, without the part that the model contained before."""
    effect, place = found.map.effect(), Place(found.map.joint)
    own = fit.renoised(_noise(fit, found.trial, workshop))
    basis = directions_beside(own, workshop.instruments(effect, place, (), own.noise))
    assert basis is not None
    _, right, scale = basis
    through = right / scale[:, None]

    def extended(part: str, rows: tuple[Equation, ...]) -> tuple[Equation, ...]:
        measured, simulated = (workshop.band(effect, place, (), part, kind) for kind in ("measured", "simulated"))
        return tuple(
            (np.concatenate([x, c @ through], axis=2), np.concatenate([z, d @ through], axis=2), y)
            for (x, z, y), c, d in zip(rows, measured, simulated, strict=True)
        )

    equations = Equations(extended("train", fit.equations.train), extended("held", fit.equations.held))
    theta = None
    if fit.fixed:
        theta = np.concatenate([fit.theta, np.linalg.lstsq(through, found.trial.values, rcond=None)[0]])
    return solved(fit.study, equations, own.noise, theta)


def _lines(fit: Fit, level: float, lowest: float) -> list[Disagreement]:
    """The strongest line of each joint from a frequency on, Hz, where there is one."""
    study = fit.study
    train = residuals(study, study.train, fit.theta)
    held = residuals(study, study.held, fit.theta)
    found: list[Disagreement] = []
    for j, joint in enumerate(study.joints):
        line = strongest_line([e[:, j] for e in train], [e[:, j] for e in held], study.dt, lowest)
        if line is None or not line.p_value < level or not line.p_held < HELD_OUT_LEVEL:
            continue
        if of_references(study, line.frequency):
            continue
        curve = Curve(line.f, line.amplitude, line.noise)
        found.append(Disagreement(joint, "frequency", None, "Hz", line.share, line.p_value, curve))
    return found
