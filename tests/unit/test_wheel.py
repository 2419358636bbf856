"""The wheel holds what a customer runs: the laboratory is in ``tests/evaluation`` and ``tests/reproduction``."""

from importlib.metadata import distribution

import grimp


def test_every_module_of_the_wheel_is_used_by_an_entry_point_or_the_public_api() -> None:
    graph = grimp.build_graph("armident", cache_dir=None)
    entries = {point.module for point in distribution("armident").entry_points}
    roots = {"armident", *entries, *(module for module in graph.modules if module.endswith(".__main__"))}
    used = roots.union(*(graph.find_upstream_modules(module) for module in roots))
    packages = {module for module in graph.modules if graph.find_children(module)}
    assert graph.modules - used - packages == set()
    assert not {module for module in graph.modules if {"evaluation", "thesis", "random_arms"} & {*module.split(".")}}
