"""Model of one step of a diagnosis: the data with its closed loop, the fit, and the predictive score."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import DataError, RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.candidates import ColumnCache
from armident.identify.diagnosis.noise_beyond import noise_beyond_shapes
from armident.identify.diagnosis.predictive_score import PredictiveScore, references_of
from armident.identify.diagnosis.regression import MAX_AR_ORDER, IvFit, fit_model, safe
from armident.identify.diagnosis.study import Study
from armident.identify.effects.effect import SIGN_TOLERANCE
from armident.identify.effects.recording_corrections import of_recording
from armident.identify.effects.terms import Term, arm_model, effect_terms
from armident.identify.regression.ar_noise import ArModel
from armident.identify.robot.arm import ArmModel

ITERATIONS = 4
"""Most iterations between terms that scale predicted torques and the torques that the fit predicts."""
CONVERGED = 0.1
"""Change of their parameters, in standard deviations, that ends the iterations."""


@dataclass(frozen=True, eq=False)
class ModelState:
    """Model of one step of the selection: its fit to the data, with the motion of its closed loop."""

    fit: IvFit

    @property
    def study(self) -> Study:
        """Data with the model and the motion of its closed loop."""
        return self.fit.study

    def of_study(self, study: Study) -> "ModelState":
        """Return the model with another study of the same training stretches."""
        return ModelState(self.fit.of_study(study))

    @property
    def robot(self) -> RobotConfig:
        """Configuration of the model."""
        return self.study.robot

    @cached_property
    def score(self) -> PredictiveScore:
        """Predictive score on the training data."""
        return PredictiveScore(self.fit)

    def release(self) -> None:
        """Free the memory of the equations; predictive score, parameters and simulated motion stay."""
        self.score.keep_errors()
        self.fit.release()
        for other in self._under.values():
            other.release()

    @cached_property
    def weights(self) -> tuple[ArModel, ...]:
        """Noise models of the residual without smooth functions of the motion, one for each joint, for all candidates.

        Noise models of the residual itself would take missing effects for noise.
        """
        return tuple(noise_beyond_shapes(self.fit, ColumnCache(self.study, self.fit.theta)))

    @cached_property
    def own_noise(self) -> tuple[ArModel, ...]:
        """Noise models of the residual, one for each joint."""
        return self.fit.own_noise(MAX_AR_ORDER)

    def under(self, noise: tuple[ArModel, ...]) -> "ModelState":
        """The model fitted under given noise models, so that it can be compared with another one fitted under them."""
        if all(one is own for one, own in zip(noise, self.fit.noise, strict=True)):
            return self
        if noise not in self._under:
            self._under[noise] = ModelState(safe(self.fit.renoised(noise)))
        return self._under[noise]

    @cached_property
    def _under(self) -> dict[tuple[ArModel, ...], "ModelState"]:
        return {}

    @property
    def terms(self) -> tuple[Term, ...]:
        """Effects of the model."""
        return effect_terms(self.study.model)

    def values_of(self, term: Term) -> tuple[Array, Array]:
        """Linear parameters of a term and their standard deviations, (k,) each."""
        own = [self.study.model.base.names.index(name) for name in term.names]
        return self.fit.theta[own], np.sqrt(np.maximum(np.diag(self.fit.covariance)[own], 0.0))

    def term_of(self, entry: Entry) -> Term:
        """Term of a configuration entry that is no correction of the recordings."""
        return self.terms[[e for e in self.robot.effects if not of_recording(e)].index(entry)]

    def with_values(self) -> RobotConfig:
        """Configuration with the estimated values in its effect entries."""
        entries: list[Entry] = list(self.robot.effects)
        for k, entry in enumerate(entries):
            if of_recording(entry):
                continue
            term = self.term_of(entry)
            values, _ = self.values_of(term)
            linear = {p.name: float(value) for p, value in zip(term.linear, values, strict=True)}
            entries[k] = entry.model_copy(update={"parameters": {**term.shapes, **linear}})
        return self.robot.model_copy(update={"effects": tuple(entries)})


Fitter = Callable[[RobotConfig, ModelState], ModelState | None]
"""``(robot, before)`` to the fitted model of a configuration; ``None`` if the motion does not determine it."""


def fitted(study: Study, robot: RobotConfig, before: ModelState | None) -> ModelState:
    """Fit the model of a configuration in its own closed loop, with torques for terms and noise models of ``before``.

    ``None``: fit a rigid model first, and alternate between parameters and noise models.
    """
    changed = study.of_robot(robot)
    model = changed.model
    theta: Array | None = None
    if before is not None:
        first_motions = before.study.auxiliary.first_motions
        changed = replace(changed, auxiliary=replace(changed.auxiliary, first_motions=first_motions))
        theta = rigid_parameters(before.fit, model)
    elif any(term.depends_on_torque for term in effect_terms(model)):
        bare = robot.model_copy(update={"effects": ()})
        rigid = fit_model(replace(changed, robot=bare, model=arm_model(bare)))
        theta = np.concatenate([rigid.theta, np.zeros(model.e)])
    noise = None if before is None else before.weights
    first = fit_model(changed, theta, noise)
    moved = changed.resimulated(first.theta)
    if moved is not changed:
        first = fit_model(moved, first.theta if model.e else None, noise or first.noise)
    if any(term.scales_torque for term in effect_terms(model)):
        first = _iterated(first)
    return ModelState(first)


def fitted_in_loop_of(before: ModelState, robot: RobotConfig) -> ModelState | None:
    """Fit a model with the simulated motion of another one: quick, for small changes; ``None`` if undetermined."""
    study = before.study.of_robot(robot)
    try:
        return ModelState(fit_model(study, rigid_parameters(before.fit, study.model), before.weights))
    except (DataError, np.linalg.LinAlgError):
        return None


def with_entries(robot: RobotConfig, entries: Sequence[Entry]) -> RobotConfig:
    """Return a configuration with further effect entries. ``entries``: entries to add."""
    return robot.model_copy(update={"effects": (*robot.effects, *entries)})


def without_entry(robot: RobotConfig, entry: Entry) -> RobotConfig:
    """Return a configuration without one of its effect entries."""
    effects = list(robot.effects)
    effects.remove(entry)
    return robot.model_copy(update={"effects": tuple(effects)})


def with_own_noise(state: ModelState) -> ModelState:
    """Return a model fitted with the noise models of its own residual, in which no effect should be missing any more.

    It stays as it is if it predicts with smaller errors: mean of their logarithms, as joints differ in size.
    """
    own = ModelState(safe(state.fit.renoised(state.own_noise)))
    sizes = (float(np.log(np.maximum(one.score.rms, 1e-300)).sum()) for one in (own, state))
    return own if next(sizes) < next(sizes) else state


def with_first_motions(state: ModelState) -> ModelState:
    """Return a model from whose loop the simulations of its successors begin. ``state``: model of the selection."""
    return state.of_study(state.study.with_first_motions(state.fit.theta))


def with_references(state: ModelState) -> ModelState:
    """Return the base model with the rigid parameters that successors use at joints with much measurement noise."""
    return state.of_study(replace(state.study, references=references_of(state.fit)))


def with_report_part(state: ModelState) -> ModelState:
    """Return a model whose loop is simulated for the report part, too."""
    return state.of_study(state.study.with_report_part(state.fit.theta))


def friction_allowed(state: ModelState, term: Term) -> bool:
    """False if the friction of a term's joint that may not be negative is, by two standard deviations."""
    (name, factors), names = term.effect.positive_friction(term.shapes), state.study.model.base.names
    usual = f"{name}{term.place.joint + 1}"
    if usual not in names:
        return True
    direction = np.zeros(state.fit.theta.size)
    direction[[names.index(name) for name in term.names]] = factors[list(term.kept)]
    direction[names.index(usual)] = 1.0
    std = float(np.sqrt(direction @ state.fit.covariance @ direction))
    return bool(direction @ state.fit.theta >= -SIGN_TOLERANCE * std)


