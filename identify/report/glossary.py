"""Glossary of parameter names and report terms: source of ``docs/glossary.md`` and of the section in every report."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from armident.identify.documents.diagnosis import DiagnosisDocument, Finding, Verdict
from armident.identify.documents.files import write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.effect import Effect
from armident.identify.effects.registry import catalogue
from armident.identify.effects.tables import KNOTS
from armident.identify.effects.wiring import Wiring


@dataclass(frozen=True)
class Entry:
    """One entry of the glossary.

    ``name``: parameter or term. ``text``: explanation, one or two sentences. ``units``: units at a revolute and at a
    prismatic joint; empty strings for a number without unit.
    """

    name: str
    text: str
    units: tuple[str, str] = ("", "")

    @property
    def unit(self) -> str:
        """Units as text, ``N m | N``."""
        return " | ".join(dict.fromkeys(unit for unit in self.units if unit))


INERTIA, MOMENT = ("kg m^2", "kg m^2"), ("kg m", "kg m")

RIGID: tuple[Entry, ...] = (
    Entry("xx", "Moment of inertia of the link about the x axis of its frame, at the origin of that frame.", INERTIA),
    Entry("yy", "Moment of inertia of the link about the y axis of its frame.", INERTIA),
    Entry("zz", "Moment of inertia of the link about the z axis of its frame, which is the joint axis.", INERTIA),
    Entry("xy", "Product of inertia xy of the link.", INERTIA),
    Entry("xz", "Product of inertia xz of the link.", INERTIA),
    Entry("yz", "Product of inertia yz of the link.", INERTIA),
    Entry("mx", "First moment of mass of the link along x: mass times the x coordinate of its centre.", MOMENT),
    Entry("my", "First moment of mass of the link along y.", MOMENT),
    Entry("mz", "First moment of mass of the link along z.", MOMENT),
    Entry("m", "Mass of the link; of a prismatic axis the moved mass with the rotor.", ("kg", "kg")),
    Entry("ia", "Inertia of the motor's rotor, on the joint side: motor inertia times the squared gear ratio.",
          ("kg m^2", "kg")),
    Entry("fv", "Viscous friction: torque per joint velocity.", ("N m s/rad", "N s/m")),
    Entry("fc", "Coulomb friction: level of the dry friction torque, with the sign of the velocity.", ("N m", "N")),
    Entry("off", "Constant torque offset: current sensor, asymmetric friction.", ("N m", "N")),
)  # fmt: skip
"""Standard parameters of a link and its joint (thesis equations 2.6, 2.12 and 2.13); the joint number follows."""

_ROTOR = "Rotor inertia that the gear does not transmit, on the joint side; 0 where the model has it as `ia`."


def _table_of(prefix: str, value: str, variable: str, end: str = "") -> dict[str, str]:
    """Return the texts of the parameters of a table over a variable, whose value is zero at the first knot."""
    texts = {
        f"{prefix}{k}": f"Change of the {value} from knot 0 to knot {k} of {KNOTS - 1} over the {variable}."
        for k in range(1, KNOTS)
    }
    ends = {end: "Last knot."} if end else {"low": "First knot.", "high": "Last knot."}
    return texts | ends


EFFECT_PARAMETERS: dict[str, dict[str, str]] = {
    "asymmetric_viscous_friction": {
        "fva": "Half the difference of the viscous friction between positive and negative velocity.",
    },
    "asymmetric_coulomb_friction": {
        "fca": "Half the difference of the Coulomb friction between positive and negative velocity.",
        "velocity": "Velocity scale over which the difference builds up; 0: at once.",
    },
    "stribeck_friction": {
        "fst": "Additional friction torque at low speed: `fst exp(-(qd / velocity)^2) sign(qd)`.",
        "fsb": "Part of the Coulomb friction that follows the bristle instead of the smoothed sign of the velocity.",
        "velocity": "Stribeck velocity, at which the additional friction has decreased to 37 %.",
        "displacement": "Characteristic displacement of the bristle (Dahl); 0: no bristle.",
    },
    "nonlinear_viscous_friction": {
        "fvn": "Nonlinear part of the viscous friction: `fvn asinh(qd / velocity)` (Eyring).",
        "velocity": "Velocity at which the curve bends: linear below, logarithmic above.",
    },
    "load_dependent_friction": {
        "fcl": "Coulomb friction per transmitted torque.",
        "rotor": _ROTOR,
    },
    "presliding_friction": {
        "fcd": "Coulomb friction that builds up over a displacement after a reversal; negative by convention.",
        "displacement": "Characteristic displacement of Dahl's model.",
    },
    "position_dependent_friction": {
        "fpc": "Amplitude of the cosine component of the Coulomb friction over the position.",
        "fps": "Amplitude of the sine component of the Coulomb friction over the position.",
        "period": "Period of the friction in the joint position.",
    },
    "friction_drift": {
        "fcdr": "Change of the Coulomb friction from the beginning to the end of the recordings.",
        "fvdr": "Change of the viscous friction from the beginning to the end of the recordings.",
        "time_constant": "Time constant of the change.",
    },
    "coupling_friction": {
        "iac": "Inertia shared by the two joints.",
        "fvc": "Viscous friction shared by the two joints.",
        "fcc": "Coulomb friction of the sum of the two velocities.",
    },
    "joint_spring": {"ks": "Stiffness: torque per joint position."},
    "payload": {
        f"{kind}p": f"Additional `{kind}` of the last link, in its frame, compared with the baseline."
        for kind in ("xx", "xy", "xz", "yy", "yz", "zz", "mx", "my", "mz", "m")
    },
    "rotor_inertia": {"iax": "Motor inertia on the joint side beyond that of the model."},
    "gravity_direction": {
        "tilt_x": "Tilt of gravity along the first axis across it, a small angle (x axis of an upright arm).",
        "tilt_y": "Tilt of gravity along the second axis across it (y axis of an upright arm).",
    },
    "torque_offset": {"offx": "Constant torque compared with the baseline."},
    "cogging_torque": {
        "cgc": "Amplitude of the cosine component of the ripple, on the joint side.",
        "cgs": "Amplitude of the sine component of the ripple, on the joint side.",
        "harmonic": "Periods of the ripple per turn of the motor; for a prismatic axis a wave number.",
    },
    "joint_elasticity": {
        "compliance": "Compliance: deflection per transmitted torque.",
        "frequency": "Natural frequency of the link on its elastic joint, at its mean inertia along the motion.",
        "damping": "Damping ratio of that oscillation.",
        "rotor": _ROTOR,
    },
    "backlash": {
        "behind": "Size of the torque pulses relative to those of plastic impacts in the gap; 1: as computed.",
        "gap": "Width of the gap at the joint, from side to side.",
        "rotor": _ROTOR,
    },
    "drive_gain_error": {"gain_error": "Relative error of the reported torque: 0.1 means 10 % too much."},
    "drive_gain_saturation": {"gain_loss": "Share of the torque lost at the torque limit of the joint."},
    "time_delay": {"delay": "Time by which the reported torque is late."},
    "actuator_bandwidth": {"lag": "Time constant of the first-order lag of the actual torque behind the reported one."},
    "encoder_eccentricity": {
        "ecc": "Amplitude of the cosine component of the position error.",
        "ecs": "Amplitude of the sine component of the position error.",
        "harmonic": "Periods of the error per turn of the joint; for a prismatic axis a wave number.",
    },
    "friction_change": {
        "fvx": "Change of the viscous friction since the baseline.",
        "fcx": "Change of the Coulomb friction since the baseline.",
    },
    "sign_error": {
        "position": "1: the position signal has the wrong sign.",
        "torque": "1: the torque signal has the wrong sign.",
        "joint_side": "1: the signals of the joint, in SI units, not those of the drive.",
    },
    "joint_order": {
        "position": "1: the position signals are exchanged.",
        "torque": "1: the torque signals are exchanged.",
        "joint_side": "1: columns of the joints, in SI units, not raw numbers of the drives.",
    },
    "signal_scale": {
        "position": "True over recorded position; with another joint, the multiple of its position that is added.",
        "torque": "True over recorded torque; with another joint, the multiple of its torque that is added.",
    },
    "coulomb_transition": {
        "fct": "Part of the Coulomb friction that reverses gradually: `fct tanh((qd + lead qdd) / velocity)` in place "
        "of the smoothed sign.",
        "velocity": "Velocity over which the dry friction reverses.",
        "lead": "Time by which the dry friction reverses before the differentiated velocity.",
    },
    "stribeck_friction/exponential": {
        "fst": "Additional friction torque at low speed: `fst exp(-|qd| / velocity) sign(qd)`.",
        "velocity": "Velocity at which the additional friction has decreased to 37 %.",
    },
    "stribeck_friction/table": {
        **{
            f"fst{k}": f"Additional friction torque at {share:.0%} of the speed `top`; between the speeds it is linear."
            for k, share in enumerate((0.0, 0.05, 0.12, 0.25))
        },
        "top": "Highest speed of the joint in the recordings.",
    },
    "position_dependent_friction/table": _table_of("fpt", "Coulomb friction", "position"),
    "friction_drift/work": {
        "fcdr": "Change of the Coulomb friction after much work.",
        "fvdr": "Change of the viscous friction after much work.",
        "decay": "Rate of the change per integral of the squared velocity, which is the work of viscous friction.",
    },
    "joint_spring/cubic": {
        "ks": "Stiffness: torque per joint position.",
        "ks2": "Change of the stiffness with the position: torque per square of the position.",
        "ks3": "Stiffening: torque per cube of the position.",
    },
    "joint_spring/table": _table_of("kst", "torque of the spring", "position"),
    "unnamed/velocity": {
        **{
            f"u{k}": f"Torque at {share:.0%} of the speed `top`, {way} velocity; between the speeds it is linear."
            for k, (way, share) in enumerate((w, s) for w in ("positive", "negative") for s in (0.0, 0.04, 0.12, 0.3))
        },
        "top": "Highest speed of the joint in the recordings.",
    },
    "unnamed/time": _table_of("u", "torque", "time", "duration"),
    "unnamed/time_and_direction": _table_of("u", "friction", "time", "duration"),
    "unnamed/torque": _table_of("u", "torque", "torque of the joint"),
    "unnamed/acceleration": _table_of("u", "torque", "acceleration"),
    "unnamed/velocity_of_other": _table_of("u", "torque", "velocity of the other joint"),
    "unnamed/torque_of_other": _table_of("u", "torque", "torque of the other joint"),
    "unnamed/position_of_other": _table_of("u", "torque", "position of the other joint"),
}
"""Meaning of every parameter of the effects of this package."""

CONVENTIONS: tuple[Entry, ...] = (
    Entry("joint number", "The digits at the end of a name: `fv2` is of joint 2, `fcc45` of the joints 4 and 5."),
    Entry("suffix r", "Base parameter that groups others: `zz1r` contains `zz1` and parameters of links 2 and up. The "
          "formula is in the report; `r` stands for regrouped (thesis section A.3, table B.3)."),
    Entry("suffix _2", "Second instance of an effect at the same joint, for example another harmonic."),
    Entry("coupling name", "Letters and digits after `ia`, `fv` or `fc` that are not a joint number: `iam6` is the "
          "inertia of the coupling `m6` in the robot configuration (thesis equation B.1)."),
    Entry("joint side", "All torques, inertias and friction parameters refer to the joint: motor torque times the gear "
          "ratio, motor inertia times its square. Torques are in N m, of prismatic joints forces in N."),
    Entry("link frame", "Frame of modified Denavit-Hartenberg parameters: z along the joint axis. Lengths in formulas, "
          "for example `d3` and `r4`, are those parameters."),
)  # fmt: skip
"""Rules by which parameter names are formed."""

IDENTIFICATION_TERMS: tuple[Entry, ...] = (
    Entry("trustworthy", "Verdict of an identification: no check found a defect."),
    Entry("doubtful", "Verdict of an identification: the parameters can be used within the limits that the reasons "
          "state."),
    Entry("unusable", "Verdict of an identification: the parameters must not be used. `armident identify` ends with "
          "exit code 3."),
    Entry("nearest possible arm", "Physically consistent parameters closest to an estimate, in units of its "
          "covariance. If they explain the torques too, impossible values come from small model errors."),
    Entry("determined", "Parameter whose standard deviation is at most a third of its value, in a fit of those that "
          "the motion supports together."),
    Entry("base parameters", "Smallest set of parameters that determines the torques; combinations of the standard "
          "ones (thesis section A.3)."),
    Entry("standard deviation", "One standard deviation of an estimate, from the covariance of the regression."),
    Entry("relative standard deviation", "Standard deviation over the magnitude of the estimate, percent. Up to 5 %: "
          "well determined; up to 20 %: usable."),
    Entry("essential", "Base parameters that the data need. The others are removed one by one, the largest relative "
          "standard deviation first, while an F-test does not reject this (level 1 %)."),
    Entry("relative torque error", "Norm of the difference between measured and predicted torques over the norm of the "
          "measured ones, percent. Above a third at a joint, the model does not describe it."),
    Entry("residual", "Measured minus predicted torque."),
    Entry("whiteness", "Fraction of the residual's autocorrelation lags outside two standard deviations. White noise "
          "has 5 %; more means that the residual contains model error, and standard deviations may be too small."),
    Entry("noise model", "Autoregressive model of each joint's torque noise, of an order chosen by Akaike's criterion; "
          "its inverse filters the regression (thesis equation 6.19)."),
    Entry("NVR", "Noise-variance ratio of the position smoother: small values smooth more (thesis section 5.1.2)."),
    Entry("IRWSM", "Integrated-random-walk smoother: derivatives of measured positions by fixed-interval smoothing "
          "(thesis section 5.1.2)."),
    Entry("IDIM-LS", "Least squares on the inverse dynamic model, the reference method."),
    Entry("IDIM-IV", "Instrumental variables: the regressor of a simulation serves as instrument, so that noise in the "
          "measured positions causes no bias."),
    Entry("IDIM-PIV", "IDIM-IV with a prefilter by the noise model; the default method (thesis chapter 6)."),
    Entry("DIDIM, CLIE, CLOE, SEP-PEM", "Methods that minimise an error of the closed loop: of simulated torques, of "
          "inputs, of outputs, or of predictions."),
    Entry("instruments", "Signals that follow the motion but not the measurement noise. Weak instruments follow a "
          "parameter's column of the regressor too little to determine it."),
    Entry("Durbin-Wu-Hausman test", "Compares least squares and instrumental variables: a difference beyond chance "
          "means that least squares is biased by noise."),
    Entry("Ljung-Box test", "Probability of such an autocorrelation in white noise."),
    Entry("Breusch-Pagan test", "Probability of such a variation of the residual's variance under constant variance."),
    Entry("controller", "Response of each drive from position error to torque, which closes the simulated loop. CRC: "
          "impulse response by correlation analysis; parametric: cascade or PID gains; known: as configured."),
    Entry("torque delay", "Number of samples by which the torque leads the position. A drive that reports the torque "
          "that it holds until the next sample has 0.5."),
    Entry("physically consistent", "Parameters that belong to real masses: every link has a positive mass and a "
          "positive-definite inertia with triangle inequality."),
    Entry("lost samples", "Samples of a recording that did not arrive. They are recorded as missing, never filled."),
)  # fmt: skip
"""Terms of the report of an identification."""

DIAGNOSIS_TERMS: tuple[Entry, ...] = (
    Entry("no_gap", "Verdict: no effect was found, and the residual is compatible with noise."),
    Entry("explained", "Verdict: the findings explain the gap; the remaining residual is compatible with noise."),
    Entry("partly_explained", "Verdict: there are findings, and a part of the residual stays unexplained."),
    Entry("unexplained", "Verdict: the model lacks something that no effect of the catalogue explains. In the list: a "
          "part of a joint's residual that depends on a variable, without a known effect."),
    Entry("finding", "Effect that the model lacks, with estimated parameters. Structure: a term or a correction of "
          "signals is missing. Numbers: parameters differ from the baseline."),
    Entry("gap", "Relative torque error on held-out data, percent, before and after an effect is added."),
    Entry("gap without derivative noise", "Gap with the effect's torque taken at the simulated motion. Derivatives of "
          "measured positions add noise that is no model error."),
    Entry("held out", "Data that are not used for fitting: `--validate`, or the last part of the recordings. Effects "
          "must reduce the error there."),
    Entry("training data", "Data that the models are fitted to."),
    Entry("noise floor", "Torque error that noise alone leaves: the remaining error less its unexplained part."),
    Entry("confidence", "Probability of a finding compared with all alternatives in its place. Where a part of the "
          "joint's error is unexplained, it is multiplied by the share that the finding explains of both."),
    Entry("ambiguous", "Alternatives whose likelihood is within a factor of twenty of the finding's. The next "
          "experiment separates them."),
    Entry("alternatives", "Other effects in place of a finding, with their scores."),
    Entry("score", "Gain in log-likelihood over training and held-out data; a difference of 3 is a factor of twenty."),
    Entry("p-value", "Probability that a model without the effect shows at least this evidence by chance."),
    Entry("false-alarm rate", "Probability that a diagnosis of a complete model finds anything; option "
          "`--false-alarms`, shared between all tests."),
    Entry("considered", "Effects that passed the tests but have a confidence below 0.5, in documents of former "
          "versions; they are not in the model."),
    Entry("negligible", "Effects that are significant and change the torque by less than `--material`, or the error by "
          "less than 2 %. They are no cause, and not in the model."),
    Entry("unnamed", "A regular torque without a known cause. It is a part of the model, with the variable on which it "
          "depends."),
    Entry("share of residual", "Share of the power of a joint's residual that a dependence or an effect predicts on "
          "held-out data."),
    Entry("detection limit", "Size of an effect from which nine diagnoses of ten would find it in such recordings. A "
          "smaller effect may be present without a finding."),
    Entry("not visible", "Effects that these recordings cannot show at a joint, with the reason and the required "
          "motion."),
    Entry("simulated closed loop", "Simulation of arm and controller along the reference trajectory, compared with the "
          "measured motion and torques."),
    Entry("baseline", "Earlier identification of the same arm whose parameters are tested for change."),
    Entry("changed_parameters", "Finding: parameters differ from the baseline, and no known effect explains it."),
    Entry("next experiment", "Recording that separates a finding from its alternatives, with the command that designs "
          "its trajectory."),
)  # fmt: skip
"""Terms of the report of a diagnosis."""

DEPENDENCES: tuple[Entry, ...] = (
    Entry("velocity", "Velocity of the joint: friction."),
    Entry("position", "Position of the joint: gravity, springs, cables."),
    Entry("position and direction", "Position, with the sign of the velocity: friction that varies with the position."),
    Entry("motor angle", "Angle of a motor: cogging, first gear stage, motor encoder."),
    Entry("load", "Torque that the gear transmits."),
    Entry("load and direction", "Transmitted torque, with the sign of the velocity: load-dependent friction."),
    Entry("torque", "Torque of the motor: torque constant, saturation."),
    Entry("acceleration", "Acceleration of the joint: inertia, elasticity, delay."),
    Entry("time", "Time since the beginning of the recordings: drift."),
    Entry("time and direction", "Time, with the sign of the velocity: drift of friction."),
    Entry("velocity of another joint", "Velocity of another joint: shared gears, cables, wrong geometry."),
    Entry("position of another joint", "Position of another joint: cables and hoses that it pulls, wrong geometry."),
    Entry("torque of another joint", "Torque of another joint: electrical coupling, elastic structure."),
    Entry("frequency", "A spectral line that is independent of the motion."),
    Entry("motion", "The frequencies of the motion, more than noise has there, with no single variable."),
    Entry("transients", "Short disturbances at times that are independent of the motion, in documents of former "
          "versions."),
)  # fmt: skip
"""Variables that an unexplained residual may depend on: values of ``varies_with``."""

_NAME = re.compile(r"([a-z_]+?)(m?\d+)(r?)((?:_\d+)?)$")


def effect_entries(effect: Effect) -> list[Entry]:
    """Return the entries of all linear and nonlinear parameters of an effect.

    ``effect``: entry of the catalogue. Parameters of a plug-in are explained by its description. Result: in the order
    of the effect: linear, nonlinear; of a wiring error the signals.
    """
    texts = EFFECT_PARAMETERS.get(effect.key, {})
    units = {name: ("", "") for name in texts} if isinstance(effect, Wiring) else effect.units
    return [Entry(name, texts.get(name, effect.says), unit) for name, unit in units.items()]


def base_entry(name: str) -> Entry | None:
    """Return the entry of the kind of a base parameter, for example of ``zz`` for ``zz1r``; ``None`` if unknown.

    ``name``: as in ``identification.json``; of terms of effects, too.
    """
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
    """Return the meaning of a base parameter in a few words, with its link, joint or coupling; empty if unknown.

    ``name``: as in ``identification.json``.

    Examples
    --------
    >>> in_words("my5r")
    'first moment of mass of link 5 along y, grouped'
    >>> in_words("fv3")
    'viscous friction, joint 3'
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


