"""Glossary of parameter names and report terms, from effects, documents and variables: every report has a section."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from armident.identify.diagnosis.variables import VARIABLES
from armident.identify.documents.base import Document
from armident.identify.documents.diagnosis import VERDICTS, DiagnosisDocument, Finding
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.effect import Effect
from armident.identify.effects.registry import catalogue
from armident.identify.estimators.methods import METHODS, estimator


@dataclass(frozen=True)
class GlossaryEntry:
    """Explanation of a parameter or term, with its units at a revolute and at a prismatic joint; empty: no unit."""

    name: str
    text: str
    units: tuple[str, str] = ("", "")

    @property
    def unit(self) -> str:
        """Units as text, ``N m | N``."""
        return " | ".join(dict.fromkeys(unit for unit in self.units if unit))


def _entries(texts: dict[str, str]) -> tuple[GlossaryEntry, ...]:
    return tuple(GlossaryEntry(name, text) for name, text in texts.items())


INERTIA, MOMENT = ("kg m^2", "kg m^2"), ("kg m", "kg m")

RIGID = tuple(GlossaryEntry(*each) for each in (
    ("xx", "Moment of inertia of the link about the x axis of its frame, at the origin of that frame.", INERTIA),
    ("yy", "Moment of inertia of the link about the y axis of its frame.", INERTIA),
    ("zz", "Moment of inertia of the link about the z axis of its frame, which is the joint axis.", INERTIA),
    ("xy", "Product of inertia xy of the link.", INERTIA),
    ("xz", "Product of inertia xz of the link.", INERTIA),
    ("yz", "Product of inertia yz of the link.", INERTIA),
    ("mx", "First moment of mass of the link along x: mass times the x coordinate of its centre.", MOMENT),
    ("my", "First moment of mass of the link along y.", MOMENT),
    ("mz", "First moment of mass of the link along z.", MOMENT),
    ("m", "Mass of the link; of a prismatic axis the moved mass with the rotor.", ("kg", "kg")),
    ("ia", "Inertia of the motor's rotor, on the joint side: motor inertia times the squared gear ratio.",
     ("kg m^2", "kg")),
    ("fv", "Viscous friction: torque per joint velocity.", ("N m s/rad", "N s/m")),
    ("fc", "Coulomb friction: level of the dry friction torque, with the sign of the velocity.", ("N m", "N")),
    ("off", "Constant torque offset: current sensor, asymmetric friction.", ("N m", "N")),
))  # fmt: skip
"""Standard parameters of a link and its joint (thesis equations 2.6, 2.12 and 2.13); the joint number follows."""

CONVENTIONS = _entries({
    "joint number": "The digits at the end of a name: `fv2` is of joint 2, `fcc45` of the joints 4 and 5.",
    "suffix r": "Base parameter that groups others: `zz1r` contains `zz1` and parameters of links 2 and up. The "
        "formula is in the report; `r` stands for regrouped (thesis section A.3, table B.3).",
    "suffix _2": "Second instance of an effect at the same joint, for example another harmonic.",
    "coupling name": "Letters and digits after `ia`, `fv` or `fc` that are not a joint number: `iam6` is the "
        "inertia of the coupling `m6` in the robot configuration (thesis equation B.1).",
    "joint side": "All torques, inertias and friction parameters refer to the joint: motor torque times the gear "
        "ratio, motor inertia times its square. Torques are in N m, of prismatic joints forces in N.",
    "link frame": "Frame of modified Denavit-Hartenberg parameters: z along the joint axis. Lengths in formulas, "
        "for example `d3` and `r4`, are those parameters.",
})  # fmt: skip
"""Rules by which parameter names are formed."""

TERMS = _entries({
    "trustworthy": "Verdict of an identification: no check found a defect.",
    "doubtful": "Verdict of an identification: the parameters can be used within the limits that the reasons "
        "state.",
    "unusable": "Verdict of an identification: the parameters must not be used. `armident identify` ends with "
        "exit code 3.",
    "nearest possible arm": "Physically consistent parameters closest to an estimate, in units of its "
        "covariance. If they explain the torques too, impossible values come from small model errors.",
    "determined": "Parameter whose standard deviation is at most a third of its value, in a fit of those that "
        "the motion supports together.",
    "base parameters": "Smallest set of parameters that determines the torques; combinations of the standard "
        "ones (thesis section A.3).",
    "residual": "Measured minus predicted torque.",
    "NVR": "Noise-variance ratio of the position smoother: small values smooth more (thesis section 5.1.2).",
    "IRWSM": "Integrated-random-walk smoother: derivatives of measured positions by fixed-interval smoothing "
        "(thesis section 5.1.2).",
    "instruments": "Signals that follow the motion but not the measurement noise. Weak instruments follow a "
        "parameter's column of the regressor too little to determine it.",
    "Durbin, Wu, Hausman": "Test that compares least squares and instrumental variables: a difference beyond "
        "chance means that least squares is biased by noise.",
    "Ljung-Box": "Probability of such an autocorrelation in white noise.",
    "Breusch-Pagan": "Probability of such a variation of the residual's variance under constant variance.",
    "physically consistent": "Parameters that belong to real masses: every link has a positive mass and a "
        "positive-definite inertia with triangle inequality.",
    "samples lost": "Samples of a recording that did not arrive. They are recorded as missing, never filled.",
    "held-out data": "Data that are not used for fitting: `--validate`, or the last part of the recordings. "
        "Effects must reduce the error there.",
    "ambiguous": "Alternatives whose likelihood is within a factor of twenty of the finding's. The next "
        "experiment separates them.",
    "p-value": "Probability that a model without the effect shows at least this evidence by chance.",
    "false-alarm rate": "Probability that a diagnosis of a complete model finds anything; option "
        "`--false-alarms`, shared between all tests.",
    "baseline": "Earlier identification of the same arm whose parameters are tested for change.",
})  # fmt: skip
"""Tests and words of the reports that are no keys of a document."""

EVERYDAY = {
    "after", "all", "before", "by_joint", "configuration", "converged", "effect", "evidence", "findings", "formula",
    "hint", "information", "iterations", "joint", "kind", "lags", "law", "level", "limits", "message", "method",
    "model", "name", "options", "other", "parameters", "path", "reason", "reasons", "recording", "recordings", "rms",
    "robot", "samples", "schema", "sha256", "train", "unit", "units", "validation", "value", "verdict", "versions",
    "warnings",
}  # fmt: skip
"""Keys of documents that need no explanation."""

_NAME = re.compile(r"([a-z_]+?)(m?\d+)(r?)((?:_\d+)?)$")


def effect_entries(effect: Effect) -> list[GlossaryEntry]:
    """Return entries of an effect's parameters, linear, then nonlinear; of a wiring error those of the signals."""
    return [GlossaryEntry(p.name, p.meaning or effect.description, p.unit) for p in effect.parameters_of_entry]


