"""Khalil's rules: which standard parameters are eliminated or regrouped, in symbols (thesis section A.3).

A parameter is a linear form in the standard ones with polynomials in the lengths ``d_j``, ``r_j`` as coefficients. From
tip to base, parameters of link j without a separate effect on the torques are regrouped with those of link j-1. Rule 3
is printed with ``zz`` of link j, which rule 2 regroups; here it adds to link j-1 directly. Rule 7, on rotor inertias of
prismatic joints, is used in its general form: earlier revolute joints are parallel to the joint, earlier prismatic ones
orthogonal. Gravity then adds a constant to ``off``.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.robot.chain import INERTIAL, Chain, cos_sin

Monomial = tuple[tuple[str, int], ...]
Polynomial = dict[Monomial, float]
Form = dict[str, Polynomial]

PARALLEL = 1e-9
"""Sine (cosine) of the angle between two axes below which they count as parallel (orthogonal)."""


def khalil_rules(robot: RobotConfig, chain: Chain, names: tuple[str, ...]) -> dict[str, Form]:
    """Derive the base parameters as linear forms by Khalil's rules (thesis section A.3), in the order of ``names``."""
    forms: dict[str, Form] = {name: {name: {(): 1.0}} for name in names}
    axes, origins = _axes(chain)
    n = chain.d.size
    prismatic = [bool(p) for p in chain.prismatic]
    r1 = next((j for j in range(n) if not prismatic[j]), n)
    r2 = next((j for j in range(r1 + 1, n) if not prismatic[j] and not _parallel(axes[j], axes[r1])), n)
    for j in range(n - 1, -1, -1):
        link = j + 1
        parent = _transfer(chain, j)
        own = {kind: f"{kind}{link}" for kind in INERTIAL}
        turning = r1 <= j < r2
        if prismatic[j]:
            if turning and _parallel(axes[j], axes[r1]):
                forms.pop(own["mz"])
                for kind in ("mx", "my"):
                    _regroup(forms, own[kind], j, parent[kind], still=True)
            elif turning:
                _direction_unseen(forms, own, _in_link_frame(chain, j, axes[r1], axes))
            elif j < r1:
                for kind in ("mx", "my", "mz"):
                    forms.pop(own[kind])
            if f"ia{link}" in forms and _alone_along_axis(prismatic, axes, j):
                _rotor_into_mass(forms, robot, chain, j, axes[j], parent["m"])
            for kind in ("xx", "xy", "xz", "yy", "yz", "zz"):
                _regroup(forms, own[kind], j, parent[kind])
        else:
            if f"ia{link}" in forms and (j == r1 or (j == r2 and _orthogonal(axes[j], axes[r1]))):
                _add(forms[own["zz"]], forms.pop(f"ia{link}"), {(): 1.0})
            _add(forms[own["xx"]], forms[own["yy"]], {(): -1.0})
            # The rotation about z_j mixes xx and yy; their sum is constant and is regrouped with the parent.
            for kind in ("yy", "mz", "m"):
                _regroup(forms, own[kind], j, parent[kind])
            if turning:
                for kind in ("xx", "xy", "xz", "yz"):
                    forms.pop(own[kind])
                if _still_axis(chain, axes, origins, r1, j):
                    forms.pop(own["mx"])
                    forms.pop(own["my"])
    order = {name: k for k, name in enumerate(names)}
    return {name: forms[name] for name in sorted(forms, key=order.__getitem__)}


def coefficients_at(form: Form, lengths: Mapping[str, float], names: tuple[str, ...]) -> Array:
    """Coefficients (p,) of a linear form at given lengths, m, from `lengths_of`."""
    row = np.zeros(len(names))
    for k, name in enumerate(names):
        for monomial, coefficient in form.get(name, {}).items():
            row[k] += coefficient * np.prod([lengths[symbol] ** power for symbol, power in monomial])
    return row


def lengths_of(chain: Chain) -> dict[str, float]:
    """Values of the symbols ``d1, r1, d2, ...`` of a chain, m."""
    return {f"{kind}{j + 1}": float(value) for kind in ("d", "r") for j, value in enumerate(getattr(chain, kind))}


def text_of(name: str, form: Form, names: tuple[str, ...]) -> str:
    """Text of a linear form as in thesis table B.3, ``name`` first; equal coefficients share a bracket."""
    groups: dict[str, list[str]] = {}
    polynomials: dict[str, Polynomial] = {}
    for parameter in (name, *(other for other in names if other in form and other != name)):
        polynomial = {m: c for m, c in form[parameter].items() if abs(c) > 1e-12}
        if polynomial:
            key = repr(sorted(polynomial.items()))
            groups.setdefault(key, []).append(parameter)
            polynomials[key] = polynomial
    text = ""
    for key, parameters in groups.items():
        sign, factor = _polynomial_text(polynomials[key])
        body = "+".join(parameters) if len(parameters) > 1 else parameters[0]
        if factor:
            body = f"{factor}*({body})" if len(parameters) > 1 else f"{factor}*{body}"
        elif len(parameters) > 1:
            body = f" {sign} ".join(parameters)
        text += f" {sign} {body}" if text else (f"-{body}" if sign == "-" else body)
    return text


