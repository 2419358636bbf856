"""All effects that can be hidden in the virtual arm; each is specified beside its physics."""

import math

from armident.virtual_robot.effects import bodies, bristles, forces, gears, signals
from armident.virtual_robot.effects.spec import EffectSpec, Group, ParameterSpec

EFFECTS: dict[str, EffectSpec] = forces.EFFECTS | bristles.EFFECTS | gears.EFFECTS | bodies.EFFECTS | signals.EFFECTS
"""All effects by name."""

GROUPS: dict[str, Group] = {
    "Catalogue": "catalogue",
    "Outside the catalogue": "outside",
    "Changed parameters": "parameters",
}
"""Headings of the groups of effects."""


def of_group(group: Group) -> dict[str, EffectSpec]:
    """Return the effects of a group by name."""
    return {name: effect for name, effect in EFFECTS.items() if effect.group == group}


CATALOGUE, OUTSIDE = of_group("catalogue"), of_group("outside")
"""Effects that ``armident diagnose`` can find by name, and those that it must report as unexplained."""


def describe_effects() -> str:
    """Text table of all effects with their parameters, units, defaults and ranges."""
    lines = []
    for title, group in GROUPS.items():
        lines += [title, ""]
        for name, effect in of_group(group).items():
            second = {"none": "", "optional": " [other: joint]", "required": " other: joint"}[effect.other]
            lines.append(f"  {name}{second}: {effect.meaning}")
            lines += [f"      {key} ({p.unit}): {p.meaning}{_limits(p)}" for key, p in effect.parameters.items()]
        lines.append("")
    lines.append("Joint side, SI; at a prismatic joint N for N m and m for rad.")
    return "\n".join(lines)


def _limits(p: ParameterSpec) -> str:
    default = "required" if p.default is None else "from the robot" if math.isnan(p.default) else f"{p.default:g}"
    low = "" if math.isinf(p.low) else f"{'above' if p.above else 'from'} {p.low:g}"
    high = "" if math.isinf(p.high) else f"to {p.high:g}"
    bounds = " ".join(part for part in (low, high) if part)
    return f" [{'; '.join(part for part in (default, bounds, p.only and f'{p.only} only') if part)}]"
