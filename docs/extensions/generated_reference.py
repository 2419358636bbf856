"""Sphinx extension: writes the reference of commands, documents, configuration files and terms from the code."""

import importlib.metadata
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
import typer
from sphinx.application import Sphinx

from armident.configs.schema.base import split_docstring
from armident.configs.schema.robot import RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.session import SessionConfig
from armident.configs.schema.trajectory import Trajectory
from armident.daq.cli import GROUP, application
from armident.daq.interchange.readers import table_of_formats
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.registry import own_effects
from armident.identify.estimators.methods import METHODS, estimator
from armident.identify.report import glossary

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
    """Write the generated pages of `reference/`, if their text has changed.

    Parameters
    ----------
    app
        The Sphinx application.
    """
    folder = Path(app.srcdir) / "reference"
    pages = {
        "commands.md": commands_page, "files.md": files_page, "formats.md": formats_page, "glossary.md": glossary_page,
    }  # fmt: skip
    for name, page in pages.items():
        text = page()
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
    descriptions = split_docstring(Criteria.__doc__ or "")[1]
    rows = [f"| `{f.name}` | {f.default:.4g} | {descriptions[f.name]} |" for f in fields(Criteria)]
    rows = ["| threshold | value | meaning, with source or reckoning |", "| --- | --- | --- |", *rows]
    sections.append("## Criteria of a diagnosis\n\n" + "\n".join(rows).replace("``", "`"))
    return "\n\n".join(sections) + "\n"


def glossary_page() -> str:
    """Return the glossary of parameter names and report terms."""
    parts = [
        "# Glossary",
        "Parameter names of robot configurations and results, and terms of the reports. Every report has those that it "
        "mentions. The keys of the documents are in [files](files.md).",
        "## Names",
        listed(glossary.CONVENTIONS),
        "## Rigid model and friction",
        "One of each per joint; the joint number follows the name. Section numbers are those of Brunot 2017.",
        parameter_table(glossary.RIGID),
        "## Effects",
        "Parameters of the effects that a diagnosis looks for (`armident effects NAME`). Results append the joint "
        "number to linear parameters, for example `fva2`.",
    ]
    for effect in own_effects():
        text = f"{effect.description[0].upper()}{effect.description[1:]}."
        parts += [f"### {effect.key}", text, parameter_table(glossary.effect_entries(effect))]
    rows = [f"| {m.upper()} | {estimator(m).source} | {estimator(m).meaning} |" for m in METHODS]
    rows = ["| method | section of Brunot 2017 (equations) | meaning |", "| --- | --- | --- |", *rows]
    parts += ["## Methods", "\n".join(rows)]
    parts += ["## Tests and verdicts", listed([*glossary.TERMS, *glossary.verdict_entries()])]
    parts += ["## Variables of an unexplained residual", listed(glossary.variable_entries())]
    return "\n\n".join(parts) + "\n"


def listed(entries: Iterable[glossary.GlossaryEntry]) -> str:
    """Return a Markdown list of entries."""
    return "\n".join(f"- **{entry.name}**: {entry.text}" for entry in entries)


def parameter_table(entries: Iterable[glossary.GlossaryEntry]) -> str:
    """Return the Markdown table of parameters."""
    text = {entry: entry.text.replace("|", chr(92) + "|") for entry in entries}
    rows = [f"| `{entry.name}` | {entry.unit.replace(' | ', ', ')} | {text[entry]} |" for entry in text]
    return "\n".join(["| parameter | unit | meaning |", "| --- | --- | --- |", *rows])


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
