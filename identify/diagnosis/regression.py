"""Instrumental-variable regression of a diagnosis, whitened joint by joint (thesis 2.3.3 and 6.1.3)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from armident.configs import DataError
from armident.identify.diagnosis.stretch import Stretch
from armident.identify.diagnosis.study import Study
from armident.identify.diagnosis.whitening import ar_models, rows_of_joints, summed_backwards, whitened
from armident.identify.effects.terms import effect_terms
from armident.identify.regression.ar_noise import ArModel
from armident.identify.regression.equations import require_excitation
from armident.identify.regression.fir import filter_columns

Array = NDArray[np.float64]

MAX_AR_ORDER = 30
SINGULAR = 1e-13
"""Singular value of the normalised equations over the largest below which they are singular: rounding errors."""
MOST_WEIGHTED = 1.1
"""Largest ratio of the errors with weighted equations to those with white weights: efficient weights change an estimate
by less than its standard deviation, and the errors by a few percent."""
LOWER_ORDERS = (10, 3, 1)
"""Highest orders of noise models in turn, where those of higher order make the instruments weak."""
RIGID_KEPT = 32
"""Rigid regressors kept, one per stretch and kind of signal. Limits the memory, changes no result: measured signals of
up to eight recordings and the latest simulations stay."""
PASSES = 3
"""Iterations between parameters and noise models; a fourth changes neither visibly."""


@dataclass(frozen=True)
class Rows:
    """Whitened rows of all joints, one below the other.

    Parameters
    ----------
    x, z
        Regressor and instruments, (R, b).
    y
        Torques, (R,).
    """

    x: Array
    z: Array
    y: Array


Equation = tuple[Array, Array, Array]
"""Equations of one stretch: regressor at measured and at simulated signals (M, n, b) each, torques (M, n)."""


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations in the band of the comparison, computed when they are first used.

    Parameters
    ----------
    study
        Data with the model.
    theta
        Parameters (b,) that predict the torques on which terms depend; ``None`` if no term does.
    """

    study: Study
    theta: Array | None

    @cached_property
    def train(self) -> tuple[Equation, ...]:
        """Training equations, one entry per stretch."""
        return tuple((*regressors(self.study, s, self.theta), s.y) for s in self.study.train)

    @cached_property
    def held(self) -> tuple[Equation, ...]:
        """Held-out equations, one entry per stretch."""
        return tuple((*regressors(self.study, s, self.theta), s.y) for s in self.study.held)

    @cached_property
    def blocks(self) -> tuple["Block", ...]:
        """The training rows joint by joint, without the columns that are zero there."""
        return tuple(Block.of(self.train, j) for j in range(self.train[0][2].shape[1]))

    def with_held(self, study: Study) -> "Equations":
        """Equations of the same training part with another held-out part.

        Parameters
        ----------
        study
            Data with the same training stretches.
        """
        other = Equations(study, self.theta)
        other.__dict__.update({name: self.__dict__[name] for name in ("train", "blocks") if name in self.__dict__})
        return other

    def release(self) -> None:
        """Free the equations; they are computed again, with the same values, when they are next used."""
        _forget(self, "train", "held", "blocks")


@dataclass(frozen=True, eq=False)
class Block:
    """Rows of one joint without the columns that are zero there: a link acts on the joints before it only.

    Parameters
    ----------
    x, z
        Numbers of the columns of regressor and instruments that are not zero.
    parts
        ``[X, Z, y]`` of these columns, one array (M, x + z + 1) per stretch.
    """

    x: NDArray[np.int64]
    z: NDArray[np.int64]
    parts: tuple[Array, ...]

    @classmethod
    def of(cls, rows: Sequence[Equation], joint: int) -> "Block":
        """Rows of a joint from the equations of all joints.

        Parameters
        ----------
        rows
            Equations of every stretch.
        joint
            Number of the joint.
        """
        x, z = (
            np.flatnonzero(np.any([np.any(row[k][:, joint] != 0, axis=0) for row in rows], axis=0)) for k in range(2)
        )
        parts = tuple(np.column_stack([r[0][:, joint, x], r[1][:, joint, z], r[2][:, joint]]) for r in rows)
        return cls(x, z, parts)


def _white(block: Block, ar: ArModel) -> Array:
    """Rows of a block, whitened by the noise model of its joint."""
    taps = np.append(1.0, ar.coefficients) / np.sqrt(ar.variance)
    return np.concatenate([filter_columns(taps, part) for part in block.parts])


