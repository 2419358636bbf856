"""Limits of an exported file: what its format cannot hold, and which parameters the data did not determine."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from armident.identify.model_export.exported_model import ExportedEffect, ExportedModel

PARTS = {
    "rotor inertia": ("kg m^2", "kg"),
    "viscous friction": ("N m s/rad", "N s/m"),
    "Coulomb friction": ("N m", "N"),
    "offset": ("N m", "N"),
}
"""Parameters of a joint besides its link, with their units at a revolute and at a prismatic joint."""

ATTRIBUTES = ("rotor_inertia", "viscous", "coulomb", "offset")
"""Attributes of `JointFriction` in the order of `PARTS`."""


@dataclass(frozen=True)
class Omission:
    """Part that a format cannot hold, as ``offset of joint_2: 0.31 N m``; ``reason``: consequence or next step."""

    part: str
    reason: str = ""


@dataclass(frozen=True)
class Measured:
    """Figures of a file: program, motion, torque difference in total and by joint (percent), and remarks.

    ``missing``: reason for which there are no figures; empty if there are. ``supplement``: module whose torques leave
    ``error_pct_with_supplement``.
    """

    program: str = ""
    motion: str = ""
    error_pct: float | None = None
    error_pct_by_joint: dict[str, float] | None = None
    remarks: Sequence[str] = ()
    missing: str = ""
    supplement: str = ""
    error_pct_with_supplement: float | None = None

    def lines(self) -> list[str]:
        """Return the figures as sentences."""
        if self.error_pct is None:
            return [f"not measured: {self.missing}"]
        each = ", ".join(f"{name} {value:.2g} %" for name, value in (self.error_pct_by_joint or {}).items())
        found = (
            f"{self.program} computes torques that differ by {self.error_pct:.2g} % from those of the identified model "
            f"({each}) along {self.motion}"
        )
        if self.error_pct_with_supplement is not None:
            found += f", and by {self.error_pct_with_supplement:.2g} % with the torques of {self.supplement}"
        return [found, *self.remarks]

    def document(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        return {name: value for name, value in vars(self).items() if value not in ("", None, ())}


@dataclass(frozen=True)
class LimitationSheet:
    """Limits of an exported file: parts held and omitted, undetermined parameters with the reason, remarks, figures.

    ``holds``: parts that the format has; ``effects``: numbers of the effects that the file has.
    """

    format_name: str
    held: tuple[str, ...]
    omitted: tuple[Omission, ...] = ()
    undetermined: dict[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    measured: Measured | None = None
    holds: frozenset[str] = frozenset()
    effects: frozenset[int] = frozenset()

    def markdown(self, title: str) -> str:
        """Return the sheet as a Markdown page. ``title``: first heading."""
        lines = [f"# {title}"]
        for heading, entries in self._sections():
            lines += ["", f"## {heading}", "", *(f"- {entry}" for entry in entries)]
        return "\n".join(lines) + "\n"

    def lines(self) -> list[str]:
        """Return the sheet as lines for a terminal."""
        lines: list[str] = []
        for heading, entries in self._sections():
            lines += [f"{heading}:", *(f"  - {entry}" for entry in entries)]
        return lines

    def _sections(self) -> Iterator[tuple[str, Sequence[str]]]:
        """Return heading and entries of each section that has entries."""
        omitted = [f"{o.part}{'. ' + o.reason if o.reason else ''}" for o in self.omitted]
        if self.measured is not None:
            yield "Measured", self.measured.lines()
        yield "In the file", self.held
        yield "Not in the file", omitted or ["nothing is left out"]
        yield "Not determined by the recordings", _by_reason(self.undetermined) or ["every parameter was determined"]
        if self.remarks:
            yield "Remarks", self.remarks

    def document(self) -> dict[str, Any]:
        """Return the sheet as lists and dictionaries for JSON."""
        return {
            "format": self.format_name,
            "held": list(self.held),
            "omitted": [{"part": o.part, "reason": o.reason} for o in self.omitted],
            "undetermined": dict(self.undetermined),
            "remarks": list(self.remarks),
            **({} if self.measured is None else {"measured": self.measured.document()}),
        }


def limitation_sheet(
    model: ExportedModel,
    format_name: str,
    holds: Collection[str],
    *,
    effects: Collection[ExportedEffect] = (),
    parts: Mapping[int, str] = MappingProxyType({}),
    remarks: Collection[str] = (),
) -> LimitationSheet:
    """Return the sheet of a file that ``holds`` links and some of `PARTS`, ``couplings``, ``gravity``, ``springs``.

    ``effects``: held as such. ``parts``: part of the arm that another effect was added to, by index of the effect.
    """
    held = ["masses, centres of mass and inertias of the links", *(part for part in PARTS if part in holds)]
    omitted = [
        Omission(f"{part} of {joint.name}: {_number(getattr(joint, attribute))} {units[joint.type == 'prismatic']}")
        for (part, units), attribute in zip(PARTS.items(), ATTRIBUTES, strict=True)
        if part not in holds
        for joint in model.joints
        if getattr(joint, attribute)
    ]
    if model.couplings:
        named = list(_couplings(model))
        held += named if "couplings" in holds else []
        omitted += [] if "couplings" in holds else [Omission(text) for text in named]
    gravity = ", ".join(_number(g) for g in model.frames.gravity)
    text = f"gravity ({gravity}) m/s^2 in the frame of {model.frames.base}"
    if "gravity" in holds:
        held.append(text)
    else:
        omitted.append(Omission(text, "Set it in the program that reads the file."))
    for k, effect in enumerate(model.effects):
        if effect in effects:
            held.append(effect_in_words(model, effect))
        elif parts.get(k) in holds:
            held.append(f"{effect_in_words(model, effect)} (in: {parts[k]})")
        elif parts.get(k) in (*PARTS, "couplings", "gravity"):
            continue  # listed above as that part
        elif effect.of_recording:
            omitted.append(
                Omission(effect_in_words(model, effect), "It corrects recordings and is no part of the arm.")
            )
        else:
            omitted.append(Omission(effect_in_words(model, effect)))
    return LimitationSheet(
        format_name,
        tuple(held),
        tuple(omitted),
        model.undetermined,
        (*_about_estimate(model), *remarks),
        holds=frozenset(holds),
        effects=frozenset(k for k, each in enumerate(model.effects) if each in effects or parts.get(k) in holds),
    )


def effect_in_words(model: ExportedModel, effect: ExportedEffect) -> str:
    """Return title, joints and parameters of an effect. ``model``: the exported model, for the names of the joints."""
    names = [model.joints[k].name for k in (effect.joint, effect.other) if k is not None]
    values = ", ".join(
        f"{name} = {_number(value)} {effect.units.get(name, '')}".rstrip() for name, value in effect.parameters.items()
    )
    kind = effect.effect + (f", law {effect.law}" if effect.law else "")
    return f"{effect.title} ({kind}) of {' and '.join(names)}{': ' + values if values else ''}"


def _couplings(model: ExportedModel) -> Iterator[str]:
    """Return each coupling in words."""
    for coupling in model.couplings:
        names = [model.joints[k].name for k in coupling.joints]
        yield (
            f"coupling {coupling.name} of {' and '.join(names)}: inertia {_number(coupling.inertia)} kg m^2, "
            f"viscous friction {_number(coupling.viscous)} N m s/rad, Coulomb friction {_number(coupling.coulomb)} N m"
        )


def _about_estimate(model: ExportedModel) -> Iterator[str]:
    """Return remarks on the geometry, the verdict of the estimate, and its distance from a physical arm."""
    if model.configuration:
        yield f"robot configuration: {model.configuration}"
    if model.source_urdf is None:
        yield "links have the Denavit-Hartenberg frames of the configuration; --urdf FILE takes those of a URDF"
    if model.document.verdict is not None:
        reasons = [reason.message for reason in model.document.reasons]
        more = f" (and {len(reasons) - 1} more in {model.source.name})" if len(reasons) > 1 else ""
        yield f"verdict of the identification: {': '.join([model.document.verdict, *reasons[:1]])}{more}"
    yield f"parameters that torques leave open: those of {model.choice}"
    yield f"physical consistency: {model.consistent.verdict}"
    moved = np.abs(model.consistent.shifts)
    worst = int(np.argmax(moved))
    if moved[worst] > 1.0:
        yield (
            f"the base parameters in the file differ from the estimate by up to {moved[worst]:.2g} standard deviations "
            f"({model.consistent.base_names[worst]})"
        )


def _by_reason(undetermined: dict[str, str]) -> list[str]:
    """Return the names of parameters with equal reasons on one line."""
    names: dict[str, list[str]] = {}
    for name, reason in undetermined.items():
        names.setdefault(reason, []).append(name)
    return [f"{reason}: {', '.join(each)}" for reason, each in names.items()]


def _number(value: float) -> str:
    return f"{value:.4g}"
