"""Lack of fit: dependences of each joint's residual on free functions of the simulated motion (thesis 7.3.2).

The functions are free of noise and orthogonal to the regressor. The residual beyond them gives the noise models, which
would otherwise take a missing effect for noise. Block sums contain further serial correlation (Kuensch 1989, Annals of
Statistics 17(3)).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.excess import (
    Excess,
    away_from_reversals,
    bursts,
    larger_errors,
    spectral_excess,
    together,
)
from armident.identify.diagnosis.free_functions import FINE, FreeFunction, free_functions, in_band
from armident.identify.diagnosis.noise_beyond import noise_beyond
from armident.identify.diagnosis.predictive_score import mean_square
from armident.identify.diagnosis.projection import JointResidual, Projection
from armident.identify.diagnosis.regression import IvFit
from armident.identify.diagnosis.spectral_lines import SpectralLine, bandwidth_of_motion, lines_of_joints
from armident.identify.diagnosis.stretch import MotionStretch
from armident.identify.diagnosis.variables import Kind, hint_of, unit_of_variable
from armident.identify.regression.whitening import rows_of_joints
from armident.identify.robot.motion import Motion
from armident.identify.signals.periodogram import hann_window, periodogram

NORMAL = 1.4826
"""Standard deviation of a normal variable over the median of its absolute value."""

RANK = 1e-10
"""Singular value of a joint's regressor over the largest below which it is a rounding error."""

