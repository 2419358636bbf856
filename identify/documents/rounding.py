"""Values and standard deviations as text, with the same last digit."""

import math

_MOST_DECIMALS = 12
"""Most decimals of a value; smaller deviations are written with an exponent."""


def alike(value: float, std: float | None) -> tuple[str, str]:
    """Return a value and its standard deviation, rounded to the second significant digit of the deviation.

    Parameters
    ----------
    value, std
        In one unit. Without a finite deviation above zero, the value has four significant digits.

    Source: JCGM 100:2008 (GUM), 7.2.6.
    """
    if std is None or not (math.isfinite(std) and math.isfinite(value)) or std <= 0:
        return f"{value:.4g}", "" if std is None else f"{std:.2g}"
    decimals = 1 - math.floor(math.log10(float(f"{std:.1e}")))
    if decimals > _MOST_DECIMALS:
        return f"{value:.4g}", f"{std:.2g}"
    text = f"{{:.{max(decimals, 0)}f}}"
    return text.format(round(value, decimals) + 0.0), text.format(round(std, decimals))


def chance(p: float) -> str:
    """Return a p-value as a relation, ``p = 0.0034`` or ``p < 1e-12``: a smaller one is rounded to zero by its test."""
    return f"p = {p:.2g}" if p >= 1e-12 else "p < 1e-12"


def plus_minus(value: float, std: float | None) -> str:
    """Return ``value ± std`` as `alike` rounds them.

    Parameters
    ----------
    value, std
        In one unit. Without a deviation the value stands alone.
    """
    texts = alike(value, std)
    return " ± ".join(texts) if texts[1] else texts[0]
