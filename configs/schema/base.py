"""The base of every configuration object: frozen, and without unknown keys."""

from pydantic import BaseModel, ConfigDict


class FrozenModel(BaseModel):
    """A configuration object: read once, checked once, passed on unchanged."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
