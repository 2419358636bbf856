"""Options of an identification."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, cast, get_args

from armident.identify.command_options import documented, option
from armident.identify.estimators.methods import METHODS, Method
from armident.identify.regression.orders import MAX_AR_ORDER
from armident.identify.signals.choices import NVR_RULES, DerivativesName, NvrRule

if TYPE_CHECKING:
    from armident.configs import SessionConfig

ControllerName = Literal["crc", "parametric", "known"]
CONTROLLERS: tuple[ControllerName, ...] = get_args(ControllerName)
NoiseModelName = Literal["black-box", "grey-box"]


def parse_nvr(text: str) -> float | NvrRule:
    """Noise-variance ratio from text: a number, or the name of a rule (which `Options` checks)."""
    try:
        return float(text)
    except ValueError:
        return cast(NvrRule, text)


def parse_decimation(text: str) -> int | Literal["noise"]:
    """Decimation from text: a number, or ``noise`` (which `Options` checks)."""
    try:
        return int(text)
    except ValueError:
        return cast(Literal["noise"], text)


@documented
@dataclass(frozen=True)
class Options:
    """Options of an identification; every default works without knowledge of the robot."""

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012 - pydantic's name, for the keys of a session

    method: Method = option("Estimator.", "idim-piv")
    derivatives: DerivativesName | None = option(
        "Derivatives of the positions (thesis 5.1.2, 2.3.1). [default: irwsm; of idim-ls the published filters]", None
    )
    nvr: float | NvrRule | None = option(
        f"Noise-variance ratio of the smoother: a number, {', '.join(NVR_RULES[:-1])} or {NVR_RULES[-1]}. "
        f"[default: {NVR_RULES[0]}]",
        None,
        parser=parse_nvr,
        metavar="<str>",
    )
    controller: ControllerName = option(
        "Controller of the simulated loop: crc (impulse response), parametric (cascade or PID) or known (configured).",
        "crc",
    )
    noise_model: NoiseModelName = option(
        "Noise model of idim-piv: black-box (thesis 6.27), or grey-box, position noise through the controller (6.28).",
        "black-box",
    )
    max_ar_order: int = option("Highest order of the noise models.", MAX_AR_ORDER, min=0)
    bandwidth_hz: float | None = option("Closed-loop bandwidth, Hz. [default: as configured, or estimated]", None)
    decimation: int | Literal["noise"] | None = option(
        "Decimation factor, or noise: from its correlation time (thesis 6.2.3). [default: from the bandwidth]",
        None,
        parser=parse_decimation,
        metavar="<str>",
    )
    weighted: bool = option("Weight each joint of idim-ls by its noise (thesis 2.23).", True)
    physical: bool = option("Also compute the nearest physically consistent parameters.", False, flag="--physical")

    def __post_init__(self) -> None:
        """Refuse values that are not offered; the message names those that are."""
        from armident.configs.errors import ConfigError

        for name, offered in (
            ("method", METHODS),
            ("derivatives", (None, *get_args(DerivativesName))),
            ("controller", CONTROLLERS),
            ("noise_model", get_args(NoiseModelName)),
        ):
            if getattr(self, name) not in offered:
                raise ConfigError(
                    f"{name}: {getattr(self, name)!r} is not one of {', '.join(str(o) for o in offered if o)}"
                )
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


def options_of(session: "SessionConfig") -> Options:
    """Return the options of the worker of a cell; a ConfigError names the key that is wrong."""
    from pydantic import TypeAdapter, ValidationError

    from armident.configs.errors import ConfigError

    # The filters of a published fit are for a comparison with it, not for a cell.
    given = {"derivatives": "irwsm"} | session.identification
    try:
        return TypeAdapter(Options).validate_python(given)
    except ValidationError as error:
        problem = error.errors()[0]
        keys = ".".join(str(key) for key in ("identification", *problem["loc"]))
        raise ConfigError(f"{keys}: {problem['msg']}") from error
    except ConfigError as error:
        raise ConfigError(f"identification.{error}") from error
