"""Exported models as source code without dependencies: Python and C."""

import json
import keyword
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from armident.identify.documents.base import versions
from armident.identify.documents.files import write_atomically
from armident.identify.effects.link import GravityDirection
from armident.identify.effects.parameter_change import ParameterChange
from armident.identify.effects.registry import of_entry
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.formulas import FUNCTIONS, InstantModel, instant_model
from armident.identify.model_export.rigid_effects import with_rigid_effects
from armident.identify.model_export.sheet import PARTS, LimitationSheet, limitation_sheet
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Floats

EVERY_PART = (*PARTS, "couplings", "gravity")
"""Parts of a model that code holds."""

WIDTH = 100
"""Width of a line of text in the head of a file."""

LEAST_MOTOR = 0.01
"""Least share of the mass matrix that is left to motors whose links move in their gears: with less, motor and link
swing at more than ten times the resonance of the link, too fast for the steps of a simulation."""

_TEMPLATES = Environment(
    loader=PackageLoader("armident.identify.model_export", "templates"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_TEMPLATES.filters["number"] = lambda value: repr(float(value))
_TEMPLATES.filters["quoted"] = lambda text: json.dumps(text, ensure_ascii=False)


@dataclass(frozen=True)
class Code:
    """Files of a model: identifier of the robot, variables of the templates, and what the code does not hold."""

    name: str
    content: Mapping[str, Any]
    sheet: LimitationSheet

    def render(self, template: str, **more: Any) -> str:
        """Return the text of a file. ``template``: name in ``templates``; ``**more``: further or other variables."""
        return _TEMPLATES.get_template(template).render({**self.content, **more})


def write_python(model: ExportedModel, path: Path) -> tuple[list[Path], LimitationSheet]:
    """Write a Python module that needs only ``math``; see `armident.identify.model_export.formats.Format.write`."""
    code = code_of(model, "python")
    write_atomically(path, code.render("model.py.jinja", feed_forward=False, supplement=None))
    return [path], code.sheet


def write_lerobot(model: ExportedModel, path: Path) -> tuple[list[Path], LimitationSheet]:
    """Write the Python module with feed-forward torques for actions of LeRobot, which reads no dynamic model itself."""
    code = code_of(model, "lerobot")
    remark = "LeRobot has no file for such terms: a loop that commands torques imports the module"
    write_atomically(path, code.render("model.py.jinja", feed_forward=True, supplement=None))
    return [path], replace(code.sheet, remarks=(*code.sheet.remarks, remark))


def write_c(model: ExportedModel, path: Path) -> tuple[list[Path], LimitationSheet]:
    """Write a C99 source file, with inverse and forward dynamics, and beside it a header named after the robot."""
    code = code_of(model, "c")
    header = path.with_name(f"{code.name}.h")
    write_atomically(header, code.render("model.h.jinja"))
    write_atomically(path, code.render("model.c.jinja"))
    return [path, header], code.sheet


def write_supplement(model: ExportedModel, file: Path, sheet: LimitationSheet, path: Path) -> LimitationSheet | None:
    """Write a Python module of the torques that ``file`` lacks; return its sheet with a remark, or ``None`` if none.

    Dry friction counts as lacking where the file has any part less than the rigid model: programs give it a sharp sign.
    """
    code, rigid = code_of(model, "python"), sheet.holds.issuperset(EVERY_PART)
    effects = [effect for effect in code.content["effects"] if effect["number"] not in sheet.effects]
    gears = {number: gear for number, gear in code.content["gears"].items() if number not in sheet.effects}
    if rigid and not effects and not gears:
        return None
    frames, name = with_rigid_effects(model)[0].frames, _safe(file.name)
    rotors = [joint.rotor_inertia if "rotor inertia" in sheet.holds else 0.0 for joint in model.joints]
    supplement = {
        "file": name,
        "held": [] if rigid else [(rotor, joint.viscous) for rotor, joint in zip(rotors, model.joints, strict=True)],
        "gravity": (frames.frame_0.T @ frames.gravity).tolist(),
        "links": model.arm.values(model.theta).inertial.tolist(),
    }
    title = f"Joint torques of the robot {model.robot.name} that {name} lacks."
    head = {"title": title, "lines": code.content["head"]["lines"]}
    lacking = {"supplement": supplement, "effects": effects, "gears": gears, "head": head}
    write_atomically(path, code.render("model.py.jinja", feed_forward=False, **lacking))
    # Omissions with a reason are corrections of recordings, which are no torques of the arm.
    lost = [each.part for each in sheet.omitted if each in code.sheet.omitted and not each.reason]
    instead = "" if rigid else ", with dry friction instead of that of the program"
    remark = f"{path.name} computes the torques that the file lacks{instead}{'; not: ' * bool(lost)}{'; '.join(lost)}"
    return replace(sheet, remarks=(*sheet.remarks, remark))


def code_of(model: ExportedModel, format_name: str) -> Code:
    """Return names, tables and formulas of a model. ``format_name``: format for the sheet."""
    instant = instant_model(model.arm, model.theta, model.recorded_s)
    remarks = _remarks(model, instant)
    possible = all(gear.share > 0.0 for gear in instant.gears.values())
    if format_name == "fmu" and possible:
        instant = replace(instant, gears={number: gear.of_bodies for number, gear in instant.gears.items()})
    if instant.gears and not (possible and _motors_have_inertia(model.arm, instant)):
        gears = ", ".join(model.effects[number].title for number in instant.gears)
        needed = f"{gears}: forward dynamics need an inertia of the motor (ia of the joint, rotor of the effect)"
        if format_name == "fmu" and possible:
            instant = _with_motors(model.arm, instant)
            needed += f"; {LEAST_MOTOR:.0%} of the largest inertia of the joint moves from the link to the motor"
        elif format_name == "fmu":
            instant = replace(instant, held=instant.held - set(instant.gears), gears={})
        remarks.append(needed)
    values, chain = model.arm.values(instant.theta), model.arm.chain
    friction = zip(values.ia, values.fv, values.fc, values.off, values.smoothing, strict=True)
    couplings = [
        (*joints, *three, values.smoothing[joints].min())
        for joints, three in zip(values.coupling_joints, values.coupling, strict=True)
    ]
    frames = zip(chain.cos_alpha, chain.sin_alpha, chain.d, chain.theta, chain.r, chain.prismatic, strict=True)
    effects = [
        {"number": number, "title": model.effects[number].title, "torques": list(torques.items())}
        for number, torques in sorted(instant.torques.items())
    ]
    formulas = [text for torques in instant.torques.values() for text in torques.values()]
    formulas += [each.rate for each in instant.memory] + ["expm1("] * bool(instant.memory)
    sheet = limitation_sheet(
        model,
        format_name,
        EVERY_PART,
        effects=[effect for number, effect in enumerate(model.effects) if number in instant.held],
        remarks=remarks,
    )
    name = identifier(model.robot.name)
    content = {
        "head": {"title": f"Dynamics of the robot {model.robot.name}.", "lines": _head(model, sheet)},
        "prefix": name,
        "macro": name.upper(),
        "n": model.arm.n,
        "joints": [_joint(joint.name, joint.type) for joint in model.joints],
        "gravity": instant.gravity.tolist(),
        "frames": list(frames),
        "links": values.inertial.tolist(),
        "friction": list(friction),
        "couplings": couplings,
        "effects": effects,
        "memory": instant.memory,
        "gears": instant.gears,
        "functions": sorted(
            {"atan", "cos", "pi", "sin"} | {f for f in FUNCTIONS if any(f"{f}(" in t for t in formulas)}
        ),
        "uses_hat": any("hat(" in text for text in formulas),
        "implicit": any(symbol in text for text in formulas for symbol in ("ddq[", "load[", "torque[")),
    }
    return Code(name, content, sheet)


def identifier(name: str) -> str:
    """Return a name as an identifier of Python and C. ``name``: name of a robot or joint."""
    found = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"_{found}" if not found or found[0].isdigit() or keyword.iskeyword(found) else found


def _joint(name: str, kind: str) -> dict[str, str]:
    prismatic = kind == "prismatic"
    return {"name": name, "position": "m" if prismatic else "rad", "torque": "N" if prismatic else "N m"}


def _head(model: ExportedModel, sheet: LimitationSheet) -> list[str]:
    """Return the lines at the head of a file: source of the parameters, and what the file does not hold."""
    document, recording = model.document, model.document.recording
    recorded = f"{Path(recording.path or '(from the stream)').name}, SHA-256 {recording.sha256}"
    lines = [
        f"Written by armident {versions().get('armident', '')} from {model.source.name}.",
        f"Parameters: method {document.method}, torque error {document.relative_error_pct:.2f} %, verdict "
        f"{document.verdict or 'not judged'}, made physically consistent. Recording: {recorded}.",
        f"Physical consistency of the estimate: {model.consistent.verdict}.",
        *(f"Not in this file: {o.part}. {o.reason}".strip() for o in sheet.omitted),
    ]
    if sheet.undetermined:
        lines.append(f"Not determined alone by the recordings: {', '.join(sheet.undetermined)}.")
    return [part for line in lines for part in wrap(_safe(line), WIDTH)]


def _safe(line: str) -> str:
    """Return a line that ends neither a comment of C nor a string of Python."""
    return line.replace("*/", "* /").replace("\\", "/").replace('"', "'")


def _masses(arm: ArmModel, instant: InstantModel) -> tuple[Floats, Floats]:
    """Return the mass matrices (P, n, n) of the arm and of its links alone over the workspace."""
    still = np.zeros((1, arm.n))
    theta, postures = instant.theta, arm.motion(still, still, still, dt=1.0).postures
    return arm.mass_matrix(theta, postures), arm.mass_matrix(np.where(arm.of_links, theta, 0.0), postures)


def _with_motors(arm: ArmModel, instant: InstantModel) -> InstantModel:
    """Return the model with `LEAST_MOTOR` of the inertia of each elastic or loose joint in its motor."""
    mass, gears = _masses(arm, instant)[0], {}
    for number, gear in instant.gears.items():
        least = LEAST_MOTOR * float(mass[:, gear.joint, gear.joint].max())
        gears[number] = gear._replace(rotor=max(gear.rotor, least))
    return replace(instant, gears=gears)


def _motors_have_inertia(arm: ArmModel, instant: InstantModel) -> bool:
    """Return True if links that move in their gears leave `LEAST_MOTOR` of the mass matrix to the motors."""
    mass, links = _masses(arm, instant)
    left = mass.copy()
    for gear in instant.gears.values():
        felt = links[:, gear.joint] - gear.rotor * np.eye(arm.n)[gear.joint]
        share = gear.share / np.maximum(felt[:, gear.joint], gear.least)
        left -= share[:, None, None] * felt[:, :, None] * felt[:, None, :]
    return bool(np.linalg.eigvals(np.linalg.solve(mass, left)).real.min() >= LEAST_MOTOR)


def _remarks(model: ExportedModel, instant: InstantModel) -> list[str]:
    """Return a remark on effects that see other torques in the code than in the model."""
    held = [of_entry(entry) for k, entry in enumerate(model.robot.effects) if k in instant.held]
    changes = [effect.title for effect in held if isinstance(effect, ParameterChange | GravityDirection)]
    dependent = [effect.title for effect in held if effect.depends_on_torque]
    others = [title for title in dependent if [title] != changes]
    if changes and others:
        return [f"{', '.join(others)}: computed from torques that include {', '.join(changes)}, unlike in the model"]
    return []
