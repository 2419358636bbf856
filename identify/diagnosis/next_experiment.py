"""Recommended next experiment: required contents of the recording, in words and as a command."""

from collections.abc import Sequence

from armident.identify.effects.effect import Effect
from armident.identify.effects.wiring import SignalMistake

CONTAINS = {
    "slow": "slow moves, under a twentieth of the joint's top speed",
    "speeds": "moves at several speeds, from slow to the fastest allowed",
    "reversals": "many changes of direction",
    "standstill": "stops of a second between the moves",
    "range": "moves from one end of the joint's range to the other",
    "load": "postures with the arm stretched out and folded, and the load that it usually carries",
    "accelerations": "short, hard moves",
    "repeats": "the same motion again after an hour of work",
    "independent": "moves of each of the joints alone, of both together, and of both against each other",
}
"""Motion that each ``excitation`` keyword of an effect requires."""


def recommended_experiment(effect: Effect, joint: str, rivals: Sequence[Effect] = ()) -> str:
    """Return the experiment that raises the confidence of a finding or separates it from its rivals (best first)."""
    others = [rival for rival in rivals if rival.name != effect.name]
    kinds = list(dict.fromkeys(tag for e in (effect, *others[:1]) for tag in e.excitation))
    parts = [CONTAINS.get(tag, tag) for tag in kinds]
    contents = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])}, and {parts[-1]}"
    if not others:
        if isinstance(effect, SignalMistake):
            return f"Check the wiring and the configuration of {joint}, then record the same motion again."
        return f"To confirm {effect.title} at {joint}, record {contents}: {_command(effect, joint)}"
    rival = others[0]
    text = f"To separate {effect.title} from {rival.title} at {joint}, record {contents}"
    if isinstance(effect, SignalMistake) or isinstance(rival, SignalMistake):
        return f"{text}, after checking the wiring."
    return f"{text}: {_command(effect, joint)} --against {rival.name}"


def _command(effect: Effect, joint: str) -> str:
    place = "" if effect.scope == "arm" else f" --joint {joint}"
    return f"armident trajectory --for {effect.name}{place}"
