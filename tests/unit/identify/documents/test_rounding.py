"""A value and its standard deviation end with the same digit."""

import math

import pytest

from armident.identify.documents.rounding import alike, chance, plus_minus


@pytest.mark.parametrize(
    ("value", "std", "texts"),
    [
        (1.23304, 0.01221, ("1.233", "0.012")),
        (95.0873, 0.1, ("95.09", "0.10")),
        (-0.000123, 0.04567, ("0.000", "0.046")),
        (203.5, 0.0996, ("203.50", "0.10")),
        (8123.4, 456.7, ("8120", "460")),
        (1.5e-9, 2.5e-10, ("0.00000000150", "0.00000000025")),
        (1.5e-20, 2.5e-21, ("1.5e-20", "2.5e-21")),
        (3.14159, 0.0, ("3.142", "0")),
        (3.14159, math.inf, ("3.142", "inf")),
    ],
)
def test_the_deviation_has_two_digits_and_the_value_the_same_last_one(
    value: float, std: float, texts: tuple[str, str]
) -> None:
    assert alike(value, std) == texts


def test_a_value_without_a_deviation_stands_alone() -> None:
    assert plus_minus(3.14159, None) == "3.142"
    assert plus_minus(3.14159, 0.0123) == "3.142 ± 0.012"


def test_a_chance_that_its_test_rounds_to_zero_is_a_bound() -> None:
    assert [chance(p) for p in (0.0337, 2e-11, 0.0)] == ["p = 0.034", "p = 2e-11", "p < 1e-12"]
