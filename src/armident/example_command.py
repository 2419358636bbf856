"""Command ``armident example``: copy a worked example into the working directory."""

from pathlib import Path
from typing import Annotated

import typer

EXAMPLES = Path(__file__).parent / "configs" / "examples"
"""Folder of the worked examples, one folder each."""


def _names() -> list[str]:
    return sorted(folder.name for folder in EXAMPLES.iterdir() if (folder / "README.md").is_file())


def example(
    name: Annotated[
        str | None, typer.Argument(help="Name of the example; without it they are listed.", autocompletion=_names)
    ] = None,
) -> None:
    """Copy a worked example into a new folder of its name, or list the examples.

    Each one has a README.md with the commands to run in its folder.

    Example: armident example mujoco
    """
    import shutil

    from armident.configs import ConfigError

    if name is None:
        for one in _names():
            title = (EXAMPLES / one / "README.md").read_text(encoding="utf-8").splitlines()[0]
            typer.echo(f"{one:<18}{title.removeprefix('# ')}")
        return
    if name not in _names():
        raise ConfigError(f"{name}: no such example; there are {', '.join(_names())}")
    try:
        shutil.copytree(EXAMPLES / name, name, ignore=shutil.ignore_patterns("__pycache__"))
    except FileExistsError as error:
        raise ConfigError(f"{name}: this folder exists; remove it, or work in another one") from error
    except OSError as error:
        raise ConfigError(f"{name}: {error.strerror or error}: work in a folder that you may write to") from error
    typer.echo(f"{Path(name)}: {', '.join(sorted(file.name for file in Path(name).iterdir()))}")
    typer.echo(f"next: cd {name} and read README.md")
