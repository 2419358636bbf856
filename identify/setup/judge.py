"""Findings of a search with their probabilities: what is corrected, what is only named, and what is left."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.identify.setup.calibration import CORRECTED, EXTREMES, NAMED, probability
from armident.identify.setup.contest import LEAST_ERROR, Contest
from armident.identify.setup.describe import Described, corrected_robot, described, merged_scales
from armident.identify.setup.plausible import LEAST_ODDS
from armident.identify.setup.result import WIRED, SetupFinding
from armident.identify.setup.search import LEAST_DROP, NOT_UNDERSTOOD, STRUCTURED, Search, Step

NEXT_STEP = (
    "move one joint at a time, and compare direction, angle and torque of each with the arm; check the order of the "
    "columns, the units of the drives, and the home positions of the configuration"
)

LEAST_FALL = float(np.exp(0.5 * LEAST_DROP))
"""Least factor by which the error of a joint falls for a correction to copy: its residual power halves."""


@dataclass(frozen=True)
class JudgedSearch:
    """Findings; the step with the mistakes that are corrected; the configuration with these corrections, if any.

    ``likely``, ``likely_step``: the same with the corrections that a diagnosis goes on with, see `SetupCheck`.
    """

    findings: tuple[SetupFinding, ...]
    step: Step
    robot: RobotConfig | None
    likely: RobotConfig | None
    likely_step: Step


def judged_search(search: Search, found: Step, robot: RobotConfig) -> JudgedSearch:
    """Return what of a search is certain enough to be corrected, and what is only the best that was tried."""
    whole = merged_scales(found, search.bench)
    parts = described(whole, robot, search.bench)
    if not parts:
        return JudgedSearch((), found, None, None, found)
    contest = Contest(search, found, each_own=whole.each_own)
    judged = [judged_part(part, contest, robot) for part in parts]
    sure = _together(judged, [part.finding.correction for part in judged])
    likely = _together(judged, [_is_likely(part.finding, contest, robot) for part in judged])
    named = set().union(*(part.places for part in judged))
    # Scales of torques that the motion does not determine are none.
    named |= {k for k, family in enumerate(whole.families) if family == "torque_scales"}

    def corrected(parts: Sequence[Described]) -> Step:
        kept = set().union(*(part.places for part in parts))
        return whole.without(named - kept) if kept else replace(found, mistakes=())

    findings = [part.finding if part in sure else _doubtful(part, contest, robot) for part in judged]
    explained = not _lost(contest.before.errors, contest.before.memory)[contest.moving].any()
    return JudgedSearch(
        tuple(f for f in findings if f.correction or f.probability >= NAMED or not explained),
        corrected(sure),
        corrected_robot(sure, robot),
        corrected_robot(likely, robot),
        corrected(likely),
    )


def _together(parts: Sequence[Described], good: Sequence[bool]) -> list[Described]:
    """Those of the parts that are good, with all that share their mistakes: signs and orders are corrected together."""
    bad = [part.places for part, is_good in zip(parts, good, strict=True) if not is_good]
    return [part for part in parts if not any(part.places & places for places in bad)]


def _is_likely(finding: SetupFinding, contest: Contest, robot: RobotConfig) -> bool:
    """True for a correction that a diagnosis goes on with, see `SetupCheck`."""
    joints = indices(finding.joints, robot)
    before, after = (errors[contest.own(joints)] for errors in contest.in_motion)
    likely = finding.probability >= NAMED and explains(finding.kind, contest, joints)
    return finding.correction or (likely and (finding.kind not in WIRED or bool(np.all(before > LEAST_FALL * after))))


def _lost(errors: Array, memory: Array) -> NDArray[np.bool_]:
    return (errors > NOT_UNDERSTOOD) & (memory > STRUCTURED)


def judged_part(part: Described, contest: Contest, robot: RobotConfig) -> Described:
    """Return a finding with its probability, and whether its remedy is a correction to copy."""
    finding = part.finding
    if finding.kind == "time_shift" and contest.found.shift_measured:
        # A shift that the references show has the probability of its own estimate: prediction hardly tells it.
        return part
    if finding.kind == "joint_order" and np.isfinite(gain := contest.found.order_gain):
        odds, message = np.clip(expit(gain), *EXTREMES), f"{finding.message}: as recorded, a position passes its limit"
        return replace(part, finding=replace(finding, probability=float(odds), message=message))
    joints = indices(finding.joints, robot)
    equal = contest.equal(finding.kind, joints)
    share = probability(contest.features(contest.log_odds(finding.kind, joints, equal)))
    correction = share > CORRECTED and explains(finding.kind, contest, joints)
    message = finding.message
    if equal:
        words = dict.fromkeys(step.mistakes[-1].words for step in equal)
        message += f" (equally well explained by: {'; '.join(words)})"
    # Signals far beyond the limits are unusable, whatever unit is right.
    decisive = correction or (share >= NAMED and contest.more_plausible >= LEAST_ODDS)
    judged = replace(finding, message=message, probability=share, correction=correction, decisive=decisive)
    return replace(part, finding=judged)


def explains(kind: str, contest: Contest, joints: Sequence[int]) -> bool:
    """True if the corrected model explains the joints of a finding, and the error of a joint falls."""
    own, moving, after = contest.own(joints), contest.moving, contest.after
    if _lost(after.errors[own], after.memory[own]).any():
        return False
    # A wrong scale of one joint shows at the others that carry the same links.
    falls = np.any(contest.in_motion[0][moving] > LEAST_FALL * contest.in_motion[1][moving])
    # A common unit shows in the limits only, a common shift in the phase.
    return bool(falls) or contest.more_plausible >= LEAST_ODDS or kind == "time_shift"


def _doubtful(part: Described, contest: Contest, robot: RobotConfig) -> SetupFinding:
    """Return a finding as the best of what was tried, without a line to copy."""
    finding = part.finding
    own = contest.own(indices(finding.joints, robot))
    worst = max(own, key=lambda j: contest.after.errors[j])
    lost = _lost(contest.before.errors, contest.before.memory)
    names = ", ".join(robot.joints[j].name for j in contest.moving if lost[j])
    implausible = contest.more_plausible >= LEAST_ODDS
    doubt = f"the rigid model does not explain {names}" if names else "the rigid model explains every joint"
    if implausible:
        doubt = "the signals are far beyond the limits of the configuration"
    message = (
        f"{doubt}; the best of what was tried is: {finding.message}, which leaves "
        f"{100 * max(contest.after.errors[worst], LEAST_ERROR):.0f} % of the torque of {robot.joints[worst].name} "
        f"({100 * contest.before.errors[worst]:.0f} % as configured)"
    )
    return replace(
        finding, message=message, remedy=NEXT_STEP, correction=False, decisive=finding.decisive and implausible
    )


def indices(names: Sequence[str], robot: RobotConfig) -> list[int]:
    """Return the numbers of joints."""
    known = [joint.name for joint in robot.joints]
    return [known.index(name) for name in names]
