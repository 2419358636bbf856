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


def evaluate(expression: str | float, names: Mapping[str, float], where: str = "expression") -> float:
    """Value of an arithmetic expression.

    Parameters
    ----------
    expression
        A number, or text such as ``0.3 * fc``.
    names
        Values of the names that the expression may use.
    where
        Name of the expression in messages.

    Raises
    ------
    ConfigError
        If the text is not an expression, a name is unknown, or the value is not finite.
    """
    if not isinstance(expression, str):
        return float(expression)
    try:
        value = _value(ast.parse(expression.strip(), mode="eval").body, names)
    except (SyntaxError, TypeError, KeyError, ValueError) as error:
        detail = f"unknown name {error.args[0]!r}" if isinstance(error, KeyError) else str(error)
        raise ConfigError(f"{where}: {expression!r}: {detail} (names: {', '.join(sorted(names))})") from error
    except ZeroDivisionError as error:
        raise ConfigError(f"{where}: {expression!r}: division by zero") from error
    except OverflowError as error:
        raise ConfigError(f"{where}: {expression!r}: the number is too large") from error
    if not math.isfinite(value):
        raise ConfigError(f"{where}: {expression!r} is not a finite number")
    return value


def _value(node: ast.expr, names: Mapping[str, float]) -> float:
    match node:
        case ast.Constant(value=bool()):
            raise ValueError("only numbers, names, + - * / ** and functions of one argument")
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
    raise ValueError("only numbers, names, + - * / ** and functions of one argument")