def base_entry(name: str) -> GlossaryEntry | None:
    """Return the entry of the kind of a base parameter, of ``zz`` for ``zz1r``; ``None`` if unknown."""
    match = _NAME.match(name)
    kind = name if match is None else match[1]
    known = {entry.name: entry for entry in RIGID}
    for effect in catalogue().values():
        for entry in effect_entries(effect)[: len(effect.linear)]:
            known.setdefault(entry.name, entry)
    # A coupling may have any name: iam6, fvwrist.
    own = known.get(kind)
    return own or next((known[start] for start in ("ia", "fv", "fc") if name.startswith(start)), None)


def in_words(name: str) -> str:
    """Return the meaning of a base parameter with its link, joint or coupling; empty if unknown.

    >>> in_words("my5r")
    'first moment of mass of link 5 along y, grouped'
    """
    entry, match = base_entry(name), _NAME.match(name)
    if entry is None:
        return ""
    phrase = re.split("[:;,.]", entry.text)[0]
    phrase = phrase.removesuffix(" of its frame")
    phrase = phrase if phrase.startswith("Coulomb") else phrase[0].lower() + phrase[1:]
    if match is None:
        return phrase
    if "the link" in phrase:
        phrase = phrase.replace("the link", f"link {match[2]}", 1)
    else:
        phrase += f", coupling {match[2]}" if match[2].startswith("m") else f", joint {match[2]}"
    return f"{phrase}, grouped" if match[3] else phrase


