"""Command ``armident effects``: the effects of the catalogue as a table or as JSON."""

import json
import sys
from typing import Any

from armident.identify.effects.effect import Effect
from armident.identify.effects.registry import catalogue, known

ALWAYS: tuple[tuple[str, str, str], ...] = (
    ("viscous friction", "fv<joint> (N m s/rad, N s/m)", "in every model"),
    ("Coulomb friction", "fc<joint> (N m, N)", "in every model, with the smoothing of `friction.sign_smoothing`"),
    ("constant offset", "off<joint> (N m, N)", "in every model"),
    ("rotor inertia", "ia<joint> (kg m^2, kg)", "where `joints[].rotor_inertia` is true"),
    ("coupling of two joints", "ia<name>, fv<name>, fc<name>", "for every entry of `couplings`"),
)
"""Terms with a key of their own in the robot configuration: name, parameters, condition."""

FORMER_KEYS = {"says": "description", "shapes": "nonlinear_parameters", "needs": "required_motion"}
"""Keys of ``armident effects --json`` up to version 0.1 and their new names; both are printed for one release."""


def described(effect: Effect) -> dict[str, Any]:
    """Return the entry of ``armident effects --json`` of an effect."""
    entry = {
        "name": effect.name,
        "law": effect.law,
        "title": effect.title,
        "description": effect.says,
        "scope": effect.scope,
        "parameters": [
            {
                "name": p.name,
                "unit": list(p.unit),
                "sign": p.sign,
                "requires": p.requires,
                "absorbs": p.absorbs or None,
                # Former names, printed for one release.
                "through": p.requires,
                "replaces": p.absorbs or None,
            }
            for p in effect.linear
        ],
        "nonlinear_parameters": [
            {"name": s.name, "unit": list(s.unit), "continuous": list(s.continuous)} for s in effect.shapes
        ],
        "required_motion": effect.needs,
        "reference": effect.reference,
    }
    return entry | {old: entry[new] for old, new in FORMER_KEYS.items()}


def effects_command(name: str | None, *, as_json: bool) -> None:
    """Print the effects of the catalogue.

    ``name``: name of one effect; ``None``: all. ``as_json``: print JSON instead of a table. Raises ConfigError if there
    is no such effect.
    """
    chosen = list(catalogue().values()) if name is None else [known(name)]
    if as_json:
        sys.stdout.write(json.dumps([described(effect) for effect in chosen], indent=1) + "\n")
        return
    if name is not None:
        _one(chosen[0])
        return
    from rich.table import Table

    from armident.identify.print_table import print_table

    table = Table(title="effects", title_justify="left")
    for heading in ("effect", "title", "parameters", "scope"):
        table.add_column(heading)
    for effect in chosen:
        table.add_row(effect.key, effect.title, ", ".join(_parameters(effect)), effect.scope)
    print_table(table)
    print("terms with a key of their own in the robot configuration:")
    for title, parameters, when in ALWAYS:
        print(f"  {title}: {parameters}; {when}")


def _one(effect: Effect) -> None:
    print(f"{effect.key}: {effect.title}\n{effect.says}")
    for parameter in _parameters(effect):
        print(f"  {parameter}")
    for linear in effect.linear:
        if linear.requires is not None:
            print(f"{linear.name} requires {linear.requires} and absorbs {linear.absorbs} of the joint;")
            print(f"  `without: [{linear.name}]` in the configuration keeps {linear.absorbs}")
    print(f"required motion: {effect.needs}\nsource: {effect.reference}")
    names = [shape.name for shape in effect.shapes] + [parameter.name for parameter in effect.linear]
    values = [f"{parameter}: ..." for parameter in names]
    law = f", law: {effect.law}" if effect.law else ""
    other = ", other: joint_2" if effect.two_joints else ""
    place = f"effect: {effect.name}{law}, joint: joint_1{other}"
    print(f"configuration: {{{place}, parameters: {{{', '.join(values)}}}}}")


def _parameters(effect: Effect) -> list[str]:
    return [
        f"{name} ({' | '.join(dict.fromkeys(u for u in unit if u))})" if any(unit) else name
        for name, unit in effect.units.items()
    ]
