"""The model with some of its base parameters only: those that are essential for the data at hand (thesis B.2)."""

from collections.abc import Collection
from dataclasses import replace

from armident.configs import ConfigError
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import columns_of


def restricted_to(model: ArmModel, names: Collection[str]) -> ArmModel:
    """The same arm with the base parameters ``names`` only, the others being zero.

    Regressor, dynamics and simulation then speak of these parameters alone, in the order of the full model; terms of
    the model are left out.

    Parameters
    ----------
    names
        Base parameters to keep.

    Raises
    ------
    ConfigError
        If the model has no base parameter of such a name.
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
