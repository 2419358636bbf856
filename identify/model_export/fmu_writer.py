"""Exported models as functional mock-up units: FMI 2.0 for Co-Simulation, torques in, motion out."""

import platform
import shutil
import subprocess
import tempfile
import uuid
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from armident.configs import ConfigError
from armident.identify.model_export.code_writer import code_of
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.sheet import LimitationSheet

TOLERANCE = 1e-8
"""Relative and absolute tolerance of the integration, unless the experiment gives another one."""

GEAR_STEP_S = 1e-4
"""Period at which links advance in elastic or loose gears, s. Two masses then move as in steps of 2 us to 0.1 % (15 Hz)
and 1 % (gap of 2 mm), if the motor has 5 % of the inertia; at 1 ms it is 1 % and 12 %."""

OPTIONS = ("-std=c99", "-O3", "-fno-math-errno", "-fno-semantic-interposition", "-fPIC", "-shared")
"""Options of the compiler."""

MACHINE = ("Linux", "x86_64")
"""System and machine for which FMI 2.0 has the folder ``linux64``."""

EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of the files inside, so that equal models give equal files."""


@dataclass(frozen=True)
class Variable:
    """Variable of ``modelDescription.xml``; ``initial`` may be empty; ``start``: ``None`` if computed."""

    name: str
    causality: str
    initial: str
    unit: str
    description: str
    start: float | None


def write_fmu(model: ExportedModel, path: Path) -> tuple[list[Path], LimitationSheet]:
    """Write an FMU for 64-bit Linux with its sources; ConfigError without a C compiler or on another machine."""
    code, variables = code_of(model, "fmu"), variables_of(model)
    source = code.render("model.c.jinja")
    start = [variable.start or 0.0 for variable in variables[model.arm.n : 2 * model.arm.n]]
    interface = {
        "guid": f"{{{uuid.uuid5(uuid.NAMESPACE_URL, source)}}}",
        "tolerance": TOLERANCE,
        "period": GEAR_STEP_S if code.content["gears"] else 1e-3,
        "start": start,
        "variables": variables,
        "outputs": [k for k, v in enumerate(variables, start=1) if v.causality == "output"],
        "calculated": [k for k, v in enumerate(variables, start=1) if v.initial == "calculated"],
    }
    sources = {
        f"{code.name}.c": source,
        f"{code.name}.h": code.render("model.h.jinja"),
        "fmu.c": code.render("fmu.c.jinja", **interface),
    }
    library = shared_library(sources, code.name)
    contents: dict[str, str | bytes] = {
        "modelDescription.xml": code.render("modelDescription.xml.jinja", **interface),
        f"binaries/linux64/{code.name}.so": library,
        "documentation/limits.md": code.sheet.markdown(f"{model.robot.name} as FMU"),
        **{f"sources/{name}": text for name, text in sources.items()},
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(zipfile.ZipInfo(name, EPOCH), content, zipfile.ZIP_DEFLATED)
    return [path], code.sheet


def variables_of(model: ExportedModel) -> list[Variable]:
    """Return torques and motion of the joints; they start at zero, or in the middle of limits that exclude zero."""
    kinds = (
        ("tau", "input", "", ("N.m", "N"), "torque or force of {}, held during a communication step"),
        ("q", "output", "exact", ("rad", "m"), "position of {}"),
        ("dq", "output", "exact", ("rad/s", "m/s"), "velocity of {}"),
        ("ddq", "output", "calculated", ("rad/s2", "m/s2"), "acceleration of {}"),
    )
    found = []
    for name, causality, initial, units, description in kinds:
        for k, joint in enumerate(model.joints):
            low, high = model.position_limits(k) or (0.0, 0.0)
            start = 0.0 if name != "q" or low <= 0.0 <= high else (low + high) / 2
            found.append(
                Variable(
                    f"{name}_{joint.name}",
                    causality,
                    initial,
                    units[joint.type == "prismatic"],
                    description.format(joint.name),
                    None if initial == "calculated" else start,
                )
            )
    return found


def shared_library(sources: dict[str, str], name: str) -> bytes:
    """Compile C sources by file name to a shared library; ConfigError without compiler or 64-bit Linux."""
    if (platform.system(), platform.machine()) != MACHINE:
        raise ConfigError(f"--format fmu: needs {' '.join(MACHINE)}; on other machines use --format c")
    with tempfile.TemporaryDirectory() as folder:
        try:
            return compiled(sources, Path(folder), f"{name}.so", OPTIONS).read_bytes()
        except ConfigError as error:
            raise ConfigError(f"--format fmu: {error}, or use --format c") from error


def compiled(sources: dict[str, str], folder: Path, name: str, options: Sequence[str]) -> Path:
    """Compile C sources by file name in a folder; return the file; ConfigError without compiler, or if it fails."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise ConfigError("needs a C compiler: install gcc")
    for file, text in sources.items():
        (folder / file).write_text(text, encoding="utf-8")
    files = [file for file in sources if file.endswith(".c")]
    command = [compiler, *options, *files, "-o", name, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        first = next((line for line in done.stderr.splitlines() if "error" in line), "no message")
        raise ConfigError(f"{compiler} fails: {first}")
    return folder / name
