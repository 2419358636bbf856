"""Parts of an identification that its checks judge."""

from dataclasses import dataclass, field

from armident.identify.estimators.reason import Reason
from armident.identify.identification.equations import Prepared
from armident.identify.identification.identification_result import LeastSquares, MethodResult, Statistics
from armident.identify.identification.options import Options
from armident.identify.identification.solvers import Solution
from armident.identify.identification.support import Support


@dataclass(frozen=True)
class Judged:
    """Parts of an identification that its verdict depends on.

    Parameters
    ----------
    prepared
        Arm, experiments and derivatives.
    options
        Options of the identification.
    ls, found
        IDIM-LS, in whose equations errors are measured, and the estimate of the method.
    solution
        Solution in the closed loop; ``None`` for IDIM-LS.
    statistics
        Tests of the estimate, and delay of the torques.
    support
        Joints that move, and parameters that the motion supports.
    reasons
        Defects that the checks before have found.
    """

    prepared: Prepared
    options: Options
    ls: LeastSquares
    found: MethodResult
    solution: Solution | None
    statistics: Statistics
    support: Support
    reasons: list[Reason] = field(default_factory=list)

    @property
    def unusable(self) -> bool:
        """True if a check before has found the result unusable."""
        return any(reason.level == "unusable" for reason in self.reasons)