def meaning_of(name: str, finding: Finding) -> str:
    """Return the meaning of a parameter of a finding, as a sentence; empty if unknown.

    ``name``: parameter of the finding; ``finding``: a finding of a diagnosis.
    """
    effects = catalogue()
    effect = effects.get(f"{finding.effect}/{finding.law}" if finding.law else finding.effect)
    entries = [] if effect is None else [entry for entry in effect_entries(effect) if entry.name == name]
    return entries[0].text if entries else in_words(name)


def base_entries(names: Iterable[str]) -> list[Entry]:
    """Return the entries that explain a list of base parameters, each once, in the order of the glossary."""
    found = {entry.name: entry for entry in map(base_entry, names) if entry is not None}
    order = [entry.name for entry in RIGID]
    return sorted(found.values(), key=lambda e: order.index(e.name) if e.name in order else len(order))


def identification_entries(document: IdentificationDocument) -> list[Entry]:
    """Return the entries that a report of an identification uses."""
    tests = document.diagnostics or {}
    absent = {
        "IDIM-IV": document.method not in ("idim-iv", "idim-piv"),
        "IDIM-PIV": document.method != "idim-piv",
        "DIDIM, CLIE, CLOE, SEP-PEM": document.method in ("idim-ls", "idim-iv", "idim-piv"),
        "instruments": document.method == "idim-ls",
        "Durbin-Wu-Hausman test": not tests.get("endogeneity"),
        "Ljung-Box test": not tests,
        "Breusch-Pagan test": not tests,
        "controller": not document.controller.get("joints"),
        "torque delay": document.torque_delay_samples is None,
        "physically consistent": document.physical is None,
    }
    terms = [entry for entry in IDENTIFICATION_TERMS if not absent.get(entry.name)]
    return [*base_entries(p.name for p in document.parameters), *CONVENTIONS, *terms]