def acted_on(with_it: ModelState, without: ModelState) -> NDArray[np.bool_]:
    """Return the joints (n,) on whose torques the terms differ between two models; all if their corrections differ."""
    known = set(without.study.model.base.names)
    added = [k for k, name in enumerate(with_it.study.model.base.names) if name not in known]
    joints = with_it.fit.equations.joints
    if not added or with_it.study.recorded != without.study.recorded:
        return np.ones(len(joints), np.bool_)
    return np.array([bool(np.isin(added, joint.x).any()) for joint in joints])


def _iterated(found: IvFit) -> IvFit:
    """Fit whose terms scale the torques predicted by the model itself, by iteration.

    A drive that gives half its torque scales another torque than the model without it predicts.
    """
    terms = slice(found.study.model.base.b - found.study.model.e, None)
    for _ in range(ITERATIONS):
        before, std = found.theta[terms], np.sqrt(np.diag(found.covariance)[terms])
        found = fit_model(found.study, found.theta, found.noise)
        if np.all(np.abs(found.theta[terms] - before) <= CONVERGED * std):
            break
    return found


def rigid_parameters(before: IvFit, model: ArmModel) -> Array:
    """Rigid parameters of an earlier fit, zeros for the terms, (b,)."""
    rigid = before.theta[: before.study.model.base.b - before.study.model.e]
    return np.concatenate([rigid, np.zeros(model.e)])
