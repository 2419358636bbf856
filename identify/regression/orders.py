"""Orders of noise models, importable without numpy."""

MAX_AR_ORDER = 60
"""Highest order of the noise models of an identification; AIC chooses below it. The equations of IDIM-PIV have a rate
of ten closed-loop bandwidths (`PIV_CUTOFF`): 60 coefficients reach over six periods at the bandwidth."""
