"""Stage of a diagnosis with a baseline: what has changed, before any effect is looked for.

The recordings are identified as the baseline was: errors that both models have cancel in the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.baseline_comparison import Inconclusive
from armident.identify.diagnosis.change_test import ParameterChangeTest, compare
from armident.identify.diagnosis.changed_parameters import ExplainedChange
from armident.identify.diagnosis.changes import place_of
from armident.identify.diagnosis.criteria import Criteria
from armident.identify.diagnosis.setup_stage import SetupStage
from armident.identify.documents.base import RecordingReference
from armident.identify.documents.diagnosis import Alternative, Finding, Gap, Unexplained
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.terms import entry_of
from armident.identify.effects.unnamed import NAME as UNNAMED
from armident.identify.identification.document import identification_document
from armident.identify.identification.identification_result import IdentificationResult
from armident.identify.identification.options import Options
from armident.identify.identification.pipeline import identify_experiment
from armident.identify.identification.residual_statistics import effect_columns
from armident.identify.identification.sign_smoothing import with_numbers
from armident.identify.regression.equations import applied, instants


@dataclass(frozen=True)
class BaselineStage:
    """Comparison with a baseline; without one that is conclusive everything is looked for.

    ``before``, ``after``: gaps of the baseline's parameters, without and with the changes, on training and validation
    data. ``sought``: joints at which the changes leave something; ``entries``: terms that the changes add to the model.
    """

    findings: tuple[Finding, ...] = ()
    unexplained: tuple[Unexplained, ...] = ()
    before: tuple[Gap, Gap] | None = None
    after: tuple[Gap, Gap] | None = None
    sought: tuple[int, ...] | None = None
    entries: tuple[Entry, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """True if nothing is left to look for."""
        return self.sought == ()

    def beside(self, structural: Sequence[Finding], joints: Sequence[str]) -> list[Finding]:
        """Findings of changes, without those of joints at which something was left and has a structural name now.

        The parameters there follow the effect that the model lacks.
        """
        sought = {joints[j] for j in self.sought or ()}
        superseded = sought & {f.joint for f in structural if f.effect != UNNAMED}
        return [f for f in self.findings if f.joint not in superseded]

    def left(
        self, findings: Sequence[Finding], rest: Sequence[Unexplained], joints: Sequence[str]
    ) -> list[Unexplained]:
        """Dependences that are left beside structural ``findings``; ``rest``: those of the final model."""
        if self.sought is None:
            return list(rest)
        named = {f.evidence.get("gap_joint", f.joint) for f in findings}
        here = {joints[j] for j in self.sought}
        own = [u for u in self.unexplained if u.joint not in named]
        return [*own, *(u for u in rest if u.joint in here and u.joint not in {o.joint for o in own})]


def against_baseline(stage: SetupStage, baseline: IdentificationDocument, criteria: Criteria) -> BaselineStage:
    """Compare recordings with a baseline, and explain what has changed; DataError for another robot or model."""
    robot, experiments = _as_identified(stage.robot, baseline), [*stage.training, *stage.validation]
    # Of a document that is not stored; the test needs the length.
    samples = sum(e.q.shape[0] for e in experiments)
    recorded = RecordingReference(path=None, sha256="", sample_rate_hz=1.0 / experiments[0].dt, samples=samples)
    try:
        result = identify_experiment(experiments, robot, _options(baseline))
        now = identification_document(result, [recorded], with_numbers(robot, result.sign_smoothing))
        test = compare(baseline, now, criteria.alpha["changed_parameters"], robot, criteria)
    except Inconclusive as error:
        return BaselineStage(warnings=(f"not compared with the baseline: {error}",))
    return _Described(stage, baseline, result, test, robot, criteria).stage()


def _as_identified(robot: RobotConfig, baseline: IdentificationDocument) -> RobotConfig:
    """Configuration with the smoothing of the sign of the baseline, where it gives none."""
    smoothing = baseline.sign_smoothing or {}
    if set(smoothing) != {joint.name for joint in robot.joints}:
        return robot
    return with_numbers(robot, [smoothing[joint.name] for joint in robot.joints])


def _options(baseline: IdentificationDocument) -> Options:
    """Options of the baseline, as far as this version has them."""
    known = {field.name for field in fields(Options)}
    return Options(**{name: value for name, value in baseline.options.items() if name in known})


@dataclass(frozen=True, eq=False)
class _Described:
    """Test of change in the words of a diagnosis."""

    setup: SetupStage
    baseline: IdentificationDocument
    result: IdentificationResult
    test: ParameterChangeTest
    robot: RobotConfig
    criteria: Criteria

    def stage(self) -> BaselineStage:
        """Findings of the changes, and what they leave."""
        found = self.test.explained
        gaps = [self._gaps(found[:k]) for k in range(len(found) + 1)]
        findings = [self._finding(c, gaps[k][1], gaps[k + 1][1]) for k, c in enumerate(found)]
        rest = self._rest(gaps[-1][1])
        unexplained = self._unexplained()
        sought = sorted({self._joints.index(u.joint) for u in unexplained} | self._worse(gaps[-1][1]))
        if rest is not None:
            findings.append(rest)
            sought = sorted({*sought, self._joints.index(rest.joint)})
        return BaselineStage(
            tuple(findings),
            tuple(unexplained),
            gaps[0],
            gaps[-1],
            tuple(sought),
            tuple(self._entry(c) for c in found if c.change.structure),
            tuple(self._warnings()),
        )

    @property
    def _joints(self) -> list[str]:
        return [joint.name for joint in self.robot.joints]

    @property
    def _share(self) -> float:
        """Share of the difference that the explanation explains."""
        return 1.0 if self.test.explanation is None else self.test.explanation.share

    def _errors(self, found: Sequence[ExplainedChange]) -> list[Array]:
        """Torque errors (M, n) of every experiment with the baseline's parameters after some changes."""
        blocks, prepared = self.result.equations, self.result.prepared
        assert prepared is not None
        theta = self.test.before + sum(
            (c.change.directions @ c.coefficients for c in found if c.change.scores is None), start=np.zeros(1)
        )
        errors = [block.y - applied(block.x, theta) for block in blocks]
        terms = [c for c in found if c.change.scores is not None]
        if terms:
            numbers = instants(blocks, prepared.experiments[0].dt)
            effects = [(c.change.effect, place_of(c.change, self.robot)) for c in terms]
            columns = effect_columns(prepared, numbers, self.result.theta, effects)
            values = np.concatenate([c.coefficients for c in terms])
            errors = [e - x @ values for e, x in zip(errors, columns, strict=True)]
        return errors

    def _gaps(self, found: Sequence[ExplainedChange]) -> tuple[Gap, Gap]:
        """Gaps on training and validation data; without validation recordings both are of all data."""
        errors, count = self._errors(found), len(self.setup.training)
        parts = (slice(0, count), slice(count, None)) if self.setup.validation else (slice(None), slice(None))
        first, second = (self._gap(errors[part], [b.y for b in self.result.equations[part]]) for part in parts)
        return first, second

    def _gap(self, errors: Sequence[Array], torques: Sequence[Array]) -> Gap:
        e, y = np.concatenate(errors), np.concatenate(torques)
        each = 100 * np.linalg.norm(e, axis=0) / np.maximum(np.linalg.norm(y, axis=0), 1e-300)
        rms = np.sqrt(np.mean(e**2, axis=0))
        return Gap(
            all=100 * float(np.linalg.norm(e) / np.linalg.norm(y)),
            by_joint=dict(zip(self._joints, map(float, each), strict=True)),
            rms=dict(zip(self._joints, map(float, rms), strict=True)),
        )

    def _finding(self, found: ExplainedChange, before: Gap, after: Gap) -> Finding:
        effect = found.change.effect
        drop = {name: before.by_joint[name] ** 2 - after.by_joint[name] ** 2 for name in self._joints}
        most = max(drop, key=lambda name: drop[name])
        joint = most if effect.scope == "arm" else found.change.joints[0]
        rivals = found.rivals(self.criteria.close)
        return Finding(
            effect=effect.name,
            law=effect.law,
            joint=joint,
            other=found.change.joints[1] if len(found.change.joints) > 1 else None,
            kind="structure" if found.change.structure else "numbers",
            parameters=found.parameters,
            confidence=found.probability() * self._share,
            alternatives=[
                Alternative(effect=change.effect.name, joint=change.joints[0], score=odds)
                for change, odds in found.odds[: self.criteria.alternatives]
            ],
            gap_before=before.by_joint[most],
            gap_after=after.by_joint[most],
            evidence={
                "title": effect.change_title or effect.title,
                "description": found.words,
                "p_value": found.p_value,
                "std": found.deviations,
                "gap_joint": most,
                "ambiguous_with": [change.effect.name for change in rivals],
            },
        )

    def _entry(self, found: ExplainedChange) -> Entry:
        return entry_of(found.change.effect, place_of(found.change, self.robot), self.robot, found.parameters)

    def _rest(self, gap: Gap) -> Finding | None:
        """Finding of changed parameters that no change explains, if they change a joint's torque materially."""
        explanation = self.test.explanation
        if explanation is None or not (explanation.unexplained or explanation.p_rest < self.test.share):
            return None
        torque = np.concatenate([applied(block.x, explanation.rest) for block in self.result.equations])
        whole = np.concatenate([block.y for block in self.result.equations])
        share = 100 * np.linalg.norm(torque, axis=0) / np.maximum(np.linalg.norm(whole, axis=0), 1e-300)
        j = int(np.argmax(share))
        if share[j] < self.criteria.material_pct:
            return None
        std = explanation.difference.std
        numbers = explanation.unexplained or tuple(np.argsort(-np.abs(explanation.rest) / std)[:3].tolist())
        names = [explanation.difference.names[k] for k in numbers]
        each = "; ".join(
            f"{name} was {self.test.before[k]:.4g}, differs by {explanation.rest[k]:+.3g} "
            f"(standard deviation {std[k]:.2g})"
            for name, k in zip(names, numbers, strict=True)
        )
        return Finding(
            effect="changed_parameters",
            joint=self._joints[j],
            kind="numbers",
            parameters={name: float(explanation.rest[k]) for name, k in zip(names, numbers, strict=True)},
            confidence=1.0 - explanation.p_rest,
            alternatives=[],
            gap_before=gap.by_joint[self._joints[j]],
            gap_after=float(self.result.relative_error_pct_by_joint[j]),
            evidence={
                "title": "parameters that have changed",
                "description": "parameters differ from the baseline, and no effect of the catalogue explains it: "
                + each,
                "p_value": explanation.p_rest,
                "std": {name: float(std[k]) for name, k in zip(names, numbers, strict=True)},
                "gap_joint": self._joints[j],
                "ambiguous_with": [],
            },
        )

    def _unexplained(self) -> list[Unexplained]:
        """Changes of the residuals beyond those of the explanation, one for each joint."""
        found: dict[str, Unexplained] = {}
        errors = dict(zip(self._joints, self.result.relative_error_pct_by_joint, strict=True))
        for each in self.test.left.changed(self.test.share):
            before = self.baseline.relative_error_pct_by_joint.get(each.joint, 0.0)
            share = max(0.0, 1.0 - (before / max(float(errors[each.joint]), 1e-300)) ** 2)
            hint = f"changed since the baseline: {each.words.split(': ', 1)[1]}"
            entry = Unexplained(joint=each.joint, share_of_residual=share, varies_with=each.kind, hint=hint)
            found.setdefault(each.joint, entry)
        return list(found.values())

    def _worse(self, after: Gap) -> set[int]:
        """Joints of another motion than the baseline's with much larger residuals or errors after the changes.

        Their functions of the motion are not compared.
        """
        if not self.test.residuals.reason:
            return set()
        before = {each.joint: each for each in self.baseline.residual_statistics or ()}
        now = self.result.residual_statistics
        ratios = [sum(e.band_power) / max(sum(before[e.joint].band_power), 1e-300) for e in now if e.joint in before]
        errors = [
            after.by_joint[name] / max(self.baseline.relative_error_pct_by_joint.get(name, 0.0), 1e-300)
            for name in self._joints
        ]
        limits = self.criteria.larger_residuals, self.criteria.larger_error
        return {j for j, r in enumerate(ratios) if r > limits[0] ** 2} | {
            j for j, e in enumerate(errors) if e > limits[1]
        }

    def _warnings(self) -> list[str]:
        lines = [self.test.residuals.reason] if self.test.residuals.reason else []
        if self.baseline.verdict == "doubtful":
            lines.append(f"the baseline is doubtful: {self.baseline.reasons[0].message}")
        return lines
