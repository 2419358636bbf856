"""All effects there are: ours, and those that other packages bring along."""

from functools import cache
from importlib.metadata import entry_points

from armident.configs import ConfigError
from armident.identify.effects import drive, friction, link, numbers, transmission, wiring
from armident.identify.effects.effect import Effect

ENTRY_POINTS = "armident.effects"
"""Group of the entry points by which a package adds effects: each names an `Effect`, or a sequence of them."""


@cache
def catalogue() -> dict[str, Effect]:
    """All effects by name, ours first.

    Raises
    ------
    ConfigError
        If an entry point cannot be loaded, is not an effect, or takes a name that is taken.
    """
    modules = (friction, link, transmission, drive, numbers, wiring)
    ours = [effect for module in modules for effect in module.EFFECTS]
    found = {e.name: e for e in ours}
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda p: p.name):
        where = f"effect {point.name} ({point.value})"
        try:
            loaded = point.load()
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"{where}: cannot be loaded: {error}") from error
        for effect in (loaded,) if isinstance(loaded, Effect) else tuple(loaded):
            if not isinstance(effect, Effect):
                raise ConfigError(f"{where}: expected an Effect, got {type(effect).__name__}")
            if effect.name in found:
                raise ConfigError(f"{where}: there is an effect {effect.name!r} already")
            found[effect.name] = effect
    return found


def known(name: str) -> Effect:
    """Look an effect up.

    Raises
    ------
    ConfigError
        Naming the effects there are.
    """
    effects = catalogue()
    if name not in effects:
        raise ConfigError(f"effects: {name!r} is not in the catalogue ({', '.join(effects)})")
    return effects[name]
