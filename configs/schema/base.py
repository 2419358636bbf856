"""Base classes of configuration objects and result documents."""

import inspect
import re
from typing import Any

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, SerializerFunctionWrapHandler, model_serializer
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

_PARAMETERS = re.compile(r"\n*Parameters\n-+\n(.*)\Z", re.DOTALL)
_ENTRY = re.compile(r"^(\S[^\n]*)\n((?:[ ]{4}[^\n]*(?:\n|\Z)|\n)+)", re.MULTILINE)


class DescribedModel(BaseModel):
    """Model whose JSON Schema describes each field with the text of the Parameters section of its docstring."""

    # A command uses few of the models: each builds its validator when it is first used.
    model_config = ConfigDict(defer_build=True)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON Schema of the model with the descriptions of its fields."""
        schema = handler.resolve_ref_schema(handler(core_schema))
        schema["description"], descriptions = split_docstring(cls.__doc__ or "")
        for base in cls.__mro__[1:]:
            if issubclass(base, DescribedModel):
                descriptions = split_docstring(base.__doc__ or "")[1] | descriptions
        for name, field in cls.model_fields.items():
            if name in descriptions:
                entry: dict[str, Any] = schema["properties"][field.alias or name]
                entry["description"] = descriptions[name]
        return schema


class FrozenModel(DescribedModel):
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


def split_docstring(docstring: str) -> tuple[str, dict[str, str]]:
    """Split a numpydoc docstring into its text and the descriptions of its parameters, each on one line.

    Parameters is its last section, or missing. Names that share a description each have it.
    """
    text = inspect.cleandoc(docstring)
    section = _PARAMETERS.search(text)
    if section is None:
        return text, {}
    descriptions = {}
    for names, description in _ENTRY.findall(section[1]):
        for name in names.split(" : ")[0].split(","):
            descriptions[name.strip()] = " ".join(description.split())
    return text[: section.start()], descriptions
