"""The wheel holds what a customer runs: the laboratory is in ``tests/evaluation`` and ``tests/reproduction``."""

from importlib.metadata import distribution

import grimp

from armident.daq.interchange.readers import READERS
from armident.identify.estimators.methods import METHODS


def test_every_module_of_the_wheel_is_used_by_an_entry_point_or_the_public_api() -> None:
    graph = grimp.build_graph("armident", cache_dir=None)
    roots = {"armident", *(point.module for point in distribution("armident").entry_points)}
    roots |= {module for module in graph.modules if module.endswith(".__main__")}
    # An estimator is imported by the name of its method, and the functions of a format by their places.
    roots |= {f"armident.identify.estimators.{method.replace('-', '_')}" for method in METHODS}
    places = [place for each in READERS for place in (each.reader, each.writer) if place]
    roots |= {f"armident.daq.interchange.{place.partition(':')[0]}" for place in places}
    used = roots.union(*(graph.find_upstream_modules(module) for module in roots))
    packages = {module for module in graph.modules if graph.find_children(module)}
    assert graph.modules - used - packages == set()
    assert not {module for module in graph.modules if {"evaluation", "thesis", "random_arms"} & {*module.split(".")}}
