"""Options of a diagnosis."""

from dataclasses import dataclass

from armident.identify.command_options import documented, option


@documented
@dataclass(frozen=True)
class DiagnosisOptions:
    """Options of a diagnosis."""

    false_alarm_rate: float = option(
        "Probability of a finding with a complete model.", 0.01, flag="--false-alarms", min=1e-6, max=0.5
    )
    material: float = option(
        "Least change of a joint's torque by a finding, percent; smaller effects are listed as negligible.",
        0.2,
        min=0.0,
        max=100.0,
        metavar="PCT",
    )
    time_limit_s: float | None = option(
        "End the search for effects after this time, s, with what it has found.",
        None,
        flag="--time-limit",
        min=0.0,
        metavar="S",
    )
