"""Sphinx extension: writes the reference of commands, documents and configuration files from the code."""

import importlib.metadata
from pathlib import Path
from typing import Any

import click
import typer
from sphinx.application import Sphinx

from armident.configs.schema.robot import RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.session import SessionConfig
from armident.configs.schema.trajectory import Trajectory
from armident.daq.cli import GROUP, application
from armident.daq.interchange.readers import table_of_formats
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.identification import IdentificationDocument

Schema = dict[str, Any]

FILES = {
    "identification.json": IdentificationDocument,
    "diagnosis.json": DiagnosisDocument,
    "Robot": RobotConfig,
    "Session": SessionConfig,
    "Trajectory": Trajectory,
    "Scenario": Scenario,
}
"""Documents and configuration files by the heading of their section."""


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension.

    Parameters
    ----------
    app
        The Sphinx application.
    """
    app.connect("builder-inited", write_reference)
    return {"parallel_read_safe": True}


def write_reference(app: Sphinx) -> None:
    """Write `reference/commands.md`, `files.md` and `formats.md` into the source folder, if their text has changed.

    Parameters
    ----------
    app
        The Sphinx application.
    """
    folder = Path(app.srcdir) / "reference"
    for name, text in (("commands.md", commands_page()), ("files.md", files_page()), ("formats.md", formats_page())):
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def commands_page() -> str:
    """Return the reference of all commands, from the help texts."""
    group = typer.main.get_command(application(()))
    names = sorted(entry.name for entry in importlib.metadata.entry_points(group=GROUP))
    sections = ["# Commands", "`armident COMMAND --help` prints the same."]
    context = click.Context(group, info_name="armident")
    for name in names:
        command = group.get_command(context, name)  # type: ignore[attr-defined]
        help_text = command.get_help(type(context)(command, parent=context, info_name=name, terminal_width=100))
        sections.append(f"## {name}\n\n```text\n{help_text.strip()}\n```")
    return "\n\n".join(sections) + "\n"


def formats_page() -> str:
    """Return the reference of the files of other tools, from their readers."""
    return f"# Formats\n\n`armident import` reads, and `armident export` writes:\n\n{table_of_formats()}\n"


def files_page() -> str:
    """Return the reference of all documents and configuration files, from their JSON Schemas."""
    sections = [
        "# Files",
        "Keys of the result documents and of the configuration files. The result documents have JSON Schemas in "
        "`configs/json_schemas/`. Parts that several keys share have a table of their own.",
    ]
    for heading, model in FILES.items():
        schema = model.model_json_schema(by_alias=True)
        sections.append(f"## {heading}\n\n{schema['description']}\n\n{table(schema)}")
        sections += [
            f"### {heading}: {name}\n\n{part['description']}\n\n{table(part)}"
            for name, part in sorted(schema.get("$defs", {}).items())
        ]
    return "\n\n".join(sections) + "\n"


def table(schema: Schema) -> str:
    """Return the Markdown table of the fields of an object.

    Parameters
    ----------
    schema
        JSON Schema of the object.
    """
    required = schema.get("required", [])
    rows = ["| key | type | meaning |", "| --- | --- | --- |"]
    for name, field in schema.get("properties", {}).items():
        kind = type_name(field) + ("" if name in required else ", optional")
        rows.append(f"| `{name}` | {kind} | {field['description'].replace('``', '`').replace('|', chr(92) + '|')} |")
    return "\n".join(rows)


def type_name(field: Schema) -> str:
    """Return the type of a field in words.

    Parameters
    ----------
    field
        JSON Schema of the field.
    """
    if "$ref" in field:
        return str(field["$ref"].rsplit("/", 1)[1])
    if "const" in field:
        return f"`{field['const']}`"
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(type_name(option) for option in field["anyOf"]))
    if field.get("type") == "array":
        items = field.get("items") or next(iter(field.get("prefixItems", [])), {})
        return f"list of {type_name(items)}" if items else "list"
    if field.get("type") == "object":
        values = field.get("additionalProperties")
        return f"mapping to {type_name(values)}" if isinstance(values, dict) and values else "mapping"
    return str(field.get("type", "any"))
