"""Stretches of time in which the arm is another one: its rigid model there differs from that of the other rows.

One contiguous stretch, which may reach to the end, gets parameters of its own. Both models are judged by rows that
neither has seen, so that more parameters are no advantage by themselves.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array, Mask
from armident.identify.setup.bench import Bench
from armident.identify.setup.fit import Hypothesis, equations
from armident.identify.setup.result import SetupFinding, Span

BLOCKS = 30
"""Blocks of time between which a stretch begins and ends; its ends are then found to a row."""

LEAST_BLOCKS = 2
"""Shortest stretch, and shortest rest of the recording."""

LEAST_ROWS = 20
"""Least number of rows of a stretch, and of the others."""

HALF_GAIN = 2.0
"""Gain below which the ends of a stretch are not looked for: it is no change."""

PARTS = 4
"""Parts of the cross-validation; each consists of several blocks of time."""

RIDGE = 1e-6
"""Ridge of the column-normalised normal equations of all rows: what the motion does not determine stays small."""

RIDGE_OF_CHANGE = 1e-4
"""The same for the deviation of a stretch: what it does not determine stays as in the other rows."""

FLOOR = 1e-6
"""Least share of a joint's torque power that counts as residual."""

PASSES = 3
"""Iterations between parameters and the weights of the joints."""


LEAST_GAIN = 10.0
"""Least factor by which a change lowers the held-out residual power of a joint, its amplitude to a third. It was chosen
on random and measured arms that stay the same: its false alarms on other arms have not been measured."""

LEAST_ERROR = 0.03
"""Least held-out residual of one model over the torque of that joint: below it a change does not matter."""

LEAST_OVER_DRIFT = 2.0
"""Least residual power of parameters that change evenly in time over that of a sudden change."""

RIGHT = 0.99
"""Share of right findings: 174 of 175 on development arms (``tests.evaluation.setup_calibration``)."""

BODY = ("xx", "xy", "xz", "yy", "yz", "zz", "mx", "my", "mz", "m")
"""Parameters of a body, without the number of its joint."""

SIMPLER = 0.8
"""Share of the largest gain (sum of logarithms) with which a change of few parameters is preferred to one of all."""

LOAD, GRAVITY, FRICTION, GAIN, EVERY = "load", "gravity", "friction", "gain", "every parameter"

CONCERNED = 2.0
"""Factor by which the residual power of a joint falls that a change concerns."""

SAME_TIME_S = 0.5
"""Time between two instants, s, below which a message gives one of them."""

REMEDY = "record again without the change, or import and identify the parts before and after it as recordings"


@dataclass(frozen=True)
class ChangedStretch:
    """A stretch of rows (M,) in which something else holds: ``kind``, at ``joint`` (index) or at the whole arm.

    ``error``, ``left``, ``drift`` (n,): held-out residual over the torque of each joint with one model, with the
    change, and with parameters that change evenly in time. ``theta``: the change, in columns of ``kind``.
    """

    rows: Mask
    kind: str
    joint: int | None
    error: Array
    left: Array
    drift: Array
    theta: Array

    @property
    def gain(self) -> Array:
        """Held-out residual power (n,) of one model over that with the change."""
        return np.asarray((self.error / self.left) ** 2)

    @property
    def certain(self) -> bool:
        """True if the change is material, sudden, and no joint is explained worse by as much."""
        j = int(np.argmax(self.gain))
        drift = float((self.drift[j] / self.left[j]) ** 2)
        material = self.gain[j] >= LEAST_GAIN and self.error[j] >= LEAST_ERROR
        return bool(material and drift >= LEAST_OVER_DRIFT and np.log(self.gain).sum() >= np.log(LEAST_GAIN))


def stretch(bench: Bench, h: Hypothesis) -> ChangedStretch | None:
    """Return the stretch and the change there that explain most more; ``None`` for too few rows."""
    found = _stretch(bench, h, None)
    if found is None or found[0].gain.max() < HALF_GAIN:
        return None if found is None else found[0]
    again = _stretch(bench, h, found[1])
    return again[0] if again is not None and again[0].left.sum() < found[0].left.sum() else found[0]


