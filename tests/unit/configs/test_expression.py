"""Arithmetic in configuration files."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

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
        ("2 *", "not an expression; expected numbers, names"),
        ("1 / (fc - 2)", "division by zero"),
        ("(-fc) ** 0.5", "root of a negative number"),
        ("__import__('os')", "unknown name"),
        ("fc.real", "only numbers"),
        ("[1, 2]", "only numbers"),
        ("True", "only numbers"),
        ("10 ** 400", "large"),
        ("1" * 400, "large"),
        (10**400, "large"),
        ("1e400", "not a finite number"),
        ("-1e400 + 1e400", "not a finite number"),
        ("sin(1e400)", "no real number"),
        (math.nan, "not a finite number"),
        (-math.inf, "not a finite number"),
        ("(" * 450 + "1" + ")" * 450, "not an expression|nested too deeply"),
        ("-" * 999 + "1", "nested too deeply"),
        ("1 + " * 249 + "x", "unknown name 'x'"),
        ("(" * 100_000, "100000 characters, expected at most 1000"),
        ("1" * 5000, "5000 characters"),
        ("2 \0", "not an expression"),
        ("1 if fc else 2", "only numbers"),
        ("lambda: 1", "only numbers"),
        ("sqrt(1, 2)", "only numbers"),
        ("fc(1)", "unknown name 'fc'"),
        ("", "not an expression"),
    ],
)
def test_anything_else_is_refused_and_the_message_says_where(text: str | float, told: str) -> None:
    with pytest.raises(ConfigError, match=told) as caught:
        evaluate(text, {"fc": 2.0}, "suite.yaml: effects[0]")
    assert str(caught.value).startswith("suite.yaml: effects[0]: ")
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)


@given(st.text(alphabet="0123456789.eE+-*/() pi,fcsqrt\\\0\n_", max_size=60))
def test_any_text_is_a_finite_number_or_one_line(text: str) -> None:
    try:
        assert math.isfinite(evaluate(text, {"fc": 2.0}))
    except ConfigError as error:
        assert "\n" not in str(error)  # noqa: PT017
