"""The estimators by the name of their method: options, command line, session and documents derive from this list."""

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:
    from armident.identify.estimators.problem import Estimator

Method = Literal["idim-piv", "idim-iv", "idim-ls", "didim", "clie", "cloe", "sep-pem"]
METHODS: tuple[Method, ...] = get_args(Method)
"""All methods; each is ``ESTIMATOR`` of the module of its name, which is imported when it is used."""


@cache
def estimator(method: Method) -> "Estimator":
    """Return the estimator of a method."""
    found: Estimator = import_module(f"armident.identify.estimators.{method.replace('-', '_')}").ESTIMATOR
    return found