def _forget(owner: object, *names: str) -> None:
    """Remove cached properties of an object."""
    for name in names:
        owner.__dict__.pop(name, None)


@dataclass(frozen=True, eq=False)
class Products:
    """Whitened rows of all joints, and their products.

    Parameters
    ----------
    noise
        Noise models that whiten the rows.
    equations
        Equations of all stretches.
    parts
        ``Z' [X, Z, y]`` of every joint's block.
    zx, zz, zy
        ``Z'X`` and ``Z'Z`` (b, b), ``Z'y`` (b,).
    """

    noise: tuple[ArModel, ...]
    equations: Equations
    parts: tuple[Array, ...]
    zx: Array
    zz: Array
    zy: Array

    @classmethod
    def of(cls, equations: Equations, noise: Sequence[ArModel], known: "Products | None" = None) -> "Products":
        """Products of the training rows under given noise models.

        Parameters
        ----------
        equations
            Equations of all stretches.
        noise
            Noise model of each joint.
        known
            Products of the same equations; those of joints with the same noise model are reused.
        """
        b = equations.train[0][0].shape[2]
        zx, zz, zy = np.zeros((b, b)), np.zeros((b, b)), np.zeros(b)
        rows, parts = [], []
        for j, (block, ar) in enumerate(zip(equations.blocks, noise, strict=True)):
            if known is not None and known.noise[j] is ar:
                white, through = known.rows[j], known.parts[j]
            else:
                white = _white(block, ar)
                through = white[:, block.x.size : -1].T @ white
            zx[np.ix_(block.z, block.x)] += through[:, : block.x.size]
            zz[np.ix_(block.z, block.z)] += through[:, block.x.size : -1]
            zy[block.z] += through[:, -1]
            rows.append(white)
            parts.append(through)
        made = cls(tuple(noise), equations, tuple(parts), zx, zz, zy)
        made.__dict__["rows"] = tuple(rows)
        return made

    @cached_property
    def rows(self) -> tuple[Array, ...]:
        """``[X, Z, y]`` of every joint's block, whitened."""
        return tuple(_white(block, ar) for block, ar in zip(self.equations.blocks, self.noise, strict=True))

    @cached_property
    def scale(self) -> Array:
        """Norms of the instruments, 1 for those that are zero, (b,)."""
        scale = np.sqrt(np.diag(self.zz))
        return np.where(scale == 0, 1.0, scale)

    @cached_property
    def solver(self) -> Any:
        """Factors of ``Z'X``, scaled."""
        return linalg.lu_factor(self.zx / np.outer(self.scale, self.scale))


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters, noise models, and the whitened rows of both parts of the data.

    Parameters
    ----------
    study
        Data with the model.
    theta
        Parameters (b,), those of the terms at the end.
    noise
        AR model of each joint.
    equations
        Rows before whitening.
    products
        Products of the whitened training rows.
    fixed
        True if theta is given (a baseline) and therefore absorbs nothing of a candidate.
    """

    study: Study
    theta: Array
    noise: tuple[ArModel, ...]
    equations: Equations
    products: Products
    fixed: bool = False

    def release(self) -> None:
        """Free the equations and whitened rows; they are computed again, with the same values, when next used."""
        self.equations.release()
        _forget(self.products, "rows")
        self.products.equations.release()
        _forget(self, "left", "train", "held", "residual", "held_residual")

    def renoised(self, noise: Sequence[ArModel]) -> "Fit":
        """The fit with other noise models; a given theta stays."""
        return solved(self.study, self.equations, noise, self.theta if self.fixed else None, self.products)

    def errors(self, theta: Array, *, held: bool) -> list[Array]:
        """``y - X theta`` at measured signals in the band of the comparison, (M, n) of every stretch, N m or N.

        Parameters
        ----------
        theta
            Parameters, (b,).
        held
            True for the held-out data, false for the training data.
        """
        rows = self.equations.held if held else self.equations.train
        return [y - applied(x, theta) for x, _, y in rows]

    @cached_property
    def left(self) -> list[Array]:
        """Residual of the training rows, (M, n) of every stretch, N m or N."""
        return self.errors(self.theta, held=False)

    @cached_property
    def train(self) -> Rows:
        """Whitened training rows."""
        return self._rows(self.equations.train)

    @cached_property
    def held(self) -> Rows:
        """Whitened held-out rows."""
        return self._rows(self.equations.held)

    def _rows(self, rows: tuple[Equation, ...]) -> Rows:
        return Rows(*(whitened([row[k] for row in rows], self.noise) for k in range(3)))

    @cached_property
    def residual(self) -> Array:
        """Whitened residual of the training rows, (R,)."""
        return whitened(self.left, self.noise)

    @cached_property
    def held_residual(self) -> Array:
        """Whitened residual of the held-out rows, (R,)."""
        return whitened(self.errors(self.theta, held=True), self.noise)

    def held_at_simulated(self, theta: Array) -> Array:
        """``Z theta`` of the held-out rows, (R,)."""
        return whitened([applied(z, theta) for _, z, _ in self.equations.held], self.noise)

    def _through(self, columns: Array) -> tuple[Array, Array]:
        """``X' columns`` and ``Z' columns`` of the training rows, (b, k) each."""
        x, z = np.zeros((2, self.theta.size, columns.shape[1]))
        begin = 0
        for block, rows in zip(self.equations.blocks, self.products.rows, strict=True):
            own = columns[begin : begin + rows.shape[0]]
            begin += rows.shape[0]
            # Most candidates act on one joint.
            if own.any():
                through = rows[:, :-1].T @ own
                x[block.x] += through[: block.x.size]
                z[block.z] += through[block.x.size :]
        return x, z

    def absorbed(self, columns: Array) -> Array:
        """Parameters (b, k) that the model would give to torques ``columns`` (R, k): ``(Z'X)^-1 Z' columns``."""
        if self.fixed:
            return np.zeros((self.theta.size, columns.shape[1]))
        scale = self.products.scale[:, None]
        found: Array = linalg.lu_solve(self.products.solver, self._through(columns)[1] / scale) / scale
        return found

    def _inside(self, x: Array) -> Array:
        """``(X'Z)^-1 x`` (b, k)."""
        scale = self.products.scale[:, None]
        inside: Array = linalg.lu_solve(self.products.solver, x / scale, trans=1) / scale
        return inside

    def beside(self, instruments: Array) -> Array:
        """Instruments (R, k) orthogonal to those of the model: ``D - Z (X'Z)^-1 X'D``."""
        if self.fixed:
            return instruments
        inside = self._inside(self._through(instruments)[0])
        rest = instruments.copy()
        begin = 0
        for block, rows in zip(self.equations.blocks, self.products.rows, strict=True):
            rest[begin : begin + rows.shape[0]] -= rows[:, block.x.size : -1] @ inside[block.z]
            begin += rows.shape[0]
        return rest

    def products_beside(self, columns: Sequence[tuple[int, Array]], count: int) -> tuple[Array, Array]:
        """``B'B`` (G, k, k) and ``B' residual`` (G, k) of ``B = beside(instruments)``, without computing B.

        Parameters
        ----------
        columns
            Instruments (R, G k) of each joint on which they act, with its number, group after group.
        count
            Number of groups, G.
        """
        width = columns[0][1].shape[1]
        x, z = np.zeros((2, self.theta.size, width))
        gram, score = np.zeros((count, width // count, width // count)), np.zeros(width)
        for joint, own in columns:
            block, rows = self.equations.blocks[joint], self.products.rows[joint]
            score += own.T @ self.residual[self.rows_of[joint]]
            groups = own.reshape(own.shape[0], count, -1).transpose(1, 0, 2)
            gram += groups.transpose(0, 2, 1) @ groups
            if not self.fixed:
                through = rows[:, :-1].T @ own
                x[block.x] += through[: block.x.size]
                z[block.z] += through[block.x.size :]
        if self.fixed:
            return gram, score.reshape(count, -1)
        inside = self._inside(x)

        def products(right: Array) -> Array:
            grouped = (part.reshape(self.theta.size, count, -1).transpose(1, 0, 2) for part in (inside, right))
            left, other = grouped
            return left.transpose(0, 2, 1) @ other

        # The residual is orthogonal to the model's own instruments.
        both = products(z)
        return gram - both - both.transpose(0, 2, 1) + products(self.products.zz @ inside), score.reshape(count, -1)

    @cached_property
    def rows_of(self) -> list[slice]:
        """Whitened training rows of each joint."""
        return rows_of_joints([y.shape[0] for _, _, y in self.equations.train], self.noise)

    @cached_property
    def covariance(self) -> Array:
        """``(Z'X)^-1 Z'Z (X'Z)^-1`` (4.34), (b, b)."""
        scale = np.outer(self.products.scale, self.products.scale)
        half = linalg.lu_solve(self.products.solver, self.products.zz / scale)
        covariance: Array = linalg.lu_solve(self.products.solver, half.T) / scale
        return covariance

    def spread(self, direction: Array) -> float:
        """Variance of ``direction' X_held theta`` from the uncertainty of theta, ``direction`` (R,)."""
        if self.fixed:
            return 0.0
        parts = summed_backwards(direction, self.noise, [y.shape[0] for _, _, y in self.equations.held])
        through = np.zeros(self.theta.size)
        for (x, _, _), weight in zip(self.equations.held, parts, strict=True):
            through += weight.reshape(-1) @ x.reshape(-1, x.shape[2])
        return float(through @ self.covariance @ through)


def fit(study: Study, theta0: Array | None = None, noise: Sequence[ArModel] | None = None) -> Fit:
    """Alternate instrumental variables and AR noise models (thesis sections 2.3.3 and 6.1.3).

    Parameters
    ----------
    study
        Data with the model.
    theta0
        Parameters (b,) that predict the torques on which terms depend; ``None`` if no term does.
    noise
        Noise models; ``None``: start with white noise, and alternate.

    Raises
    ------
    DataError
        If the training motion leaves parameters undetermined.
    """
    equations = Equations(study, theta0)
    if noise is None:
        flat = np.concatenate([x.reshape(-1, x.shape[-1]) for x, _, _ in equations.train])
        require_excitation(flat, study.model.base.names)
        theta = np.linalg.lstsq(flat, np.concatenate([y.reshape(-1) for _, _, y in equations.train]), rcond=None)[0]
        noise = noise_models([y - x @ theta for x, _, y in equations.train], theta.size, 0)
        passes = PASSES
    else:
        passes = 1
    found = solved(study, equations, noise)
    require_solution(found)
    for _ in range(passes - 1):
        found = found.renoised(noise_models(found.errors(found.theta, held=False), found.theta.size, MAX_AR_ORDER))
    return safe(found)


def safe(found: Fit) -> Fit:
    """Return the fit, or one with noise models of lower order if its errors are much larger than with white weights.

    Weights of a strongly coloured noise emphasise frequencies at which the simulated and the measured motion may have
    little in common. The instruments are weak there, and the estimate is far from any that fits the data.

    Parameters
    ----------
    found
        The fit.
    """
    white = found.renoised([ArModel(np.empty(0), ar.variance, 0.0) for ar in found.noise])
    most = MOST_WEIGHTED * _rms(white)
    for order in (*LOWER_ORDERS, 0):
        if np.all(_rms(found) <= most):
            break
        found = found.renoised(noise_models(white.left, white.theta.size, order))
    return found


def _rms(found: Fit) -> Array:
    """Root mean square of the residual of each joint, N m or N, (n,)."""
    return np.asarray(np.sqrt(np.mean(np.concatenate(found.left) ** 2, axis=0)))


def require_solution(found: Fit) -> None:
    """Refuse a model whose parameters the motion leaves undetermined.

    Parameters
    ----------
    found
        Fit of the model.

    Raises
    ------
    DataError
        If the instruments do not determine all parameters.
    """
    products = found.products
    values = np.linalg.svd(products.zx / np.outer(products.scale, products.scale), compute_uv=False)
    if not np.isfinite(found.theta).all() or values[-1] < SINGULAR * values[0]:
        raise DataError("the motion does not determine all parameters of the model")


def solved(
    study: Study,
    equations: Equations,
    noise: Sequence[ArModel],
    theta: Array | None = None,
    known: Products | None = None,
) -> Fit:
    """Parameters by instrumental variables under given noise models; a given ``theta`` is kept as it is.

    Parameters
    ----------
    study
        Data with the model.
    equations
        Equations of all stretches.
    noise
        Noise model of each joint.
    theta
        Given parameters (b,); ``None``: estimate them.
    known
        Products of the same equations under other noise models.

    Raises
    ------
    DataError
        If a parameter has no effect on the torques.
    """
    products = Products.of(equations, noise, known)
    if not np.any(products.zx, axis=0).all():
        raise DataError("the motion does not determine all parameters of the model")
    if theta is not None:
        return Fit(study, theta, tuple(noise), equations, products, fixed=True)
    estimate = linalg.lu_solve(products.solver, products.zy / products.scale) / products.scale
    return Fit(study, estimate, tuple(noise), equations, products)


def relative_errors(fit: Fit, theta: Array | None = None, *, held: bool) -> tuple[float, Array]:
    """``|y - X theta| / |y|`` in percent in the band of the comparison, overall and of each joint (n,).

    Parameters
    ----------
    fit
        Fit with data and model.
    theta
        Parameters (b,); ``None``: those of the fit.
    held
        True for the held-out data, false for the training data.
    """
    y = np.concatenate([s.y for s in (fit.study.held if held else fit.study.train)])
    error = np.concatenate(fit.errors(fit.theta if theta is None else theta, held=held))
    each = np.linalg.norm(error, axis=0) / np.maximum(np.linalg.norm(y, axis=0), 1e-300)
    return 100 * float(np.linalg.norm(error) / np.linalg.norm(y)), 100 * each


def regressors(study: Study, stretch: Stretch, theta: Array | None) -> tuple[Array, Array]:
    """Regressor (M, n, b) at measured and at simulated signals, in the band of the comparison.

    Effects that depend on accelerations or torques are computed at simulated signals in both. Effects with jumps, which
    a simulation does not reproduce to the sample, are computed at measured signals in both.

    Parameters
    ----------
    study
        Data with the model.
    stretch
        A stretch of the study.
    theta
        Parameters (b,) that predict the torques on which terms depend; ``None`` if no term does.
    """
    out: list[Array] = []
    terms: dict[str, Array] = {}
    for kind in ("measured", "simulated"):
        signals = getattr(stretch, kind)
        key = (id(signals), study.model.base.names[: -study.model.e or None], tuple(study.robot.sign_smoothing))
        # Kept with the signals: their identity is the key only while they exist.
        kept = study.rigid.pop(key, None) or (
            signals,
            study.decimation(study.model.rigid_regressor(signals.q, signals.qd, signals.qdd)),
        )
        study.rigid[key] = kept
        while len(study.rigid) > RIGID_KEPT:
            # The one that was not used for the longest time: a simulation of a model that was rejected.
            del study.rigid[next(iter(study.rigid))]
        rigid = kept[1]
        if study.model.e:
            terms[kind] = _filtered_terms(study, stretch, kind, theta)
            made = terms[kind]
            if out:
                every = [t.effect for t in effect_terms(study.model) for _ in t.names]
                sudden = np.flatnonzero([e.instrument_signals == "measured" for e in every])
                made[:, :, sudden] = terms["measured"][:, :, sudden]
                # Measured signals differentiated twice carry more noise than such an effect has torque.
                dynamic = np.flatnonzero([e.regressor_signals == "simulated" for e in every])
                first = out[0].shape[2] - study.model.e
                moving = stretch.moving[:, :, None]
                out[0][:, :, first + dynamic] = made[:, :, dynamic] * moving
            rigid = np.concatenate([rigid, made], axis=2)
        out.append(rigid * stretch.moving[:, :, None])
    return out[0], out[1]


def _filtered_terms(study: Study, stretch: Stretch, kind: str, theta: Array | None) -> Array:
    """Columns (M, n, e) of the model's terms in the band of the comparison; those of one joint are filtered alone."""
    columns = study.terms(stretch, kind, theta)
    acts = np.flatnonzero(np.any(columns, axis=0))
    flat = columns.reshape(columns.shape[0], -1)[:, acts]
    band = study.decimation(np.ascontiguousarray(flat))
    whole = np.zeros((band.shape[0], columns.shape[1] * columns.shape[2]))
    whole[:, acts] = band
    return whole.reshape(band.shape[0], *columns.shape[1:])


def applied(columns: Array, values: Array) -> Array:
    """``columns @ values``, shape (M, n), as one product.

    Parameters
    ----------
    columns
        Shape (M, n, k).
    values
        Shape (k,).
    """
    product: Array = (columns.reshape(-1, columns.shape[2]) @ values).reshape(columns.shape[:2])
    return product


def noise_models(errors: Sequence[Array], parameters: float, order: int) -> list[ArModel]:
    """AR model of each joint's residual (6.21 to 6.25), its variance corrected for the parameters estimated.

    Parameters
    ----------
    errors
        Residuals, (M, n) per stretch.
    parameters
        Number of estimated parameters.
    order
        Highest order tried.
    """
    free = 1 - parameters / sum(e.size for e in errors)
    return [ArModel(ar.coefficients, ar.variance / free, ar.aic) for ar in ar_models(errors, order)]
