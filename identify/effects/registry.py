"""Registry of all effects: those of this package and those of plug-ins."""

from functools import cache
from importlib.metadata import entry_points
from inspect import isabstract
from types import ModuleType
from typing import TypeGuard

from armident.configs import ConfigError
from armident.configs.schema.robot import Effect as Entry
from armident.identify.effects import drive, friction, link, parameter_change, transmission, unnamed, wiring
from armident.identify.effects.effect import Effect

ENTRY_POINTS = "armident.effects"
"""Entry-point group of plug-ins: each entry names a subclass of `Effect`, an instance, or a sequence of them."""

REQUIRED = ("name", "title", "description", "reference", "required_motion", "linear")
"""Attributes without a usual value."""


def own_effects() -> list[Effect]:
    """Return the effects of this package: the classes with a title, of one key the last."""
    modules = (friction, link, transmission, drive, parameter_change, wiring, unnamed)
    classes = [each for module in modules for each in vars(module).values() if _of_module(each, module)]
    return list({effect.key: effect for effect in (each() for each in classes)}.values())


def _of_module(each: object, module: ModuleType) -> TypeGuard[type[Effect]]:
    return (
        isinstance(each, type)
        and issubclass(each, Effect)
        and each.__module__ == module.__name__
        and hasattr(each, "title")
        and not isabstract(each)
    )


@cache
def catalogue() -> dict[str, Effect]:
    """Return all effects by name, those of this package first; ConfigError if an entry point is faulty."""
    found = {effect.key: effect for effect in own_effects()}
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda p: p.name):
        where = f"effect {point.name} ({point.value})"
        try:
            loaded = point.load()
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"{where}: cannot be loaded: {error}") from error
        for one in loaded if isinstance(loaded, tuple | list) else (loaded,):
            effect = _instance(one, where)
            if effect.key in found:
                raise ConfigError(f"{where}: an effect {effect.key!r} exists already")
            found[effect.key] = effect
    return found


def _instance(one: object, where: str) -> Effect:
    """Return the effect that a plug-in offers as a class or an instance."""
    try:
        effect = one() if isinstance(one, type) and issubclass(one, Effect) else one
    except TypeError as error:
        raise ConfigError(f"{where}: {error}") from error
    if not isinstance(effect, Effect):
        raise ConfigError(f"{where}: expected an Effect, got {type(effect).__name__}")
    missing = [name for name in REQUIRED if not hasattr(effect, name)]
    if missing:
        raise ConfigError(f"{where}: an effect needs {', '.join(missing)}")
    return effect


def known(name: str) -> Effect:
    """Return the effect of a name; ConfigError, which lists all, if there is none."""
    effects = catalogue()
    if name not in effects:
        raise ConfigError(f"effects: {name!r} is not in the catalogue ({', '.join(effects)})")
    return effects[name]


def of_entry(entry: Entry) -> Effect:
    """Return the effect of a configuration entry, with the law that it names; ConfigError, which lists all, if none."""
    return known(f"{entry.effect}/{entry.law}" if entry.law else entry.effect)
