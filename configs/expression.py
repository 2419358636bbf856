"""Arithmetic expressions in configuration files: numbers, names, ``+ - * / **``, parentheses and a few functions."""

import ast
import math
import operator
from collections.abc import Callable, Mapping

from armident.configs.errors import ConfigError

_BINARY: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_FUNCTIONS: dict[str, Callable[[float], float]] = {"abs": abs, "sqrt": math.sqrt, "sin": math.sin, "cos": math.cos}
_CONSTANTS = {"pi": math.pi}
_EXPECTED = "numbers, names, + - * / ** and functions of one argument"

LONGEST = 1000
"""Maximum length of an expression in characters."""

_SHOWN = 80
"""Maximum number of characters of an expression that a message quotes."""


def evaluate(expression: str | float, names: Mapping[str, float], where: str = "expression") -> float:
    """Value of an expression such as ``0.3 * fc``; raises ConfigError if it is wrong, not finite, or a name unknown."""
    shown = repr(expression) if isinstance(expression, str) else "the number"
    shown = shown if len(shown) <= _SHOWN else f"{shown[: _SHOWN - 3]}..."
    if isinstance(expression, str) and len(expression) > LONGEST:
        raise ConfigError(f"{where}: {shown}: {len(expression)} characters, expected at most {LONGEST}")
    try:
        value = _value(_parsed(expression), names) if isinstance(expression, str) else float(expression)
    except KeyError as error:
        known = ", ".join(sorted(names))
        raise ConfigError(f"{where}: {shown}: unknown name {error.args[0]!r:.60} (names: {known})") from error
    except ZeroDivisionError as error:
        raise ConfigError(f"{where}: {shown}: division by zero") from error
    except OverflowError as error:
        raise ConfigError(f"{where}: {shown}: the number is too large") from error
    except (RecursionError, MemoryError) as error:
        raise ConfigError(f"{where}: {shown}: nested too deeply") from error
    except ValueError as error:
        raise ConfigError(f"{where}: {shown}: no real number (is it the root of a negative number?)") from error
    except _NotArithmetic as error:
        raise ConfigError(f"{where}: {shown}: {error} (names: {', '.join(sorted(names))})") from error
    if not math.isfinite(value):
        raise ConfigError(f"{where}: {shown} is not a finite number")
    return value


class _NotArithmetic(Exception):
    """Text that is no arithmetic expression."""


def _parsed(text: str) -> ast.expr:
    try:
        return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError) as error:
        raise _NotArithmetic(f"not an expression; expected {_EXPECTED}") from error


def _value(node: ast.expr, names: Mapping[str, float]) -> float:
    match node:
        case ast.Constant(value=bool()):
            raise _NotArithmetic(f"expected only {_EXPECTED}")
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.Name(id=name):
            return float(names[name]) if name in names else _CONSTANTS[name]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_value(operand, names)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            result = _BINARY[type(op)](_value(left, names), _value(right, names))
            if isinstance(result, complex):
                raise ValueError("the root of a negative number")
            return result
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]):
            return _FUNCTIONS[name](_value(argument, names))
    raise _NotArithmetic(f"expected only {_EXPECTED}")
