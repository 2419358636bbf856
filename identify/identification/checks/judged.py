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
    """Parts of an identification that its verdict depends on; errors are measured in the equations of ``ls``."""

    prepared: Prepared
    options: Options
    ls: LeastSquares
    found: MethodResult
    solution: Solution | None
    statistics: Statistics
    support: Support
    sign_given: bool = False
    reasons: list[Reason] = field(default_factory=list)

    @property
    def unusable(self) -> bool:
        """True if a check before has found the result unusable."""
        return any(reason.level == "unusable" for reason in self.reasons)
