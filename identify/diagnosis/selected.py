"""Effects that a diagnosis has selected."""

from dataclasses import dataclass

import numpy as np

from armident.configs.schema.robot import Effect as Entry
from armident.identify.diagnosis.candidate_comparison import Addition, SelectionStep
from armident.identify.diagnosis.confirmation import Confirmation
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.effects.recording_corrections import of_recording


@dataclass(frozen=True, eq=False)
class Selected:
    """An effect that was selected.

    Parameters
    ----------
    entry
        Its entry in the configuration.
    step
        Step in which it was compared with the others, without it in the model.
    addition
        Test of the effect in that step.
    confirmation
        Comparison of the final models with and without it on the report part; ``None`` before that.
    without
        Final model without it; ``None`` before the comparison.
    p_value
        Probability of its parameters in the final model if it is not there.
    """

    entry: Entry
    step: SelectionStep
    addition: Addition
    confirmation: Confirmation | None = None
    without: ModelState | None = None
    p_value: float = 0.0

    def conventional(self, state: ModelState, uncertain: float) -> bool:
        """True if the effect is a part of every model, or within the sampling convention of drives: no finding.

        ``state``: final model; ``uncertain``: time by which the common instant of all torques is uncertain, s.
        """
        effect = self.addition.candidate.effect
        if of_recording(self.entry):
            values = np.array([self.entry.parameters[p.name] for p in effect.linear])
        else:
            values = state.values_of(state.term_of(self.entry))[0]
        return effect.is_convention(values, uncertain)