def _stretch(bench: Bench, h: Hypothesis, rows: Mask | None) -> tuple[ChangedStretch, Mask] | None:
    """Stretch of given rows, or of those that the search finds, and its rows with ends to a row."""
    x, y, _ = equations(bench, h, free=False)
    moving = np.flatnonzero(bench.moving)
    x, y = np.ascontiguousarray(x[:, moving].transpose(1, 0, 2)), y[:, moving]
    m, c = y.shape[0], x.shape[2]
    if m < 2 * BLOCKS:
        return None
    power = np.maximum((y**2).sum(axis=0), 1e-300)
    x, size = _normalised(x, power)
    weights = 1.0 / power
    theta = np.zeros(c)
    for _ in range(PASSES):
        theta = _solved(*_normal(x, y, weights), np.full(c, RIDGE * float(weights @ power)))
        weights = 1.0 / np.maximum(((y - (x @ theta).T) ** 2).sum(axis=0), FLOOR * power)
    if rows is None:
        rows = _best(x, y - (x @ theta).T, weights)
    changes = _changes(bench, h, x, theta, size, moving)
    each_change = np.concatenate([columns for _, _, columns in changes], axis=2)
    extra = each_change * rows[:, None]
    time = np.linspace(-0.5, 0.5, m)[:, None]
    extra, scale = _normalised(np.concatenate([extra, x * time], axis=2), power)
    whole = np.concatenate([x, extra], axis=2)
    fold = (np.arange(m) * 4 * PARTS // m) % PARTS
    ends = np.cumsum([0, *(columns.shape[2] for _, _, columns in changes), c]) + c
    chosen = [np.arange(0), *(np.arange(a, b) for a, b in pairwise(ends))]
    each = [_normal_by_joint(whole[:, fold == f], y[fold == f]) for f in range(PARTS)]
    grams, products = (np.sum([part[k] for part in each], axis=0) for k in range(2))
    for _ in range(2):
        level = float(weights @ power)
        errors = np.zeros((len(chosen), y.shape[1]))
        for f, (gram, product) in enumerate(each):
            left, right = np.tensordot(weights, grams - gram, 1), weights @ (products - product)
            out = fold == f
            for k, more in enumerate(chosen):
                used = np.concatenate([np.arange(c), more])
                ridge = level * np.where(used < c, RIDGE, RIDGE_OF_CHANGE)
                own = _solved(left[np.ix_(used, used)], right[used], ridge)
                errors[k] += ((y[out] - (whole[:, out][:, :, used] @ own).T) ** 2).sum(axis=0)
        errors = np.maximum(errors, FLOOR * power)
        found = np.log(errors[0] / errors[1:-1]).sum(axis=1)
        simple = 1 + int(np.argmax(found[1:]))
        best = simple if found[simple] >= SIMPLER * found.max() else 0
        weights = 1.0 / errors[best + 1]
    used = np.concatenate([np.arange(c), chosen[best + 1]])
    ridge = float(weights @ power) * np.where(used < c, RIDGE, RIDGE_OF_CHANGE)
    solved = _solved(np.tensordot(weights, grams, 1)[np.ix_(used, used)], (weights @ products)[used], ridge)
    own = solved[c:] / scale[chosen[best + 1] - c]
    without = y - (x @ solved[:c]).T
    made = (each_change[:, :, chosen[best + 1] - c] @ own).T
    better = (without**2 - (without - made) ** 2) @ weights
    shares = np.ones((3, bench.n))
    shares[:, moving] = np.sqrt(errors[[0, best + 1, -1]] / power)
    kind, joint, _ = changes[best]
    if kind == GAIN:
        outside = (y - without)[:, moving == joint]
        own = np.array([float((outside * made[:, moving == joint]).sum() / (outside**2).sum())])
    return ChangedStretch(rows, kind, joint, shares[0], shares[1], shares[2], own), _ends(rows, better)


def _ends(rows: Mask, better: Array) -> Mask:
    """Stretch around the middle of given rows (M,) over which a change is ``better`` in all."""
    middle = int(np.flatnonzero(rows).mean())
    end = middle + int(np.argmax(np.cumsum(better[middle:]))) + 1
    begin = middle - int(np.argmax(np.cumsum(better[middle::-1])))
    made = np.zeros(rows.size, dtype=np.bool_)
    made[begin:end] = True
    return made if LEAST_ROWS <= end - begin <= rows.size - LEAST_ROWS else rows


def _changes(
    bench: Bench, h: Hypothesis, x: Array, theta: Array, size: Array, moving: NDArray[np.int64]
) -> list[tuple[str, int | None, Array]]:
    """Kinds of change with their joint and columns (n, M, .): what has few parameters shows in few rows."""
    names, base = list(bench.model.base.names), bench.model.base
    made: list[tuple[str, int | None, Array]] = [(EVERY, None, x)]
    # Other parameters of the last body change base parameters of the joints before it, too.
    body = [k for k, name in enumerate(bench.model.names) if name.rstrip("0123456789") in BODY]
    last = [k for k in body if bench.model.names[k].lstrip("abcdefghijklmnopqrstuvwxyz") == str(bench.n)]
    made.append((LOAD, bench.n - 1, x @ (base.regroup[:, last] * np.where(np.isfinite(size), size, 0.0)[:, None])))
    if h.gravity.any():
        made.append((GRAVITY, None, bench.rows(h.position).of_gravity(theta / size)[moving]))
    for k, j in enumerate(moving):
        alone = np.zeros_like(x)
        alone[k] = x[k]
        friction = [i for i, name in enumerate(names) if name in (f"fv{j + 1}", f"fc{j + 1}", f"off{j + 1}")]
        made.append((FRICTION, int(j), x[:, :, friction]))
        made.append((GAIN, int(j), (alone @ theta)[..., None]))
    return made


def _normalised(x: Array, power: Array) -> tuple[Array, Array]:
    """Columns of equations (n, M, c) with the same norm, in shares of the torques' power, and their norms."""
    size = np.sqrt(np.einsum("jmc,j->c", x**2, 1.0 / power))
    size = np.where(size > 1e-9 * size.max(initial=0.0), size, np.inf)
    return np.asarray(x / size), size


def _normal_by_joint(x: Array, y: Array) -> tuple[Array, Array]:
    return np.asarray(x.transpose(0, 2, 1) @ x), np.einsum("jmc,mj->jc", x, y)


def _normal(x: Array, y: Array, weights: Array) -> tuple[Array, Array]:
    grams, products = _normal_by_joint(x, y)
    return np.tensordot(weights, grams, 1), np.asarray(weights @ products)


def _solved(gram: Array, right: Array, ridge: Array) -> Array:
    return np.asarray(np.linalg.solve(gram + np.diag(ridge), right))


def _best(x: Array, residual: Array, weights: Array) -> Mask:
    """Rows of the contiguous stretch with the least residual of two models, each free around that of all rows."""
    m, c = residual.shape[0], x.shape[2]
    edges = np.linspace(0, m, BLOCKS + 1).astype(np.int64)
    each = [_normal(x[:, a:b], residual[a:b], weights) for a, b in pairwise(edges)]
    grams, products = (np.cumsum([np.zeros_like(each[0][k]), *(part[k] for part in each)], axis=0) for k in range(2))
    spans = [(i, j) for i in range(1, BLOCKS) for j in range(i + LEAST_BLOCKS, BLOCKS + 1)]
    first, last = np.array(spans).T
    ridge = RIDGE_OF_CHANGE * np.trace(grams[-1]) / c * np.eye(c)
    inside = grams[last] - grams[first], products[last] - products[first]
    outside = grams[-1] - inside[0], products[-1] - inside[1]
    removed = np.zeros(first.size)
    for gram, product in (inside, outside):
        removed += np.einsum("kc,kc->k", product, np.linalg.solve(gram + ridge, product[..., None])[..., 0])
    best = int(np.argmax(removed))
    rows = np.zeros(m, dtype=np.bool_)
    rows[edges[first[best]] : edges[last[best]]] = True
    return rows


def spans(found: ChangedStretch, bench: Bench) -> tuple[Span, ...]:
    """Parts of the experiments that a stretch covers; from the instant before to that after it; infinite at an end."""
    of, time = bench.times()
    parts = []
    for number in np.unique(of[found.rows]):
        rows, own = found.rows[of == number], time[of == number]
        first, last = np.flatnonzero(rows)[[0, -1]]
        begin = -np.inf if first == 0 else float(own[first - 1])
        parts.append(Span(int(number), begin, np.inf if last == rows.size - 1 else float(own[last + 1])))
    return tuple(parts)


def change_finding(found: ChangedStretch, bench: Bench, h: Hypothesis) -> SetupFinding:
    """Return a stretch as a finding: when, at which joints, and what it looks like."""
    robot = bench.robot
    names = [joint.name for joint in robot.joints]
    joints = tuple(names[j] for j in np.flatnonzero((found.gain >= CONCERNED) & bench.moving))
    j = int(np.argmax(found.gain))
    where = "; ".join(
        _when(found, bench, number) for number in dict.fromkeys(s.experiment for s in spans(found, bench))
    )
    message = (
        f"the arm is another one {where}: it looks like {_looks(found, bench, h)}; one model leaves "
        f"{100 * found.error[j]:.3g} % of the torque of {names[j]}, with this change {100 * found.left[j]:.3g} %"
    )
    decisive = found.kind in (EVERY, LOAD, GRAVITY)
    return SetupFinding("change_in_time", joints, RIGHT, message, REMEDY, decisive)


def _when(found: ChangedStretch, bench: Bench, number: int) -> str:
    """Begin and end of a stretch in one experiment, in words; between instants at which all joints move."""
    of, time = bench.times()
    time, rows = time[of == number], found.rows[of == number]
    first, last = (int(k) for k in np.flatnonzero(rows)[[0, -1]])
    begin = "" if first == 0 else f"from {_between(time[first - 1], time[first])} s on"
    end = "" if last == rows.size - 1 else f"until {_between(time[last], time[last + 1])} s"
    part = f"in part {number + 1} of the recordings compared " if len(bench.segments) > 1 else ""
    return f"{part}{begin or 'from the beginning on'} {end}".rstrip()


def _between(a: float, b: float) -> str:
    return f"{b:.2f}" if b - a < SAME_TIME_S else f"{a:.2f} to {b:.2f}"


def _looks(found: ChangedStretch, bench: Bench, h: Hypothesis) -> str:
    """Kind of the change of a stretch in words."""
    joint = "" if found.joint is None else bench.robot.joints[found.joint].name
    if found.kind == LOAD:
        return f"another load at {joint}"
    if found.kind == GRAVITY:
        other = h.gravity + found.theta
        cosine = float(h.gravity @ other / max(float(np.linalg.norm(h.gravity) * np.linalg.norm(other)), 1e-300))
        return f"gravity turned by {np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))):.3g} degrees: the base moved"
    if found.kind == GAIN:
        return f"torques of {joint} {1.0 + found.theta[0]:.3g} times as large"
    if found.kind == FRICTION:
        return f"another friction of {joint}"
    return "another arm, another recording, or brakes"