OCTAVES = (0.0, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Edges of the frequencies of the spectrum of a dependence on the motion, over the bandwidth of the motion."""


@dataclass(frozen=True)
class Curve:
    """Missing torque ``value`` (G,) at ``x`` (G,), N m or N, with two standard deviations ``band`` (G,)."""

    x: Array
    value: Array
    band: Array


@dataclass(frozen=True)
class ResidualDependence:
    """Dependence of one joint's residual on one variable; ``other``: joint or motor of the variable, if another one.

    ``share``: share of the power of the held-out residual that the training shape predicts; for a frequency, of that at
    the working rate. ``p_value``: of this one test. ``curve``: for a frequency the spectrum around it. For the motion
    the root of the residual's spectral density, with that without the dependence as band. ``where``: moments, s, or
    frequency, Hz, that the hint names; else that of the largest value.
    """

    joint: str
    kind: Kind
    other: str | None
    unit: str
    share: float
    p_value: float
    curve: Curve
    where: tuple[float, ...] = ()

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
        return self.kind in ("frequency", "motion", "unrecorded signal", "bursts", "recording")

    @property
    def hint(self) -> str:
        """Maintenance hint: probable causes and checks at the machine."""
        height = np.abs(self.curve.value)
        if self.kind == "motion":
            height = height / np.maximum(self.curve.band, 1e-300)
        at = self.where or (float(self.curve.x[int(np.argmax(height))]),)
        return hint_of(self.kind, self.joint, self.other, f"{', '.join(f'{x:.3g}' for x in at)} {self.unit}")


@dataclass(frozen=True, eq=False)
class LackOfFit:
    """All tests of the residual of one fit. ``fit``: fit of the model."""

    fit: IvFit

    @property
    def criteria(self) -> Criteria:
        """Thresholds."""
        return self.fit.study.criteria

    @property
    def level(self) -> float:
        """Significance level of one test: the false-alarm rate over the number of all tests (Bonferroni)."""
        return self.criteria.alpha["lack_of_fit"] / max(self.tests, 1)

    @property
    def dependences(self) -> tuple[ResidualDependence, ...]:
        """Significant dependences, at most one for each joint and variable, largest share first."""
        best: dict[tuple[int, Kind | None, int | None], Projection] = {}
        for p in sorted(filter(self._significant, self.projections), key=lambda p: p.p_value):
            at = (p.joint, None, None) if p.function is None else (p.joint, p.function.kind, p.function.other)
            best.setdefault(at, p)
        found = [self._dependence(p, self.joints[p.joint]) for p in best.values()]
        return _by_share([*found, *(self._of_line(*line) for line in self.lines if self._significant(line[1]))])

    @cached_property
    def unexplained(self) -> tuple[ResidualDependence, ...]:
        """Significant and material dependences, each in addition to the ones before it, largest share first.

        So a variable correlated with a stronger one (speed with torque, for example) is not listed again.
        """
        found: list[ResidualDependence] = []
        for j, own in enumerate(self.joints):
            mine = [p for p in self.projections if p.joint == j and self._reported(p)]
            rivals = [p for p in mine if p.function is not None]
            here: list[ResidualDependence] = []
            while rivals and len(here) < self.criteria.most_unexplained:
                best = max(rivals, key=lambda p: p.share)
                here.append(self._dependence(best, own))
                own = own.beyond(best.columns)
                again = [own.projection(p.function, p.columns) for p in rivals if p is not best]
                rivals = [p for p in again if p is not None and self._reported(p)]
            named = sum(d.share for d in here)
            found += here
            # The motion altogether, where no variable explains the greater part of what it does.
            least = named / self.criteria.motion_share
            found += [self._dependence(p, own) for p in mine if p.function is None and least < p.share]
            lines = [self._of_line(k, line) for k, line in self.lines if k == j and self._reported(line, j)]
            found += lines
            if not here and not lines:
                events = [event for event in self._excesses(j) if self._reported(event, j)]
                found += [self._of_excess(j, event) for event in events[:1]]
        return _by_share(found)

    @property
    def immaterial(self) -> tuple[tuple[ResidualDependence, float], ...]:
        """Largest significant dependence of each joint that has no material one, and the fall of its error, percent."""
        found = []
        for j, own in enumerate(self.joints):
            mine = [p for p in self.projections if p.joint == j and p.function is not None]
            small = [(self._fall(p, j), self._dependence(p, own)) for p in filter(self._significant, mine)]
            events = filter(self._significant, self._excesses(j))
            small += [(self._fall(event, j), self._of_excess(j, event)) for event in events]
            found += [max(small, key=lambda one: one[0])] if small else []
        reported = {d.joint for d in self.unexplained}
        return tuple((d, fall) for fall, d in found if d.joint not in reported)

    def _significant(self, test: Projection | SpectralLine | Excess) -> bool:
        if isinstance(test, Excess):
            # Nothing was selected by it, and an event need not be in the other data.
            return test.p_value < self.level
        return test.p_value < self.level and test.p_held < self.criteria.held_out_level and test.share > 0

    def _reported(self, test: Projection | SpectralLine | Excess, joint: int | None = None) -> bool:
        """True if a dependence is significant and material."""
        j = test.joint if isinstance(test, Projection) else joint
        assert j is not None
        large = test.share >= self.criteria.least_share and self._fall(test, j) >= self.criteria.material_pct
        return large and self._significant(test)

    def _fall(self, test: Projection | SpectralLine | Excess, joint: int) -> float:
        """By how much the error of a joint falls without a dependence, percent of its torque.

        It is that of the recording that shows it most: others need not move as it needs.
        """
        torque = np.concatenate([s.torques[:, joint] for s in self.fit.study.train])
        if isinstance(test, SpectralLine):
            fall = test.size
        elif isinstance(test, Excess):
            fall = test.error * (1.0 - np.sqrt(max(1.0 - test.share, 0.0)))
        else:
            errors = [e[:, joint] for e in self.fit.errors(self.fit.theta, held=True)]
            # Times about reversals, where dry friction has no model, are no evidence.
            away = away_from_reversals(errors, *self._speeds(joint, held=True))
            changes = np.split(test.change, np.cumsum([e.size for e in errors])[:-1])
            fall = max(map(_fall_of_error, errors, changes, away))
        return 100.0 * float(fall) / max(float(np.sqrt(mean_square(torque))), 1e-300)

    def _dependence(self, p: Projection, own: JointResidual) -> ResidualDependence:
        """Dependence with its curve."""
        study, share = self.fit.study, min(p.share, 1.0)
        joint = study.joints[p.joint]
        if p.function is None:
            return ResidualDependence(
                joint, "motion", None, unit_of_variable("motion", ""), share, p.p_value, self._spectrum(p, own)
            )
        x, basis, _ = p.function.on_grid()
        band = 2.0 * np.sqrt(np.maximum(np.einsum("gk,kl,gl->g", basis, p.covariance, basis), 0.0))
        at = p.joint if p.function.other is None else p.function.other
        return ResidualDependence(
            joint,
            p.function.kind,
            None if p.function.other is None else study.joints[p.function.other],
            unit_of_variable(p.function.kind, study.robot.joints[at].type),
            share,
            p.p_value,
            Curve(x, basis @ p.values, band),
        )

    def _of_line(self, joint: int, line: SpectralLine) -> ResidualDependence:
        name, curve = self.fit.study.joints[joint], Curve(line.f, line.amplitude, line.noise)
        return ResidualDependence(
            name, "frequency", None, unit_of_variable("frequency", ""), line.share, line.p_value, curve
        )

    def _excesses(self, joint: int) -> list[Excess]:
        """Parts of a joint's residual that are no broadband noise, the largest one first."""
        study = self.fit.study
        found: list[Excess] = []
        signals: list[Excess | None] = []
        away: list[list[Array]] = []
        for held, stretches in ((False, study.train), (True, study.held)):
            errors = [e[:, joint] for e in self.fit.errors(self.fit.theta, held=held)]
            velocities, slow = self._speeds(joint, held=held)
            away.append(away_from_reversals(errors, velocities, slow))
            taken: list[Array] = []
            if held:
                errors, taken = _refitted(errors, [e.z[:, joint] for e in self.fit.equations.held])
            moments = bursts(errors, [s.t for s in stretches], velocities, slow)
            if moments is not None and moments.share >= self.criteria.burst_share:
                found.append(moments)
            signals.append(spectral_excess(errors, velocities, study.dt * study.decimation.factor, slow, taken))
        one, other = together(*signals)
        times = [s.t for s in study.held]
        training, unseen = away
        larger = larger_errors(training, unseen, self._variance(joint), times, self.criteria.larger_residuals)
        if larger and other and other.kind == "unrecorded signal":
            # What the model lacks in the report part alone is in the band of the motion, too.
            other = None
        found += [signal for signal in (one, other) if signal is not None]
        return [*sorted(found, key=lambda event: -event.share), *([larger] if larger else [])]

    def _variance(self, joint: int) -> float:
        """Mean variance of the held-out prediction of a joint by the uncertainty of the parameters."""
        x = np.concatenate([e.x[:, joint] for e in self.fit.equations.held])
        return float(np.mean(np.einsum("mb,mb->m", x @ self.fit.covariance, x)))

    def _speeds(self, joint: int, *, held: bool) -> tuple[list[Array], float]:
        """Velocities (M,) of a joint in every stretch, and that under which its dry friction reverses."""
        study = self.fit.study
        measured = [s.measured.qd[:, joint] for s in (study.held if held else study.train)]
        return [qd[study.decimation.instants(qd.size)] for qd in measured], study.reversing_velocity(joint)

    def _of_excess(self, joint: int, excess: Excess) -> ResidualDependence:
        curve = Curve(excess.x, excess.value, excess.noise)
        name, unit = self.fit.study.joints[joint], unit_of_variable(excess.kind, "")
        return ResidualDependence(name, excess.kind, None, unit, excess.share, excess.p_value, curve, excess.where)

    def _spectrum(self, p: Projection, own: JointResidual) -> Curve:
        """Root of the spectral density of the held-out residual, with that of the rest as band."""
        study = self.fit.study
        dt, bandwidth = study.dt * study.decimation.factor, bandwidth_of_motion(study)
        f = np.fft.rfftfreq(own.errors.size, dt)
        window = hann_window(own.errors.size)
        densities = [2.0 * dt * periodogram(window * e) for e in (own.errors, own.errors - p.change)]
        shown = []
        for low, high in pairwise(OCTAVES):
            inside = (f > low * bandwidth) & (f <= high * bandwidth)
            if inside.any():
                shown.append((f[inside].mean(), *(np.sqrt(density[inside].mean()) for density in densities)))
        return Curve(*np.array(shown).T)

    @cached_property
    def lines(self) -> tuple[tuple[int, SpectralLine], ...]:
        """Strongest spectral line of each joint that has one, with the number of the joint."""
        return tuple(lines_of_joints(self.fit.study, self.fit.theta))

    @cached_property
    def projections(self) -> tuple[Projection, ...]:
        """Tests of all sets of functions of all joints, and of all functions of each joint together."""
        made = []
        for own in self.joints:
            sets = [*zip(self.functions[own.joint], self._sets(own.joint), strict=True)]
            every = [*sets, (None, self._all_together(own.joint))]
            made += [own.projection(function, columns) for function, columns in every]
        return tuple(p for p in made if p is not None)

    @cached_property
    def functions(self) -> tuple[tuple[FreeFunction, ...], ...]:
        """Sets of free functions of each joint."""
        study = self.fit.study
        motions = [self._motion(s) for s in study.train]
        return tuple(tuple(free_functions(study, motions, j)) for j in range(study.robot.n))

    @cached_property
    def joints(self) -> tuple[JointResidual, ...]:
        """Residual and functions of every joint, whitened by noise models of the residual beyond its dependences."""
        errors = self.fit.errors(self.fit.theta, held=False)
        model = [[e.z[:, j] for e in self.fit.equations.train] for j in range(self.fit.study.robot.n)]
        taken: list[set[int]] = [set() for _ in model]
        noise = [noise_beyond([e[:, j] for e in errors], z) for j, z in enumerate(model)]
        searched = set(range(len(model)))
        while True:
            joints = self._whitened(self.fit.renoised(noise))
            for own, known in zip(joints, taken, strict=True):
                if own.joint not in searched:
                    continue
                found = self._clearest(own, known) if len(known) < self.criteria.functions_in_noise else None
                if found is None:
                    # The noise models of the other joints hardly change its own functions.
                    searched.remove(own.joint)
                    continue
                known.add(found)
                columns = np.concatenate([self._sets(own.joint)[k] for k in known])
                functions = [
                    np.concatenate([z, c[:, columns]], axis=1)
                    for z, c in zip(model[own.joint], self.columns[0][own.joint], strict=True)
                ]
                noise[own.joint] = noise_beyond([e[:, own.joint] for e in errors], functions)
            if not searched:
                return joints

    def _clearest(self, own: JointResidual, known: set[int]) -> int | None:
        """Number of the set of functions with the most significant projection beyond those already taken out."""
        sets = self._sets(own.joint)
        for k in known:
            own = own.beyond(sets[k])
        every = [
            (own.projection(f, c), k) for k, (f, c) in enumerate(zip(self.functions[own.joint], sets, strict=True))
        ]
        found = [(p.p_value, k) for p, k in every if p is not None and k not in known]
        p_value, best = min(found, default=(1.0, 0))
        return best if p_value * self.tests < self.criteria.alpha["lack_of_fit"] else None

    @cached_property
    def tests(self) -> int:
        """Number of all tests: sets of functions, and seven of each joint.

        These are all functions together, a line, two of spectra, two of bursts, and errors larger than before.
        """
        return sum(len(own) + 7 for own in self.functions)

    def _whitened(self, fit: IvFit) -> tuple[JointResidual, ...]:
        blocks, rows = fit.equations.held, fit.regression.rows_of
        held_rows = rows_of_joints(sum(max(e.y.shape[0] - ar.order, 0) for e in blocks) for ar in fit.noise)
        regressor, instruments, _ = fit.held
        errors = fit.errors(fit.theta, held=True)
        most = self.criteria.robust_deviations
        residual, held_residual = limited(fit.residual, rows, most), limited(fit.held_residual, held_rows, most)
        out = []
        for j, (own, unseen) in enumerate(zip(*self.columns, strict=True)):
            d = np.concatenate([fit.noise[j].whiten(c) for c in own])
            full = np.zeros((fit.residual.size, d.shape[1]))
            full[rows[j]] = d
            away = fit.regression.absorbed(full)
            change = -instruments @ away
            change[held_rows[j]] += np.concatenate([fit.noise[j].whiten(c) for c in unseen])
            band = np.concatenate([c - e.z[:, j] @ away for c, e in zip(unseen, blocks, strict=True)])
            out.append(
                JointResidual(
                    j, rows[j], held_rows[j], d, fit.regression.orthogonalized(full), change, residual, held_residual,
                    band, np.concatenate([e[:, j] for e in errors]), held_rows, regressor, fit.covariance,
                    self.criteria.beyond_model_function,
                )
            )  # fmt: skip
        return tuple(out)

    @cached_property
    def columns(self) -> tuple[list[list[Array]], list[list[Array]]]:
        """Functions of each joint in the training and in the held-out data, (M, K) of every stretch."""
        return self._columns(self.fit.study.train), self._columns(self.fit.study.held)

    def _motion(self, stretch: MotionStretch) -> Motion:
        return self.fit.study.motion(stretch, "simulated", self.fit.theta)

    def _columns(self, stretches: Sequence[MotionStretch]) -> list[list[Array]]:
        """Functions of each joint at the simulated motion in the band of the comparison, (M, K) of every stretch."""
        every = [f for own in self.functions for f in own]
        out: list[list[Array]] = [[] for _ in self.functions]
        for stretch in stretches:
            made = in_band(self.fit.study, self._motion(stretch), every)
            for j, own in enumerate(self.functions):
                columns = np.concatenate([made[f.key] for f in own], axis=1)
                out[j].append(columns * stretch.weights[:, j, None])
        return out

    def _sets(self, joint: int) -> list[NDArray[np.int64]]:
        """Numbers of the columns of each set of functions of a joint."""
        sizes = [f.basis(np.zeros(1), np.zeros(1)).shape[1] for f in self.functions[joint]]
        return [np.arange(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]

    def _all_together(self, joint: int) -> NDArray[np.int64]:
        """Columns of the wide functions of the motion of a joint, as many as the data determine."""
        left = sum(np.count_nonzero(e.y[:, joint]) for e in self.fit.equations.train) // self.criteria.rows_per_function
        chosen: list[NDArray[np.int64]] = []
        for f, own in zip(self.functions[joint], self._sets(joint), strict=True):
            if f.kind != "motor angle" and len(f.knots) < FINE and own.size <= left:
                chosen.append(own)
                left -= own.size
        return np.concatenate(chosen) if chosen else np.arange(0)


def _fall_of_error(error: Array, change: Array, away: Array) -> float:
    """Return by how much the root mean square of errors (M,) falls with a change (M,) where ``away`` is not zero."""
    removed, power = (error**2 - (error - change) ** 2)[away != 0.0].sum(), float(error @ error)
    fall = float(np.sqrt(power) - np.sqrt(np.clip(power - removed, 0.0, power)))
    return fall / math.sqrt(int(np.count_nonzero(error)) or 1)


def _refitted(errors: Sequence[Array], regressors: Sequence[Array]) -> tuple[list[Array], list[Array]]:
    """Errors (M,) of a joint without what other parameters of the model explain, and the directions (M, k) of these.

    Errors of the parameters give the residual of other data the spectrum of the motion. ``regressors``: (M, b).
    """
    x, e = np.concatenate(regressors), np.concatenate(errors)
    taken, sizes, _ = np.linalg.svd(x / np.maximum(np.linalg.norm(x, axis=0), 1e-300), full_matrices=False)
    taken = taken[:, sizes > RANK * sizes.max()]
    parts = np.cumsum([one.size for one in errors])[:-1]
    return np.split(e - taken @ (taken.T @ e), parts), np.split(taken, parts)


def limited(residual: Array, joints: Sequence[slice], deviations: float) -> Array:
    """Return whitened residuals (R,) limited to a number of robust standard deviations of each joint.

    Signs of measured velocities are uncertain at reversals: a few errors of dry friction would outweigh all others.
    """
    found = residual.copy()
    for rows in joints:
        own = residual[rows]
        used = own[own != 0.0]
        if used.size:
            most = deviations * NORMAL * float(np.median(np.abs(used)))
            found[rows] = np.clip(own, -most, most)
    return found


def _by_share(found: Sequence[ResidualDependence]) -> tuple[ResidualDependence, ...]:
    return tuple(sorted(found, key=lambda d: -d.share))