def _polynomial_text(polynomial: Polynomial) -> tuple[str, str]:
    """Sign and absolute value of a polynomial as text; the value is empty for 1."""
    terms = sorted(polynomial.items())
    sign = "-" if all(c < 0 for _, c in terms) else "+"
    parts = []
    for monomial, coefficient in terms:
        value = -coefficient if sign == "-" else coefficient
        symbols = [symbol if power == 1 else f"{symbol}^{power}" for symbol, power in monomial]
        if abs(abs(value) - 1.0) > 1e-12 or not symbols:
            symbols.insert(0, f"{abs(value):.12g}")
        parts.append(("-" if value < 0 else "+", "*".join(symbols)))
    if len(parts) == 1 and parts[0] == ("+", "1"):
        return sign, ""
    text = "".join(f" {s} {p}" for s, p in parts).strip()
    text = text.removeprefix("+ ") if text.startswith("+") else "-" + text.removeprefix("- ")
    return sign, f"({text})" if len(parts) > 1 else text


def _add(target: Form, source: Form, factor: Polynomial) -> None:
    for name, polynomial in source.items():
        into = target.setdefault(name, {})
        for left, a in polynomial.items():
            for right, b in factor.items():
                powers: dict[str, int] = {}
                for symbol, power in (*left, *right):
                    powers[symbol] = powers.get(symbol, 0) + power
                monomial = tuple(sorted(powers.items()))
                into[monomial] = into.get(monomial, 0.0) + a * b


def _regroup(forms: dict[str, Form], name: str, j: int, rows: Mapping[str, Polynomial], still: bool = False) -> None:
    """Regroup parameter ``name`` of link j+1 with those of its parent link; drop it if the parent is the base.

    ``still`` omits terms in the length ``r`` of joint j+1: displacements along the only axis of rotation.
    """
    form = forms.pop(name)
    own_length = f"r{j + 1}"
    for kind, polynomial in rows.items():
        target = forms.get(f"{kind}{j}")
        if still:
            polynomial = {m: c for m, c in polynomial.items() if all(s != own_length for s, _ in m)}
        if target is not None and polynomial:
            _add(target, form, polynomial)


def _transfer(chain: Chain, j: int) -> dict[str, dict[str, Polynomial]]:
    """Contribution of each parameter of link j+1 to the parameters of its parent link.

    At a revolute joint ``xx + yy`` (entry ``yy``), ``mz`` and ``m`` do not depend on the joint angle.
    """
    ca, sa = float(chain.cos_alpha[j]), float(chain.sin_alpha[j])
    c, s = cos_sin(float(chain.theta[j])) if chain.prismatic[j] else (1.0, 0.0)
    rotation = np.array([[c, -s, 0.0], [s * ca, c * ca, -sa], [s * sa, c * sa, ca]])
    directions = {f"d{j + 1}": np.array([1.0, 0.0, 0.0]), f"r{j + 1}": np.array([0.0, -sa, ca])}
    if chain.d[j] == 0.0:
        directions.pop(f"d{j + 1}")
    if chain.r[j] == 0.0 and not chain.prismatic[j]:
        directions.pop(f"r{j + 1}")
    rows: dict[str, dict[str, Polynomial]] = {}
    unit = np.eye(10)
    for k, kind in enumerate(INERTIAL):
        p = unit[k]
        if kind == "yy" and not chain.prismatic[j]:
            p = unit[0] + unit[3]
        inertia = np.array([[p[0], p[1], p[2]], [p[1], p[3], p[4]], [p[2], p[4], p[5]]])
        if kind == "yy" and not chain.prismatic[j]:
            # Part that does not depend on the joint angle: xx and yy are both yy, half the trace in the plane.
            inertia = np.diag([1.0, 1.0, 0.0])
        first, mass = rotation @ p[6:9], p[9]
        terms: dict[Monomial, Array] = {(): _pack(rotation @ inertia @ rotation.T, first, mass)}
        for symbol, u in directions.items():
            terms[((symbol, 1),)] = _pack(_shift(u, first), mass * u, 0.0)
            for other, v in directions.items():
                monomial = ((symbol, 2),) if symbol == other else tuple(sorted(((symbol, 1), (other, 1))))
                terms[monomial] = terms.get(monomial, np.zeros(10)) + _pack(mass * _shift(u, v) / 2, np.zeros(3), 0.0)
        rows[kind] = {
            target: {m: float(v[i]) for m, v in terms.items() if abs(v[i]) > 1e-14} for i, target in enumerate(INERTIAL)
        }
    return rows


