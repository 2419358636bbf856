"""Effects of other packages: an entry point names a class, an instance, or a sequence of them."""

from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import ConfigError
from armident.identify.effects import registry
from armident.identify.effects.effect import Effect, Linear, Place
from armident.identify.robot.motion import Motion


class EndStop(Effect):
    """A spring that only pushes."""

    name = "end_stop"
    title = "a soft end stop"
    description = "the joint runs into something soft on one side"
    reference = "the machine's drawing"
    required_motion = "motion into the stop"
    linear = (Linear("kstop", ("N m/rad", "N/m"), sign=1),)

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> NDArray[np.float64]:
        return np.maximum(motion.q[:, place.joint, None], 0.0)


class EndStopQuadratic(EndStop):
    law = "quadratic"


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    """The catalogue is read again, before and after a test."""
    registry.catalogue.cache_clear()
    yield
    registry.catalogue.cache_clear()


def offered(monkeypatch: pytest.MonkeyPatch, loaded: object) -> None:
    """Let another package offer something as effects."""

    class Point(EntryPoint):
        def load(self) -> object:
            return loaded

    point = Point("end_stop", "end_stops:END_STOP", registry.ENTRY_POINTS)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])


@pytest.mark.parametrize(
    ("loaded", "keys"),
    [
        (EndStop, ["end_stop"]),
        (EndStop(), ["end_stop"]),
        ((EndStop, EndStopQuadratic()), ["end_stop", "end_stop/quadratic"]),
    ],
    ids=["class", "instance", "sequence"],
)
def test_effects_of_other_packages_come_last(monkeypatch: pytest.MonkeyPatch, loaded: object, keys: list[str]) -> None:
    ours = list(registry.catalogue())
    registry.catalogue.cache_clear()
    offered(monkeypatch, loaded)
    assert list(registry.catalogue()) == [*ours, *keys]
    assert registry.known("end_stop") == EndStop()


def test_of_effects_with_one_key_the_one_in_the_catalogue_refines_the_others() -> None:
    classes, k = [Effect], 0
    while k < len(classes):
        classes += [each for each in classes[k].__subclasses__() if each not in classes]
        k += 1
    own = [each for each in classes if each.__module__.startswith("armident.") and hasattr(each, "title")]
    catalogue = list(registry.catalogue().values())
    for each in own:
        assert any(isinstance(effect, each) for effect in catalogue), each
    assert len({type(effect) for effect in catalogue}) == len(catalogue)


class Unfinished(Effect):
    """An effect without columns and texts."""

    name = "unfinished"


class Untitled(Effect):
    """An effect with columns and without texts."""

    name = "untitled"

    def columns(self, motion: Motion, place: Place, shapes: Mapping[str, float]) -> NDArray[np.float64]:
        return np.zeros((motion.samples, 0))


@pytest.mark.parametrize(
    ("loaded", "message"),
    [
        ("end_stop", "expected an Effect, got str"),
        (Unfinished, "abstract.*columns"),
        (Untitled, "an effect needs title, description, reference, required_motion, linear"),
        ((EndStop, EndStop), "'end_stop' exists already"),
    ],
    ids=["text", "abstract", "untitled", "twice"],
)
def test_what_is_no_effect_is_refused_by_name(monkeypatch: pytest.MonkeyPatch, loaded: object, message: str) -> None:
    offered(monkeypatch, loaded)
    with pytest.raises(ConfigError, match=rf"effect end_stop \(end_stops:END_STOP\): .*{message}"):
        registry.catalogue()