def diagnosis_entries(document: DiagnosisDocument) -> list[Entry]:
    """Return the entries that a report of a diagnosis uses: parameters of its findings, terms, variables."""
    found: dict[str, Entry] = {}
    effects = catalogue()
    for finding in document.findings:
        key = f"{finding.effect}/{finding.law}" if finding.law else finding.effect
        if key in effects:
            for entry in effect_entries(effects[key]):
                if entry.name in finding.parameters:
                    name = f"{entry.name} ({finding.effect.replace('_', ' ')})"
                    found.setdefault(name, Entry(name, entry.text, entry.units))
        else:
            found |= {entry.name: entry for entry in base_entries(finding.parameters)}
    kinds = {u.varies_with for u in document.unexplained}
    variables = [entry for entry in DEPENDENCES if any(_varies(kind, entry.name) for kind in kinds)]
    numbers = any(finding.kind == "numbers" for finding in document.findings)
    absent = {verdict: verdict != document.verdict for verdict in get_args(Verdict)} | {
        "unexplained": document.verdict != "unexplained" and not document.unexplained,
        "baseline": not numbers,
        "changed_parameters": not numbers,
        "considered": not document.considered,
        "next experiment": document.recommended_experiment is None,
        "simulated closed loop": not document.simulated,
    }
    terms = [entry for entry in DIAGNOSIS_TERMS if not absent.get(entry.name)]
    return [*found.values(), *CONVENTIONS, *terms, *variables]