def _shift(u: Array, v: Array) -> Array:
    """``2 (u.v) I - u v' - v u'``: change of the inertia matrix when a first moment ``v`` is displaced by ``u``."""
    result: Array = 2.0 * float(u @ v) * np.eye(3) - np.outer(u, v) - np.outer(v, u)
    return result


def _pack(inertia: Array, first: Array, mass: float) -> Array:
    return np.array([*inertia[0], inertia[1, 1], inertia[1, 2], inertia[2, 2], *first, mass])


def _axes(chain: Chain) -> tuple[list[Array], list[Array]]:
    """Unit vectors of the joint axes and a point on each axis, in the base frame at the zero posture."""
    rotation, position = np.eye(3), np.zeros(3)
    axes, origins = [], []
    for j in range(chain.d.size):
        ca, sa = chain.cos_alpha[j], chain.sin_alpha[j]
        c, s = np.cos(chain.theta[j]), np.sin(chain.theta[j])
        position = position + rotation @ np.array([chain.d[j], -chain.r[j] * sa, chain.r[j] * ca])
        rotation = rotation @ np.array([[c, -s, 0.0], [s * ca, c * ca, -sa], [s * sa, c * sa, ca]])
        axes.append(rotation[:, 2].copy())
        origins.append(position.copy())
    return axes, origins


def _in_link_frame(chain: Chain, j: int, direction: Array, axes: list[Array]) -> Array:
    """Transform a direction (3,) from the base frame to the frame of link j+1, at the zero posture."""
    rotation = np.eye(3)
    for k in range(j + 1):
        ca, sa = chain.cos_alpha[k], chain.sin_alpha[k]
        c, s = np.cos(chain.theta[k]), np.sin(chain.theta[k])
        rotation = rotation @ np.array([[c, -s, 0.0], [s * ca, c * ca, -sa], [s * sa, c * sa, ca]])
    result: Array = rotation.T @ direction
    return result


def _direction_unseen(forms: dict[str, Form], own: Mapping[str, str], axis: Array) -> None:
    """Regroup the first moment along the only axis of rotation, which has no effect on the torques (rule 4)."""
    x, y, z = (float(v) for v in axis)
    if abs(z) > PARALLEL:
        gone = forms.pop(own["mz"])
        targets: Iterable[tuple[str, float]] = (("mx", -x / z), ("my", -y / z))
    elif abs(y) > PARALLEL:
        gone = forms.pop(own["my"])
        targets = (("mx", -x / y),)
    else:
        gone = forms.pop(own["mx"])
        targets = ()
    for kind, factor in targets:
        if abs(factor) > PARALLEL:
            _add(forms[own[kind]], gone, {(): factor})


def _alone_along_axis(prismatic: list[bool], axes: list[Array], j: int) -> bool:
    """Return True if no joint before joint j moves its link along the axis of joint j."""
    return all(_orthogonal(axes[i], axes[j]) if prismatic[i] else _parallel(axes[i], axes[j]) for i in range(j))


def _rotor_into_mass(
    forms: dict[str, Form], robot: RobotConfig, chain: Chain, j: int, axis: Array, rows: Mapping[str, Polynomial]
) -> None:
    """Regroup the rotor inertia ``ia`` of a prismatic joint with the mass that it moves (rule 7)."""
    gone = forms.pop(f"ia{j + 1}")
    _add(forms[f"m{j + 1}"], gone, {(): 1.0})
    weight = float(np.asarray(robot.gravity) @ axis)
    if abs(weight) > PARALLEL:
        _add(forms[f"off{j + 1}"], gone, {(): weight})
    own_length = f"r{j + 1}"
    for kind, polynomial in rows.items():
        target = forms.get(f"{kind}{j}")
        kept = {m: -c for m, c in polynomial.items() if all(s != own_length for s, _ in m)}
        if target is not None and kept:
            _add(target, gone, kept)


def _still_axis(chain: Chain, axes: list[Array], origins: list[Array], r1: int, j: int) -> bool:
    """Return True if joint j rotates about the axis of joint ``r1``, parallel to gravity and to all earlier axes."""
    along = _parallel(axes[j], axes[r1]) and np.linalg.norm(np.cross(origins[j] - origins[r1], axes[r1])) < PARALLEL
    up = np.linalg.norm(np.cross(chain.gravity, axes[r1])) < PARALLEL
    return bool(along and up and all(_parallel(axes[i], axes[r1]) for i in range(j)))


def _parallel(a: Array, b: Array) -> bool:
    return bool(np.linalg.norm(np.cross(a, b)) < PARALLEL)


def _orthogonal(a: Array, b: Array) -> bool:
    return bool(abs(a @ b) < PARALLEL)
