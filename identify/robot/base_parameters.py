"""Base parameters: the minimum set that the inverse dynamic model needs (thesis section A.3).

Khalil's rules find them in symbols and give the formulas; the QR decomposition of a random regressor decides.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from armident.arrays import Array, Ints
from armident.configs import RobotConfig
from armident.identify.robot.chain import Chain, Columns
from armident.identify.robot.kernels import fill_regressor
from armident.identify.robot.khalil import Form, coefficients_at, khalil_rules, lengths_of, text_of

KEEP_FIRST = ("xx", "xy", "xz", "yz", "zz", "mx", "my", "m*", "fv", "fc", "off", "ia", "yy", "mz", "m")
"""Priority of columns within a link, first kept first (tables B.2 and B.3); ``m*`` is the mass at a prismatic joint."""

RANK_TOLERANCE = 1e-9
"""Relative norm of a column's part orthogonal to those kept, below which it is dependent; rounding errors are far
smaller, physical effects far larger."""


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Identifiable combinations of the standard parameters, ``theta_base = regroup @ theta_standard``.

    ``names``: with an ``r`` where others were regrouped into them (table B.3). ``independent`` (b,): increasing
    standard columns. ``regroup``: (b, p). ``formulas``: with lengths as symbols ``d3, r4``. ``eliminated``: without
    effect; ``regrouped``: act only through other base parameters.
    """

    names: tuple[str, ...]
    independent: Ints
    regroup: Array
    formulas: dict[str, str]
    eliminated: tuple[str, ...]
    regrouped: tuple[str, ...]

    @property
    def b(self) -> int:
        """Number of base parameters."""
        return len(self.names)

    def without(self, last: int) -> "BaseParameters":
        """Return the base parameters without the ``last`` ones, which terms of the model have added."""
        b, p = self.b - last, self.regroup.shape[1] - last
        return replace(
            self,
            names=self.names[:b],
            independent=self.independent[:b],
            regroup=self.regroup[:b, :p],
            formulas={name: self.formulas[name] for name in self.names[:b]},
        )


def with_terms(base: BaseParameters, names: tuple[str, ...]) -> BaseParameters:
    """Append the parameters of model terms, which are never regrouped with others."""
    if not names:
        return base
    b, p = base.regroup.shape
    e = len(names)
    regroup = np.zeros((b + e, p + e))
    regroup[:b, :p] = base.regroup
    regroup[b:, p:] = np.eye(e)
    return replace(
        base,
        names=base.names + names,
        independent=np.concatenate([base.independent, np.arange(p, p + e)]),
        regroup=regroup,
        formulas=base.formulas | {name: name for name in names},
    )


def base_parameters(robot: RobotConfig, chain: Chain, columns: Columns, names: tuple[str, ...]) -> BaseParameters:
    """Find the base parameters by Khalil's rules and the dependences of a random regressor that they miss (A.3)."""
    forms = khalil_rules(robot, chain, names)
    lengths = lengths_of(chain)
    where = {name: k for k, name in enumerate(names)}
    candidates = np.array([where[name] for name in forms], dtype=np.int64)
    rules = np.array([coefficients_at(form, lengths, names) for form in forms.values()]).reshape(-1, len(names))
    kept, mixing = independent_columns(robot, chain, columns, names, candidates)
    formulas: dict[str, str] = {}
    final = []
    regroup = mixing @ rules
    for row, k in enumerate(kept):
        name = names[k]
        form = _mixed(forms, mixing[row], candidates, names)
        grouped = np.count_nonzero(np.abs(regroup[row]) > RANK_TOLERANCE) > 1
        final.append(f"{name}r" if grouped else name)
        formulas[final[-1]] = text_of(name, form, names)
    acts = np.any(np.abs(regroup) > RANK_TOLERANCE, axis=0)
    stays = set(kept.tolist())
    return BaseParameters(
        names=tuple(final),
        independent=kept,
        regroup=regroup,
        formulas=formulas,
        eliminated=tuple(name for k, name in enumerate(names) if not acts[k]),
        regrouped=tuple(name for k, name in enumerate(names) if acts[k] and k not in stays),
    )


