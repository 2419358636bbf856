"""Names of the filters of positions and of the rules for the noise-variance ratio, importable without numpy."""

from typing import Literal, get_args

DerivativesName = Literal["irwsm", "irwsm2", "bandpass"]
NvrRule = Literal["automatic", "cross-validation", "likelihood", "tracking-error"]
"""Rule that determines the noise-variance ratio if no number is given."""

NVR_RULES: tuple[NvrRule, ...] = get_args(NvrRule)
