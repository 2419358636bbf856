"""IDIM-LS: least squares on the inverse dynamic identification model (thesis section 2.3.2)."""

from collections.abc import Sequence

from identify.estimators.regression import (
    Block,
    Estimate,
    inverse_gram,
    joint_variances,
    least_squares,
    require_excitation,
    unweighted,
    weighted_rows,
    whitened_residuals,
)


def idim_ls(blocks: Sequence[Block], names: Sequence[str]) -> Estimate:
    """Ordinary, then weighted least squares.

    Parameters
    ----------
    blocks
        Filtered and decimated equations.
    names
        Base parameters, shape (b,), for messages.

    Raises
    ------
    DataError
        If the motion leaves parameters undetermined.
    """
    keep = [b.keep for b in blocks]
    noise = unweighted(blocks[0].y.shape[1])

    x = weighted_rows([b.x for b in blocks], keep, noise)
    require_excitation(x, names)
    theta = least_squares(x, weighted_rows([b.y for b in blocks], keep, noise))  # 2.22

    noise = joint_variances(blocks, theta)  # 2.24 to 2.26
    x = weighted_rows([b.x for b in blocks], keep, noise)
    theta = least_squares(x, weighted_rows([b.y for b in blocks], keep, noise))  # 2.23

    return Estimate(theta, inverse_gram(x), tuple(noise), whitened_residuals(blocks, theta, noise))  # 2.27
