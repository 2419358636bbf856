"""Differences between two models that make equal parameters unlike: smoothing of friction, effects, structure."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.sign_smoothing import SATURATION

Configuration = Mapping[str, Any]

_WHOLE = ("gravity", "transmission", "couplings", "preprocessing")
_OF_JOINTS = ("type", "mdh", "rotor_inertia")
_OF_DRIVES = ("signal", "gain", "saturation")
"""Keys of a robot configuration that parameters depend on."""

TYPICAL_SHARE = 0.5
"""Typical speed of a joint over its largest one: the mean of the absolute velocity of a ramp, and nearly of a sine."""


def model_differences(
    baseline: IdentificationDocument, now: IdentificationDocument, std: Mapping[str, float]
) -> list[str]:
    """One line per kind of difference between two models that may look like a change; ``std``: of the differences."""
    lines = [_smoothing(baseline, now, std)]
    if baseline.configuration is not None and now.configuration is not None:
        lines += [
            _effects(baseline.configuration, now.configuration),
            _structure(baseline.configuration, now.configuration),
        ]
    if baseline.method != now.method:
        lines.append(f"different methods: {baseline.method} and {now.method}; the bias of each is not part of the test")
    return [line for line in lines if line]


def _smoothing(baseline: IdentificationDocument, now: IdentificationDocument, std: Mapping[str, float]) -> str:
    """Line on joints whose Coulomb friction is shifted by more than one standard deviation.

    The smoothed sign lacks ``2 / (pi g v)`` at a velocity ``v``; another ``g`` shifts Coulomb friction by that share.
    """
    one, other = baseline.sign_smoothing or {}, now.sign_smoothing or {}
    values = {p.name: p.value for p in now.parameters}
    found = []
    for k, joint in enumerate(now.relative_error_pct_by_joint, start=1):
        name = f"fc{k}"
        if name not in std or joint not in one or joint not in other:
            continue
        lacking = 2 / np.pi * abs(1 / one[joint] - 1 / other[joint]) / _typical_speed(joint, baseline, now)
        if lacking * abs(values[name]) > std[name]:
            found.append(f"{joint} {one[joint]:.4g} and {other[joint]:.4g}")
    if not found:
        return ""
    return (
        f"different friction.sign_smoothing: {'; '.join(found)}; this alone shifts Coulomb and viscous friction by "
        "more than a standard deviation. Identify both with one value in the robot configuration"
    )


def _typical_speed(joint: str, *documents: IdentificationDocument) -> float:
    """Return the smaller of the typical speeds of a joint in two recordings, rad/s or m/s."""
    largest = []
    for document in documents:
        limits = {each.joint: each.velocity_limit for each in document.residual_statistics or ()}
        largest.append(limits.get(joint) or SATURATION / (document.sign_smoothing or {})[joint])
    return TYPICAL_SHARE * min(largest)


def _effects(baseline: Configuration, now: Configuration) -> str:
    one, other = ({_effect(each) for each in configuration["effects"]} for configuration in (baseline, now))
    sides = [
        f"{', '.join(sorted(only))} only in the {which} model"
        for which, only in (("earlier", one - other), ("later", other - one))
        if only
    ]
    return f"different effects: {'; '.join(sides)}; the other parameters may take over their torque" if sides else ""


def _effect(entry: Configuration) -> str:
    """Return an effect in words, with all that distinguishes it from another one."""
    law = f" ({entry['law']})" if entry.get("law") else ""
    other = f" and {entry['other']}" if entry.get("other") else ""
    numbers = ", ".join(f"{name} {value:.6g}" for name, value in sorted(entry.get("parameters", {}).items()))
    left_out = "".join(f" without {name}" for name in entry.get("without", ()))
    return f"{entry['effect']}{law} of {entry['joint']}{other}{f' [{numbers}]' if numbers else ''}{left_out}"


def _structure(baseline: Configuration, now: Configuration) -> str:
    """Return the line on keys of the configurations that differ and that parameters depend on."""
    keys = [key for key in _WHOLE if baseline.get(key) != now.get(key)]
    if len(baseline["joints"]) != len(now["joints"]):
        keys.append("number of joints")
    for one, other in zip(baseline["joints"], now["joints"], strict=False):
        place = f"joints.{other['name']}"
        keys += [f"{place}.{key}" for key in _OF_JOINTS if one.get(key) != other.get(key)]
        drives = one.get("drive") or {}, other.get("drive") or {}
        keys += [f"{place}.drive.{key}" for key in _OF_DRIVES if drives[0].get(key) != drives[1].get(key)]
    if not keys:
        return ""
    shown = ", ".join(keys[:6]) + (f" and {len(keys) - 6} more" if len(keys) > 6 else "")
    return f"the models have different configurations ({shown}): their parameters do not mean the same"