def _varies(varies_with: str, kind: str) -> bool:
    """Return True if ``varies_with``, for example ``torque of joint_3``, is of a kind."""
    if kind.endswith(" of another joint"):
        return varies_with.startswith(kind.removesuffix("another joint"))
    return varies_with == kind or (kind == "motor angle" and varies_with.startswith("motor angle of "))


def markdown() -> str:
    """Return the text of ``docs/glossary.md``."""
    ours = [effect for effect in catalogue().values() if effect.key in EFFECT_PARAMETERS]
    parts = [
        "# Glossary",
        "Parameter names of robot configurations and results, and terms of the reports. Written by\n"
        "`python -m armident.identify.report.glossary`; the entries are in `identify/report/glossary.py`.",
        "## Names",
        *_list(CONVENTIONS),
        "## Rigid model and friction",
        "One of each per joint; the joint number follows the name. Section numbers are those of Brunot 2017.",
        _table(RIGID),
        "## Effects",
        "Parameters of the effects that a diagnosis looks for (`armident effects NAME`). Results append the joint\n"
        "number to linear parameters, for example `fva2`.",
    ]
    for effect in ours:
        parts += [f"### {effect.key}", f"{effect.says[0].upper()}{effect.says[1:]}.", _table(effect_entries(effect))]
    parts += ["## Identification", *_list(IDENTIFICATION_TERMS), "## Diagnosis", *_list(DIAGNOSIS_TERMS)]
    parts += ["## Variables of an unexplained residual", *_list(DEPENDENCES)]
    return "\n\n".join(parts) + "\n"


def _list(entries: Sequence[Entry]) -> list[str]:
    return ["\n".join(f"- **{entry.name}**: {entry.text}" for entry in entries)]


def _table(entries: Sequence[Entry]) -> str:
    rows = [f"| `{entry.name}` | {entry.unit.replace(' | ', ', ')} | {entry.text} |" for entry in entries]
    return "\n".join(["| parameter | unit | meaning |", "| --- | --- | --- |", *rows])


def main() -> None:
    """Write ``docs/glossary.md`` of this checkout."""
    write_atomically(Path(__file__).resolve().parents[2] / "docs" / "glossary.md", markdown())


if __name__ == "__main__":
    main()
