"""Estimators as the identification calls them: the problem that they solve, and their solution of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from armident.arrays import Array
from armident.identify.estimators.auxiliary_model import AuxiliaryModel
from armident.identify.estimators.methods import Method
from armident.identify.estimators.reason import Reason
from armident.identify.regression.equations import Estimate, ExperimentEquations

JOINT_TORQUE = "joint torque"


class Problem(Protocol):
    """Equations of the recordings, simulated closed loop, and options."""

    @property
    def blocks(self) -> Sequence[ExperimentEquations]:
        """Equations at measured signals with the decimation of the method, one block per experiment."""

    @property
    def auxiliary(self) -> AuxiliaryModel:
        """The simulated closed loop with the same decimation."""

    @property
    def start(self) -> Array:
        """First theta (b,) that the loop can be simulated with."""

    @property
    def positions(self) -> Sequence[Array]:
        """Measured joint positions after the same decimation, (M, n) per experiment, rad or m."""

    @property
    def plain_problem(self) -> "Problem":
        """The problem with the decimation of the estimators without a noise model."""

    @property
    def max_ar_order(self) -> int:
        """Highest order of the noise models."""

    @property
    def grey_box(self) -> bool:
        """True if the noise is that of the positions, through the controller (6.28)."""

    def bias(self, estimate: Estimate, *, prefiltered: bool) -> Array | None:
        """Bias (b,) of instrumental variables by derivatives and sampling alone; ``None``: no loop can be simulated.

        Parameters
        ----------
        estimate
            The estimate whose recordings are simulated.
        prefiltered
            True if its noise models weigh the rows.
        """


@dataclass(frozen=True)
class Solved:
    """An estimate with the equations to which it belongs.

    Parameters
    ----------
    estimate
        Theta, covariance and noise models.
    plain
        True if it solves the plain problem.
    prefiltered
        True if the noise models weighted the rows; false if they only entered the covariance.
    noise_of
        Quantity to which noise models and residuals belong.
    reasons
        Defects for the verdict.
    """

    estimate: Estimate
    plain: bool = False
    prefiltered: bool = False
    noise_of: str = JOINT_TORQUE
    reasons: tuple[Reason, ...] = ()


@dataclass(frozen=True)
class Estimator:
    """A method of identification.

    Parameters
    ----------
    name
        Its name in options and documents.
    solve
        Solves a problem with a simulated closed loop. ``None``: the estimate is that of least squares, with which
        every identification starts.
    meaning, source
        The method in a sentence, for the glossary, and its section of the thesis with the equations.
    measured
        True if the regressor is the measured one. Otherwise it is simulated: without a loop that runs, the estimate
        has no meaning.
    prefiltered
        True with a noise model of the rows: the equations are decimated only roughly (thesis section 7.2).
    white_covariance
        True if the standard deviations take the residuals of the torques for white.
    """

    name: Method
    solve: Callable[[Problem], Solved] | None
    meaning: str
    source: str
    measured: bool = False
    prefiltered: bool = False
    white_covariance: bool = False
