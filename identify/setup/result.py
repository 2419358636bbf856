"""Result of the set-up check."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from armident.configs import RobotConfig
from armident.identify.documents.rounding import plus_minus
from armident.identify.signals.experiments import Experiment
from armident.identify.signals.streamed import mapped

SIGNIFICANT = 3.0
"""Standard deviations between a shift and a convention from which they differ: one false alarm in 370."""

CONVENTIONS = (0.0, 0.5)
"""Shifts of the two ways in which drives report a torque, samples: held until the next sample; that of the instant."""

SUBSTANTIAL = 3.2
"""Least odds of the torque of the instant over the held one: "substantial" evidence (Jeffreys 1961, appendix B)."""

CERTAIN = 20.0
"""Odds of one convention over the other from which the shift is known."""

SHORTEST = 0.1
"""Shortest shift that is corrected, samples: derivatives and interpolation err by some hundredths. A shift of 0.1
changes a torque that has 20 samples in a period by 3 %."""

LONGEST = 1.0
"""Longest shift that is corrected without a finding, samples: longer ones are `time_shift`, a mistake of the set-up."""

MOST_UNCERTAIN = 0.25
"""Largest standard deviation of a shift that is corrected, samples: half a sample is then known by a factor of 2."""


WIRED = ("position_sign", "torque_sign", "joint_order")
"""Kinds of findings that exchange or turn signals: every joint concerned is explained better by a right one."""


ABOUT_URDF = ("urdf_centres", "urdf_masses")
"""Kinds of findings about masses of the URDF, which no identification uses."""


@dataclass(frozen=True)
class SetupFinding:
    """One mistake of the set-up.

    ``kind``: ``position_sign``, ``torque_sign``, ``joint_order``, ``position_unit``, ``torque_unit``, ``time_unit``,
    ``gear_ratio``, ``side``, ``gravity_direction``, ``gravity_missing``, ``time_shift``, ``torque_clipped``,
    ``rate_too_slow``, ``standstill``, ``joint_at_rest``, ``one_direction``, ``position_step``, ``position_resolution``,
    ``torque_held``, ``position_held``, ``position_offset``, ``torque_too_small``, ``torque_without_sign``,
    ``unusual_weight``, ``urdf_centres``, ``urdf_masses`` or ``change_in_time``.
    ``probability``: that it is right. ``remedy``: correcting configuration
    line or option, or the next step. ``decisive``: results are unusable without it. ``correction``: the remedy is
    certain enough to be copied; False for the best of what was tried.
    """

    kind: str
    joints: tuple[str, ...]
    probability: float
    message: str
    remedy: str
    decisive: bool
    correction: bool = True


@dataclass(frozen=True)
class TorqueShift:
    """Samples by which torques are late against positions, beyond a torque held until the next sample; negative: early.

    ``odds``: torque of the sample's instant over a held one. ``instrumented``: references gave undisturbed instruments.
    """

    samples: float
    std: float
    dt: float
    by_joint: dict[str, tuple[float, float]]
    odds: float
    instrumented: bool

    @property
    def correction(self) -> float:
        """Shift that is corrected, samples; 0 for none, and if the estimate is too uncertain.

        That of an agreeing sampling convention, which is more exact; else the estimate up to one sample.
        """
        if not self.determined:
            return 0.0
        if any(abs(self.samples - shift) <= SIGNIFICANT * self.std for shift in CONVENTIONS):
            return CONVENTIONS[self.odds > SUBSTANTIAL]
        return self.samples if SHORTEST <= abs(self.samples) <= LONGEST else 0.0

    @property
    def determined(self) -> bool:
        """True if the estimate is certain enough to be corrected, or to need no correction."""
        compared = sum(std <= MOST_UNCERTAIN for _, std in self.by_joint.values())
        # Of one joint alone, dynamics that the model lacks look the same. Disturbances that feed back bias each joint
        # differently: without instruments, two joints must confirm the shift.
        several = len(self.by_joint) >= 2 if self.instrumented else compared >= 2
        return several and self.std <= MOST_UNCERTAIN

    @property
    def known(self) -> bool:
        """True if the estimate is certain enough to tell the conventions apart, or agrees with none of them."""
        agrees = any(abs(self.samples - shift) <= SIGNIFICANT * self.std for shift in CONVENTIONS)
        decided = self.odds > CERTAIN or self.odds < 1.0 / CERTAIN
        return self.determined and (decided or not agrees)

    @property
    def undetermined(self) -> bool:
        """True if several joints move, and their shifts do not tell the conventions apart."""
        return len(self.by_joint) >= 2 and self.std > MOST_UNCERTAIN

    @property
    def confirmed(self) -> bool:
        """True if it certainly exceeds one sample; at least two joints confirm it, none contradicts it.

        Without instruments, disturbances in a damped closed loop make torques look early, up to about as many standard
        deviations again. An early shift is not confirmed then.
        """
        size = abs(self.samples)
        apart = [(own - self.samples) / std for own, std in self.by_joint.values() if SIGNIFICANT * std <= size]
        agree = sum(abs(one) <= SIGNIFICANT for one in apart)
        earliest = -SIGNIFICANT * (1.0 if self.instrumented else 2.0)
        exceeds = size > LONGEST + SIGNIFICANT * self.std and (self.instrumented or self.samples > 0.0)
        return exceeds and agree >= 2 and all(earliest <= one <= SIGNIFICANT for one in apart)

    @property
    def applied(self) -> bool:
        """True if a shift is corrected."""
        return self.correction != 0.0

    @property
    def remark(self) -> str:
        """The correction in one sentence; empty if none is made."""
        if not self.applied:
            return ""
        late, by_convention = self.correction, self.correction in CONVENTIONS
        size = f"{abs(late):.2f} samples ({1000 * abs(late) * self.dt:.3g} ms)"
        reason = "torques of the instant of the sample" if by_convention else "their own sampling instant"
        return (
            f"all torques are {size} {'late' if late > 0 else 'early'} against torques held until the next sample "
            f"({reason}; estimated: {plus_minus(self.samples, self.std)} samples): identify and diagnose align their "
            "equations with it"
        )


@dataclass(frozen=True)
class Span:
    """Part of an experiment (its number) from ``begin`` to ``end``, s since the recording began."""

    experiment: int
    begin: float
    end: float


@dataclass(frozen=True)
class SetupCheck:
    """Result of `armident.identify.setup.check.check_setup`.

    ``relative_error_pct``, ``corrected_error_pct`` (n,): norm of the rigid model's torque residual over the torque,
    before and after correction. ``joints_not_understood``: over a third of the torque left, with no explanation.
    ``clock``: true over recorded duration. ``torque_shift``: common shift by less than a sample or two. ``stretch``:
    the part of the time in which the arm is another one. ``likely_robot``, ``likely_error_pct`` (n,): with the
    corrections that a diagnosis goes on with: those more likely right than wrong, but of `WIRED` only the certain ones
    and those that halve the error power of every joint concerned.
    """

    findings: tuple[SetupFinding, ...]
    relative_error_pct: tuple[float, ...]
    corrected_error_pct: tuple[float, ...]
    joints_not_understood: tuple[str, ...]
    tried: tuple[str, ...]
    corrected_robot: RobotConfig | None
    clock: float = 1.0
    torque_shift: TorqueShift | None = None
    stretch: tuple[Span, ...] = ()
    likely_robot: RobotConfig | None = None
    likely_error_pct: tuple[float, ...] = ()


def with_torque_shift(experiments: Sequence[Experiment], shift: TorqueShift | None) -> Sequence[Experiment]:
    """Return the experiments with the common shift of their torques, if it is applied."""
    if shift is None or not shift.applied:
        return experiments
    return mapped(lambda e: replace(e, torque_shift=e.torque_shift + shift.correction), experiments)
