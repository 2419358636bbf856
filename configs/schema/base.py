"""Base class of all configuration objects."""

from pydantic import BaseModel, ConfigDict


class FrozenModel(BaseModel):
    """Immutable configuration object that refuses unknown keys, infinities and NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
