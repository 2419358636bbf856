"""What a user may choose of an identification."""

from dataclasses import dataclass
from typing import Literal

from configs import ConfigError
from identify.estimators.idim_piv import MAX_AR_ORDER

Method = Literal["idim-piv", "idim-iv", "idim-ls"]
METHODS: tuple[Method, ...] = ("idim-piv", "idim-iv", "idim-ls")
DERIVATIVES = ("irwsm", "irwsm2", "bandpass")
CONTROLLERS = ("crc", "known")


@dataclass(frozen=True)
class Options:
    """What a user may choose; everything has a default that needs no knowledge.

    Parameters
    ----------
    method
        ``idim-piv``, ``idim-iv`` or ``idim-ls``.
    derivatives
        ``irwsm``, ``irwsm2`` or ``bandpass``; ``None``: IRWSM 1, except that IDIM-LS uses the filters of a published
        fit where the robot's configuration has them.
    controller
        ``crc`` identifies it by correlation analysis, ``known`` takes the gains of the configuration.
    decimation
        Keep one sample of so many; ``None``: from the bandwidth.
    nvr
        Noise-variance ratio of the smoother; ``None``: by likelihood.
    bandwidth_hz
        Closed-loop bandwidth; ``None``: from the configuration, else from the data.
    max_ar_order
        Highest order of the noise models of IDIM-PIV.
    """

    method: Method = "idim-piv"
    derivatives: Literal["irwsm", "irwsm2", "bandpass"] | None = None
    controller: Literal["crc", "known"] = "crc"
    decimation: int | None = None
    nvr: float | None = None
    bandwidth_hz: float | None = None
    max_ar_order: int = MAX_AR_ORDER

    def __post_init__(self) -> None:
        """Refuse what is not offered, naming what is."""
        for name, value, offered in (
            ("method", self.method, METHODS),
            ("derivatives", self.derivatives, (None, *DERIVATIVES)),
            ("controller", self.controller, CONTROLLERS),
        ):
            if value not in offered:
                raise ConfigError(f"{name}: {value!r} is not one of {', '.join(str(o) for o in offered if o)}")
        if self.decimation is not None and self.decimation < 1:
            raise ConfigError(f"decimation: expected a number of samples, got {self.decimation}")