def independent_columns(
    robot: RobotConfig,
    chain: Chain,
    columns: Columns,
    names: tuple[str, ...],
    candidates: Ints | None = None,
    seed: int = 0,
) -> tuple[Ints, Array]:
    """Independent columns of a random regressor, and the dependence of the others on them (A.30 to A.35).

    QR decomposition from base to tip, within a link in the order `KEEP_FIRST`, finds the set of tables B.2 and B.3.
    Returns ``kept`` (b,), increasing, and ``mixing`` with ``theta_base = mixing @ theta[candidates]``.
    """
    if candidates is None:
        candidates = np.arange(len(names), dtype=np.int64)
    n, p = chain.d.size, len(names)
    rng = np.random.default_rng(seed)
    samples = 20 + 3 * p // n
    q, qd, qdd = (rng.uniform(-scale, scale, (samples, n)) for scale in (np.pi, 2.0, 4.0))
    regressor = np.zeros((samples, n, p))
    fill_regressor(chain, columns, np.zeros(robot.n), q, qd, qdd, regressor)
    x = regressor.reshape(samples * n, p)[:, candidates]
    scale = np.linalg.norm(x, axis=0)
    alive = scale > RANK_TOLERANCE * scale.max()
    order = [k for k in _preference(robot, names, candidates) if alive[k]]
    scaled = x[:, order] / scale[order]
    # A dependent column must not enter the factor: normalised, its rounding errors would become a basis vector.
    chosen: list[int] = []
    q1 = np.zeros((x.shape[0], len(order)))
    for position, column in enumerate(order):
        basis, rest = q1[:, : len(chosen)], scaled[:, position]
        # Two passes of Gram-Schmidt give orthogonality to rounding (Kahan and Parlett).
        for _ in range(2):
            rest = rest - basis @ (basis.T @ rest)
        norm = np.linalg.norm(rest)
        if norm > RANK_TOLERANCE:
            q1[:, len(chosen)] = rest / norm
            chosen.append(column)
    r = q1[:, : len(chosen)].T @ x
    mixing = solve_triangular(r[:, chosen], r)
    mixing[np.abs(mixing) < RANK_TOLERANCE] = 0.0
    mixing[:, chosen] = np.eye(len(chosen))
    by_column = np.argsort(candidates[chosen])
    chosen, mixing = [chosen[k] for k in by_column], mixing[by_column]
    return candidates[chosen], mixing


def _preference(robot: RobotConfig, names: tuple[str, ...], candidates: Ints) -> list[int]:
    """Positions in ``candidates`` in the order of the decomposition: base to tip, `KEEP_FIRST`, couplings last."""
    rank = {kind: k for k, kind in enumerate(KEEP_FIRST)}
    place: dict[str, tuple[int, int]] = {}
    for link, joint in enumerate(robot.joints, start=1):
        for kind in KEEP_FIRST:
            key = "m*" if kind == "m" and joint.type == "prismatic" else kind
            place[f"{kind}{link}"] = (link, rank[key])
    last = (robot.n + 1, 0)
    return sorted(range(len(candidates)), key=lambda k: (*place.get(names[candidates[k]], last), k))


def _mixed(forms: dict[str, Form], row: Array, candidates: Ints, names: tuple[str, ...]) -> Form:
    """Sum of the linear forms of the candidates, weighted by ``row``, shape (len(candidates),)."""
    mixed: Form = {}
    for weight, k in zip(row, candidates, strict=True):
        if weight:
            for name, polynomial in forms[names[k]].items():
                into = mixed.setdefault(name, {})
                for monomial, coefficient in polynomial.items():
                    into[monomial] = into.get(monomial, 0.0) + float(weight) * coefficient
    return mixed
