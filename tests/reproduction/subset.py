"""Arm model reduced to its essential base parameters, those that the data determine (thesis section B.2)."""

from collections.abc import Collection
from dataclasses import replace

from armident.configs import ConfigError
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import columns_of


def restricted_to(model: ArmModel, names: Collection[str]) -> ArmModel:
    """Return the model with the base parameters ``names`` only; the others are zero.

    Regressor, dynamics and simulation of the result use these parameters alone, in the order of the full model. The
    result has no additional terms.

    ``model``: the full model; ``names``: names of the base parameters to keep. Raises ConfigError if ``names`` contains
    a name that is not a base parameter of the model.
    """
    model = model.without_terms()
    base = model.base
    unknown = sorted(set(names) - set(base.names))
    if unknown:
        raise ConfigError(f"{model.robot.name} has no base parameter {', '.join(unknown)}")
    kept = [k for k, name in enumerate(base.names) if name in names]
    chosen = tuple(base.names[k] for k in kept)
    independent = base.independent[kept]
    return replace(
        model,
        base=replace(
            base,
            names=chosen,
            independent=independent,
            regroup=base.regroup[kept],
            formulas={name: base.formulas[name] for name in chosen},
        ),
        base_columns=columns_of(model.robot, tuple(model.names[k] for k in independent)),
    )
