"""Score of a diagnosis of a random arm: comparison with the truth of the case."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

from armident.identify.documents.diagnosis import DiagnosisDocument
from tests.evaluation.cases import Case, InjectedEffect
from tests.evaluation.score import LOW_CONFIDENCE, UNNAMED, closed_share

Family = Literal["healthy", "effect", "setup", "outside"]

VISIBLE = 1.05
"""Visibility from which an effect counts: the residual of the rigid model is 5 % larger (docs/diagnosis.md)."""
RESCALING = ("gain_error",)
"""Kinds that change the scale of the torques, so that errors with and without them are not comparable."""


@dataclass(frozen=True)
class Truth:
    """Truth of a case, see `tests.evaluation.plants.cases.Truth`.

    ``family``, ``kind``: family, and kind of the hidden effect or mistake. ``accepted``: names of findings that are
    right. ``joints``: names of the joints at which a finding is right; empty for the whole arm. ``visibility``:
    residual of the rigid model with the effect over that without.
    """

    name: str
    family: Family
    kind: str
    accepted: tuple[str, ...]
    joints: tuple[str, ...]
    visibility: float

    @property
    def visible(self) -> bool:
        """``True`` if the case counts towards the aims; mistakes and healthy arms always do."""
        return self.family in ("healthy", "setup") or self.visibility >= VISIBLE


def truth_from(document: Mapping[str, Any]) -> Truth:
    """Truth of a case from its document. ``document``: content of ``NAME.truth.json``."""
    return Truth(
        document["name"],
        cast(Family, document["family"]),
        document["kind"],
        tuple(document["accepted"]),
        tuple(document["joints"]),
        float(document["visibility"]),
    )


@dataclass(frozen=True)
class Claim:
    """A name that a diagnosis gives: a finding, or a mistake of the set-up.

    ``name``: name of the effect or mistake. ``joints``: joints that the diagnosis gives; empty for the whole arm.
    ``confidence``: confidence or probability, 0 to 1.
    """

    name: str
    joints: tuple[str, ...]
    confidence: float

    def __str__(self) -> str:
        return " ".join((self.name, *self.joints))


@dataclass(frozen=True)
class RandomScore:
    """Result of one case; shares and flags are ``None`` where they do not apply.

    Parameters
    ----------
    verdict
        Verdict of the diagnosis; empty after a failure.
    claims
        All names given, mistakes of the set-up first.
    first
        The first name is right, at a right joint; of effects and mistakes.
    among
        One of the names is right, at a right joint.
    clean
        Nothing is named and the verdict is ``no_gap``; of healthy arms.
    named
        An effect is named with a confidence of at least `LOW_CONFIDENCE`.
    closed
        Closed share of the gap of a visible effect, by named and unnamed terms.
    worse
        The diagnosis has findings, and its reported error is no smaller with them.
    seconds
        Time of the diagnosis, s.
    error
        Message of the failure; empty without one.
    """

    truth: Truth
    verdict: str = ""
    claims: tuple[Claim, ...] = ()
    first: bool | None = None
    among: bool | None = None
    clean: bool | None = None
    named: bool | None = None
    closed: float | None = None
    worse: bool = False
    seconds: float = 0.0
    error: str = ""


def claims_of(document: DiagnosisDocument) -> tuple[Claim, ...]:
    """Names that a diagnosis gives, mistakes of the set-up before findings; unnamed terms are left out."""
    content = document.model_dump(mode="json")
    setup = content.get("setup") or {}
    mistakes = setup.get("findings", []) if isinstance(setup, Mapping) else setup
    out = [Claim(m["kind"], tuple(m["joints"]), float(m["probability"])) for m in mistakes]
    for finding in document.findings:
        joints = tuple(joint for joint in (finding.joint, finding.other) if joint)
        out.append(Claim(finding.effect, joints, finding.confidence))
    return tuple(claim for claim in out if not claim.name.startswith(UNNAMED))


def is_right(truth: Truth, claim: Claim) -> bool:
    """``True`` if a name is accepted, and its joint is one of the truth's. ``truth``: the truth of the case."""
    at = not truth.joints or not claim.joints or bool(set(claim.joints) & set(truth.joints))
    return claim.name in truth.accepted and at


def score_case(
    truth: Truth, document: DiagnosisDocument, twin: DiagnosisDocument | None, seconds: float
) -> RandomScore:
    """Compare a diagnosis with the truth.

    ``twin``: diagnosis of the healthy twin; ``None`` without one. ``seconds``: time of the diagnosis, s.
    """
    claims = claims_of(document)
    known = truth.family in ("effect", "setup")
    gap = document.gap.validation
    return RandomScore(
        truth,
        document.verdict,
        claims,
        first=bool(claims) and is_right(truth, claims[0]) if known else None,
        among=any(is_right(truth, claim) for claim in claims) if known else None,
        clean=document.verdict == "no_gap" and not claims if truth.family == "healthy" else None,
        named=any(claim.confidence >= LOW_CONFIDENCE for claim in claims),
        closed=None if twin is None or not truth.visible else _closed(truth, document, twin),
        worse=bool(document.findings) and gap.after.all >= gap.before.all,
        seconds=seconds,
    )


def _closed(truth: Truth, document: DiagnosisDocument, twin: DiagnosisDocument) -> float | None:
    joint, other = (*truth.joints, "", "")[:2]
    part = InjectedEffect(
        truth.accepted[0], joint, other or None, truth.accepted, {}, {}, 1.0, arm=not truth.joints,
        rescales=truth.kind in RESCALING,
    )  # fmt: skip
    return closed_share(Case("effect", None, truth.name, "", "", 1, 0.0, 0, (part,)), document, twin)
