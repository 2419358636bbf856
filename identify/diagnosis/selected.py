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
    """A selected effect with its step; ``confirmation``: of the final model over that ``without`` it."""

    entry: Entry
    step: SelectionStep
    addition: Addition
    confirmation: Confirmation | None = None
    without: ModelState | None = None
    p_value: float = 0.0

    def conventional(self, state: ModelState, uncertain: float) -> bool:
        """True for a part of every model, or within the drives' sampling convention (``uncertain``, s): no finding."""
        effect = self.addition.candidate.effect
        if of_recording(self.entry):
            values = np.array([self.entry.parameters[p.name] for p in effect.linear])
        else:
            values = state.values_of(state.term_of(self.entry))[0]
        return effect.is_convention(values, uncertain)
