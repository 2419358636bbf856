"""Arithmetic in configuration files."""

import math

import pytest

from armident.configs import ConfigError
from armident.configs.expression import evaluate


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (0.25, 0.25),
        ("0.3 * fc", 0.6),
        ("-fc", -2.0),
        ("(s - 1) * fc", 4.0),
        ("fc * (2 * pi * 15) ** 2 / s", 2.0 * (30 * math.pi) ** 2 / 3),
        ("sin(s) * sqrt(fc) - abs(-s)", math.sin(3) * math.sqrt(2) - 3),
    ],
)
def test_an_expression_has_the_value_that_arithmetic_gives_it(text: str | float, value: float) -> None:
    assert evaluate(text, {"fc": 2.0, "s": 3.0}) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("2 * fd", "unknown name 'fd'"),
        ("2 *", "invalid syntax"),
        ("1 / (fc - 2)", "division by zero"),
        ("(-fc) ** 0.5", "root of a negative number"),
        ("__import__('os')", "unknown name"),
        ("fc.real", "only numbers"),
        ("[1, 2]", "only numbers"),
        ("True", "only numbers"),
        ("10 ** 400", "large"),
    ],
)
def test_anything_else_is_refused_and_the_message_says_where(text: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told) as caught:
        evaluate(text, {"fc": 2.0}, "suite.yaml: effects[0]")
    assert str(caught.value).startswith("suite.yaml: effects[0]: ")
