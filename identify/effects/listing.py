"""Command ``armident effects``: the effects of the catalogue as a table or as JSON."""

import json
import sys
from typing import Any

from armident.identify.effects.effect import Effect, Linear, Shape
from armident.identify.effects.registry import catalogue, known

ALWAYS: tuple[tuple[str, str, str], ...] = (
    ("viscous friction", "fv<joint> (N m s/rad, N s/m)", "in every model"),
    ("Coulomb friction", "fc<joint> (N m, N)", "in every model, with the smoothing of `friction.sign_smoothing`"),
    ("constant offset", "off<joint> (N m, N)", "in every model"),
    ("rotor inertia", "ia<joint> (kg m^2, kg)", "where `joints[].rotor_inertia` is true"),
    ("coupling of two joints", "ia<name>, fv<name>, fc<name>", "for every entry of `couplings`"),
)
"""Terms with a key of their own in the robot configuration: name, parameters, condition."""


def effect_json(effect: Effect) -> dict[str, Any]:
    """Return the entry of ``armident effects --json`` of an effect."""
    return {
        "name": effect.name,
        "law": effect.law,
        "title": effect.title,
        "description": effect.description,
        "scope": effect.scope,
        "parameters": [
            {
                "name": p.name,
                "unit": list(p.unit),
                "meaning": p.meaning,
                "sign": p.sign,
                "requires": p.requires,
                "absorbs": p.absorbs or None,
            }
            for p in effect.linear
        ],
        "nonlinear_parameters": [
            {"name": s.name, "unit": list(s.unit), "meaning": s.meaning, "continuous": list(s.continuous)}
            for s in effect.shapes
        ],
        "required_motion": effect.required_motion,
        "reference": effect.reference,
    }


def effects_command(name: str | None, *, as_json: bool) -> None:
    """Print the effects of the catalogue, or the one named; ConfigError if there is no such effect."""
    chosen = list(catalogue().values()) if name is None else [known(name)]
    if as_json:
        sys.stdout.write(json.dumps([effect_json(effect) for effect in chosen], indent=1) + "\n")
        return
    if name is not None:
        _one(chosen[0])
        return
    from rich.table import Table

    from armident.identify.cli.print_table import print_table

    table = Table(title="effects", title_justify="left")
    for heading in ("effect", "title", "parameters", "scope"):
        table.add_column(heading)
    for effect in chosen:
        table.add_row(effect.key, effect.title, ", ".join(map(_with_unit, effect.parameters_of_entry)), effect.scope)
    print_table(table)
    print("terms with a key of their own in the robot configuration:")
    for title, parameters, when in ALWAYS:
        print(f"  {title}: {parameters}; {when}")


def _one(effect: Effect) -> None:
    print(f"{effect.key}: {effect.title}\n{effect.description}")
    for parameter in effect.parameters_of_entry:
        print(f"  {_with_unit(parameter)}: {parameter.meaning}" if parameter.meaning else f"  {_with_unit(parameter)}")
    for linear in effect.linear:
        if linear.requires is not None:
            print(f"{linear.name} requires {linear.requires} and absorbs {linear.absorbs} of the joint;")
            print(f"  `without: [{linear.name}]` in the configuration keeps {linear.absorbs}")
    print(f"required motion: {effect.required_motion}")
    if effect.direct_evidence:
        print(f"shown directly by: {effect.direct_evidence}")
    print(f"source: {effect.reference}")
    values = [f"{p.name}: ..." for p in effect.parameters_of_entry]
    law = f", law: {effect.law}" if effect.law else ""
    other = ", other: joint_2" if effect.two_joints else ""
    place = f"effect: {effect.name}{law}, joint: joint_1{other}"
    print(f"configuration: {{{place}, parameters: {{{', '.join(values)}}}}}")


def _with_unit(parameter: Linear | Shape) -> str:
    unit = " | ".join(dict.fromkeys(u for u in parameter.unit if u))
    return f"{parameter.name} ({unit})" if unit else parameter.name
