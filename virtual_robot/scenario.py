"""Reads a scenario file: the effects hidden in the virtual arm."""

from pathlib import Path

from armident.configs import ConfigError, config_path
from armident.configs.loading import HERE, parse
from armident.configs.reading import is_file
from armident.configs.scenario import Scenario

SCENARIOS = HERE / "scenarios"


def load_scenario(name: str | Path) -> Scenario:
    """Load a scenario from a file, or one of those in ``configs/scenarios`` by its name.

    Raises
    ------
    ConfigError
        Naming file, key and what was expected.
    """
    try:
        path = config_path(name)
    except ConfigError:
        path = (SCENARIOS / Path(name).name).with_suffix(".yaml")
        if not is_file(path):
            shipped = ", ".join(sorted(p.name for p in SCENARIOS.glob("*.yaml")))
            raise ConfigError(f"{name}: no such scenario (shipped with armident: {shipped})") from None
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    return parse(text, Scenario, str(path))
