"""The decision between a torque that is clipped and one that saturates softly."""

import numpy as np
import pytest

from armident.identify.setup.clipping import DECIDED, preference


@pytest.mark.parametrize("pole", [0.0, 0.5])
def test_laws_that_fit_alike_are_decided_in_five_percent(pole: float) -> None:
    rng = np.random.default_rng(3)
    decided = 0
    for _ in range(400):
        common, first, second = rng.normal(size=(3, 400))
        for row in (common, first, second):
            for k in range(1, row.size):
                row[k] += pole * row[k - 1]
        decided += preference(common + 0.3 * first, common + 0.3 * second) > DECIDED
    assert 0.02 < decided / 400 < 0.1


def test_the_better_law_is_preferred_and_its_rival_is_not() -> None:
    rng = np.random.default_rng(4)
    good, bad = 0.1 * rng.normal(size=300), 0.1 * rng.normal(size=300)
    bad[::3] += 0.3
    assert preference(good, bad) > 4.0
    assert preference(bad, good) == pytest.approx(-preference(good, bad))
    assert preference(0.0 * good, bad) == np.inf
    assert preference(0.0 * good, 0.0 * bad) == 0.0