def parameter_meaning(name: str, finding: Finding) -> str:
    """Return the meaning of a parameter of a finding, as a sentence; empty if unknown."""
    effects = catalogue()
    effect = effects.get(f"{finding.effect}/{finding.law}" if finding.law else finding.effect)
    entries = [] if effect is None else [entry for entry in effect_entries(effect) if entry.name == name]
    return entries[0].text if entries else in_words(name)


def base_entries(names: Iterable[str]) -> list[GlossaryEntry]:
    """Return the entries that explain a list of base parameters, each once, in the order of the glossary."""
    found = {entry.name: entry for entry in map(base_entry, names) if entry is not None}
    order = [entry.name for entry in RIGID]
    return sorted(found.values(), key=lambda e: order.index(e.name) if e.name in order else len(order))


def finding_entries(findings: Iterable[Finding]) -> list[GlossaryEntry]:
    """Return the entries of the parameters of findings, each once."""
    found: dict[str, GlossaryEntry] = {}
    effects = catalogue()
    for finding in findings:
        key = f"{finding.effect}/{finding.law}" if finding.law else finding.effect
        if key in effects:
            for entry in effect_entries(effects[key]):
                if entry.name in finding.parameters:
                    name = f"{entry.name} ({finding.effect.replace('_', ' ')})"
                    found.setdefault(name, GlossaryEntry(name, entry.text, entry.units))
        else:
            found |= {entry.name: entry for entry in base_entries(finding.parameters)}
    return list(found.values())


def document_entries(kind: type[Document]) -> list[GlossaryEntry]:
    """Return the keys of a document and of its parts in words, with their descriptions in the schema."""
    schema = kind.model_json_schema(by_alias=True)
    found: dict[str, GlossaryEntry] = {}
    for part in (schema, *schema.get("$defs", {}).values()):
        for key, field in part["properties"].items():
            if key not in EVERYDAY:
                name = re.sub(r"_(pct|hz|samples|s)\b", "", key).replace("_", " ").replace("std", "standard deviation")
                found.setdefault(name, GlossaryEntry(name, field["description"].replace("``", "`")))
    return list(found.values())


def verdict_entries() -> list[GlossaryEntry]:
    """Return the verdicts of a diagnosis."""
    return [GlossaryEntry(name.replace("_", " "), f"Verdict of a diagnosis: {text}") for name, text in VERDICTS.items()]


def variable_entries() -> list[GlossaryEntry]:
    """Return the variables that an unexplained residual may depend on: values of ``varies_with``."""
    return [GlossaryEntry(name, variable.meaning) for name, variable in VARIABLES.items()]


@cache
def all_terms() -> tuple[GlossaryEntry, ...]:
    """Return all terms of reports: methods and tests, keys of documents, verdicts."""
    keys = (document_entries(kind) for kind in (IdentificationDocument, DiagnosisDocument))
    methods = [GlossaryEntry(method.upper(), estimator(method).meaning) for method in METHODS]
    every = (entry for part in (TERMS, methods, verdict_entries(), *keys) for entry in part)
    return tuple({entry.name: entry for entry in every}.values())


def mentioned(page: str) -> list[GlossaryEntry]:
    """Return the terms that a page mentions."""
    text = re.sub(r'src="data:[^"]*"|<script.*?</script>', "", page, flags=re.DOTALL)

    def stands(entry: GlossaryEntry) -> bool:
        # The name of a test may be the names of its authors.
        return any(re.search(rf"\b{re.escape(word)}", text, re.IGNORECASE) for word in entry.name.split(", "))

    return [entry for entry in all_terms() if stands(entry)]
