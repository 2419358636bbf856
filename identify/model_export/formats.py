"""Formats of an exported model, and the export itself."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from armident.configs import ConfigError
from armident.identify.documents.files import write_atomically
from armident.identify.model_export.code_writer import write_c, write_lerobot, write_python, write_supplement
from armident.identify.model_export.consumers import GivenMotion
from armident.identify.model_export.csv_writer import write_csv
from armident.identify.model_export.drives_writer import write_drives
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.fmu_writer import write_fmu
from armident.identify.model_export.mjcf_writer import write_mjcf
from armident.identify.model_export.pinocchio_writer import write_pinocchio
from armident.identify.model_export.sdf_writer import write_sdf
from armident.identify.model_export.sheet import LimitationSheet
from armident.identify.model_export.urdf_writer import write_urdf
from armident.identify.model_export.verification import RUNNERS, measure, motion_of


@dataclass(frozen=True)
class Format:
    """A format of exported models; ``write`` returns all files, the main one first, and the sheet.

    ``along_motion``: it also takes the motion whose torques the file holds.
    """

    suffix: str
    title: str
    write: Callable[..., tuple[list[Path], LimitationSheet]]
    along_motion: bool = False


FORMATS: dict[str, Format] = {
    "urdf": Format(".urdf", "URDF", write_urdf),
    "mjcf": Format(".xml", "MJCF (MuJoCo)", write_mjcf),
    "sdf": Format(".sdf", "SDFormat (Gazebo, Drake)", write_sdf),
    "python": Format(".py", "Python module", write_python),
    "c": Format(".c", "C source", write_c),
    "csv": Format(".csv", "table of parameters", write_csv),
    "fmu": Format(".fmu", "FMU (FMI 2.0 for Co-Simulation)", write_fmu),
    "lerobot": Format("_lerobot.py", "Python module for LeRobot", write_lerobot),
    "drives": Format("_drives.csv", "feed-forward terms of the drives", write_drives, along_motion=True),
    "pinocchio": Format(".pinocchio.xml", "Pinocchio model", write_pinocchio),
}
"""Formats by name."""


def check_format(format_name: str) -> None:
    """Raise ConfigError, with the names of all formats, if a format does not exist."""
    if format_name not in FORMATS:
        raise ConfigError(f"--format: {format_name!r} is not one of {', '.join(FORMATS)}")


def export_model(
    model: ExportedModel, format_name: str, out: Path, motion: GivenMotion | None = None
) -> tuple[list[Path], LimitationSheet]:
    """Write a model in a format, and the sheet of its limits beside it; return the files, sheet last, and the sheet.

    ``out``: main file, or a folder in which it is named after the robot. ``motion``: motion along which the torques of
    the file are measured by the program that reads it, if one does; ``None``: they are not measured.
    """
    check_format(format_name)
    chosen = FORMATS[format_name]
    main = out / f"{model.robot.name}{chosen.suffix}" if out.is_dir() or not out.suffix else out
    sources = [model.source, *([] if model.source_urdf is None else [model.source_urdf.file])]
    if main.resolve() in [file.resolve() for file in sources]:
        raise ConfigError(f"--out {main}: would overwrite what the model is read from: give another file")
    try:
        main.parent.mkdir(parents=True, exist_ok=True)
        further = (motion or motion_of(model),) if chosen.along_motion else ()
        files, sheet = chosen.write(model, main, *further)
        stem = main.name.removesuffix(chosen.suffix).removesuffix(main.suffix)
        supplement = main.with_name(f"{stem}_{format_name}_supplement.py")
        lacks = sheet.omitted and format_name != "fmu"  # a plant: no program adds torques to it
        completed = write_supplement(model, files[0], sheet, supplement) if lacks else None
        if completed is not None:
            files, sheet = [*files, supplement], completed
        if motion is not None and format_name in RUNNERS:
            sheet = replace(sheet, measured=measure(model, format_name, files, motion))
        page = main.with_name(f"{stem}_{format_name}_limits.md")
        write_atomically(page, sheet.markdown(f"{model.robot.name} as {chosen.title}"))
    except OSError as error:
        raise ConfigError(f"{main}: cannot be written: {error.strerror or 'output error'}") from error
    return [*files, page], sheet
