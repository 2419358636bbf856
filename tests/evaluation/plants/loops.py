"""Compiled encoders and controllers."""

import math

from armident.compiled import PLAIN, compiled
from tests.evaluation.plants.slots import (
    ECCENTRICITY,
    ECCENTRICITY_ORDER,
    ECCENTRICITY_PHASE,
    FEEDFORWARD,
    FILTER,
    KI,
    KP,
    KV,
    LIMIT,
    ONE_LOOP,
    WINDOW,
)


@compiled(**PLAIN)
def read_encoder(law, x, resolution):  # type: ignore[no-untyped-def]
    """Position that an encoder reads, rad or m.

    ``law``: row of the law table; ``x``: position; ``resolution``: encoder step.
    """
    if law[ECCENTRICITY] != 0.0:
        x += law[ECCENTRICITY] * math.sin(law[ECCENTRICITY_ORDER] * x + law[ECCENTRICITY_PHASE])
    return math.floor(x / resolution + 0.5) * resolution


@compiled(**PLAIN)
def command(gains, k, j, step, reading, qr, qdr, speed, integral):  # type: ignore[no-untyped-def]
    """Torque that the controller of a joint demands, N m or N.

    ``gains``: row of the table of controllers. ``k``, ``j``: number of the step and of the joint. ``reading``: encoder
    readings up to step k, shape (K, n). ``qr``, ``qdr``: reference positions and velocities, shape (K, n). ``speed``,
    ``integral``: filtered velocity and integral of each joint, shape (n,); written in place.
    """
    back = max(k - int(gains[WINDOW]), 0)
    rate = (reading[k, j] - reading[back, j]) / ((k - back) * step) if k > back else 0.0
    speed[j] += gains[FILTER] * (rate - speed[j])
    error = qr[k, j] - reading[k, j]
    if gains[ONE_LOOP] > 0.0:
        integral[j] += gains[KI] * error * step
        out = gains[KP] * error + gains[KV] * (qdr[k, j] - speed[j]) + integral[j]
    else:
        demand = gains[KP] * error + gains[FEEDFORWARD] * qdr[k, j]
        integral[j] += gains[KI] * (demand - speed[j]) * step
        out = gains[KV] * (demand - speed[j]) + integral[j]
    return min(max(out, -gains[LIMIT]), gains[LIMIT])
