"""From a recording to a model: robot model, signals, estimators, diagnosis, reports.

The package is callable, because the public API has a function of its name: ``armident.identify(recording)`` is
`armident.identify.api.identification_api.identify`.
"""

import inspect
import sys
from types import ModuleType
from typing import Any

from armident.extras import named_extra


class _CallablePackage(ModuleType):
    """A package that is called as its function `armident.identify.api.identification_api.identify`."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        with named_extra("armident.identify", __name__):
            from armident.identify.api.identification_api import identify

        return identify(*args, **kwargs)

    @property
    def __signature__(self) -> inspect.Signature:
        from armident.identify.api.identification_api import identify

        return inspect.signature(identify)


sys.modules[__name__].__class__ = _CallablePackage
