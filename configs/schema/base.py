"""Base class of all configuration objects."""

from typing import Any

from pydantic import BaseModel, ConfigDict, SerializerFunctionWrapHandler, model_serializer


class FrozenModel(BaseModel):
    """Immutable configuration object that refuses unknown keys, infinities and NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class WithBlanks(FrozenModel):
    """Configuration whose file may have keys without a value yet (`armident.configs.blanks`).

    Parameters
    ----------
    blanks
        Keys that are marked as blank in the file; their values here are defaults or placeholders.
    """

    blanks: tuple[str, ...] = ()

    @model_serializer(mode="wrap")
    def _without_empty_blanks(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out an empty list: recordings and hashes of complete configurations are as without this key."""
        content: dict[str, Any] = handler(self)
        if not self.blanks:
            content.pop("blanks", None)
        return content
