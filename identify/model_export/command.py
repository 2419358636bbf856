"""Command ``armident export-model``."""

from pathlib import Path
from typing import Annotated

import typer


def export_model(
    result: Annotated[Path, typer.Argument(help="identification.json, diagnosis.json, or the folder of one of them.")],
    format_name: Annotated[
        str,
        typer.Option(
            "--format", help="urdf, mjcf, sdf, pinocchio, python, c, csv, fmu, drives or lerobot.", show_default=False
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="File or folder to write. [default: the folder of RESULT]")
    ] = None,
    robot: Annotated[
        Path | None,
        typer.Option("--config", "--robot", help="Configuration that was identified. [default: the one inside RESULT]"),
    ] = None,
    urdf: Annotated[
        Path | None,
        typer.Option(
            "--urdf",
            help="URDF of the arm: its link frames and names are used, and its copy keeps meshes and limits. "
            "[default: the one that --config names]",
        ),
    ] = None,
    nearest: Annotated[
        bool,
        typer.Option(
            "--nearest", help="Write the nearest physical arm although the estimate differs from it significantly."
        ),
    ] = False,
    verify: Annotated[
        Path | None,
        typer.Option(
            "--verify",
            help="Recording or trajectory along which the program that reads the file computes its torques. "
            "[default: a motion within the identified range]",
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print files and limits as one JSON document.")] = False,
) -> None:
    """Write an identified model for a simulator or a controller, with a sheet of what the format cannot hold.

    The sheet states by how much the torques of the file differ from those of the model, in the program that reads it.

    The parameters in the file belong to a physical arm. A result that no physical arm has is refused with exit code 3.

    Example: armident export-model tx40.identification --format mjcf --out tx40.xml

    URDF with meshes: armident export-model arm.identification --format urdf --config arm.yaml
    """
    import sys
    from json import dumps

    from armident.identify.cli.progress import progress
    from armident.identify.model_export.exported_model import load_exported_model
    from armident.identify.model_export.formats import check_format
    from armident.identify.model_export.formats import export_model as write
    from armident.identify.model_export.verification import motion_of

    check_format(format_name)
    with progress(f"export-model {result.name}") as report:
        model = load_exported_model(result, robot, urdf, nearest=nearest, progress=report)
        motion = motion_of(model, verify)
        files, sheet = write(model, format_name, out or model.source.parent, motion)
    if json:
        sys.stdout.write(dumps({"files": [str(file) for file in files], **sheet.document()}, indent=1) + "\n")
        return
    print("\n".join(sheet.lines()))
    for file in files:
        print(f"written: {file}")
