"""Options of an identification."""

from dataclasses import dataclass
from typing import Literal, cast, get_args

from armident.configs import ConfigError
from armident.identify.regression.equations import MAX_AR_ORDER
from armident.identify.signals.differentiate import NVR_RULES, NvrRule

Method = Literal["idim-piv", "idim-iv", "idim-ls", "didim", "clie", "cloe", "sep-pem"]
METHODS: tuple[Method, ...] = get_args(Method)
DerivativesName = Literal["irwsm", "irwsm2", "bandpass"]
DERIVATIVES: tuple[DerivativesName, ...] = get_args(DerivativesName)
ControllerName = Literal["crc", "parametric", "known"]
CONTROLLERS: tuple[ControllerName, ...] = get_args(ControllerName)
NoiseModelName = Literal["black-box", "grey-box"]
NOISE_MODELS: tuple[NoiseModelName, ...] = get_args(NoiseModelName)


@dataclass(frozen=True)
class Options:
    """Options of an identification; every default works without knowledge of the robot.

    Parameters
    ----------
    method
        ``idim-piv``, ``idim-iv``, ``idim-ls``, ``didim``, ``clie``, ``cloe`` or ``sep-pem``.
    derivatives
        ``irwsm``, ``irwsm2`` or ``bandpass`` (5.1.2, 2.3.1); ``None``: IRWSM 1, except that IDIM-LS uses the filters of
        a published fit where the robot's configuration has them.
    controller
        ``crc`` identifies it by correlation analysis, ``parametric`` as a cascade or PID by refined instrumental
        variables, ``known`` takes the gains of the configuration.
    decimation
        Keep one sample of so many; ``noise``: from the correlation time of the noise (6.2.3); ``None``: from the
        bandwidth.
    nvr
        Noise-variance ratio of the smoother, or the rule to find it: ``automatic``, ``cross-validation``,
        ``likelihood``, ``tracking-error``; ``None``: ``automatic``.
    bandwidth_hz
        Closed-loop bandwidth, Hz; ``None``: from the configuration, else from the data.
    noise_model
        Of IDIM-PIV: ``black-box`` (6.27), or ``grey-box``, position noise through the controller (6.28).
    max_ar_order
        Highest order of the noise models of IDIM-PIV and SEP-PEM.
    weighted
        Weight each joint of IDIM-LS by its noise (2.23) or not (2.22).
    physical
        True to compute the nearest physically consistent arm as well.
    """

    method: Method = "idim-piv"
    derivatives: DerivativesName | None = None
    controller: ControllerName = "crc"
    decimation: int | Literal["noise"] | None = None
    nvr: float | NvrRule | None = None
    bandwidth_hz: float | None = None
    noise_model: NoiseModelName = "black-box"
    max_ar_order: int = MAX_AR_ORDER
    weighted: bool = True
    physical: bool = False

    def __post_init__(self) -> None:
        """Refuse values that are not offered; the message names those that are."""
        for name, value, offered in (
            ("method", self.method, METHODS),
            ("derivatives", self.derivatives, (None, *DERIVATIVES)),
            ("controller", self.controller, CONTROLLERS),
            ("noise_model", self.noise_model, NOISE_MODELS),
        ):
            if value not in offered:
                raise ConfigError(f"{name}: {value!r} is not one of {', '.join(str(o) for o in offered if o)}")
        if self.decimation not in (None, "noise") and not (isinstance(self.decimation, int) and self.decimation >= 1):
            raise ConfigError(f"decimation: expected a number of samples or noise, got {self.decimation}")
        if self.max_ar_order < 0:
            raise ConfigError(f"max_ar_order: expected 0 or more, got {self.max_ar_order}")
        if self.bandwidth_hz is not None and not self.bandwidth_hz > 0:
            raise ConfigError(f"bandwidth_hz: expected a frequency above 0, got {self.bandwidth_hz}")
        if isinstance(self.nvr, str):
            if self.nvr not in NVR_RULES:
                raise ConfigError(f"nvr: {self.nvr!r} is neither a number nor one of {', '.join(NVR_RULES)}")
        elif self.nvr is not None and not self.nvr > 0:
            raise ConfigError(f"nvr: expected a ratio above 0, got {self.nvr}")


def parse_nvr(text: str | None) -> float | NvrRule | None:
    """Noise-variance ratio from text: a number, or the name of a rule (which `Options` checks)."""
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        return cast(NvrRule, text)


def parse_decimation(text: str | None) -> int | Literal["noise"] | None:
    """Decimation from text: a number, or ``noise`` (which `Options` checks)."""
    if text is None:
        return None
    try:
        return int(text)
    except ValueError:
        return cast(Literal["noise"], text)
