"""Limits of an exported file: what its format cannot hold, and which parameters the data did not determine."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Omission:
    """Part of the model that a format cannot hold.

    Parameters
    ----------
    part
        Part of the model with its joint and values, for example ``offset of joint_2: 0.31 N m``.
    reason
        Consequence or the next step, one sentence; empty: none.
    """

    part: str
    reason: str = ""


@dataclass(frozen=True)
class LimitationSheet:
    """Limits of an exported file.

    Parameters
    ----------
    format_name
        Name of the format.
    held
        Parts of the model that the file holds, one phrase each.
    omitted
        Parts of the model that the file does not hold.
    undetermined
        Names of the parameters that the recordings did not determine, with the reason.
    remarks
        Further sentences for the user.
    """

    format_name: str
    held: tuple[str, ...]
    omitted: tuple[Omission, ...] = ()
    undetermined: dict[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def markdown(self, title: str) -> str:
        """Return the sheet as a Markdown page.

        Parameters
        ----------
        title
            First heading.
        """
        omitted = [f"{o.part}{': ' + o.reason if o.reason else ''}" for o in self.omitted]
        undetermined = [f"`{name}`: {reason}" for name, reason in self.undetermined.items()]
        sections = (
            ("In the file", self.held, "nothing"),
            ("Not in the file", omitted, "nothing is left out"),
            ("Not determined by the recordings", undetermined, "every parameter was determined"),
            ("Remarks", self.remarks, ""),
        )
        lines = [f"# {title}"]
        for heading, entries, otherwise in sections:
            if entries or otherwise:
                lines += ["", f"## {heading}", "", *(f"- {entry}" for entry in entries or (otherwise,))]
        return "\n".join(lines) + "\n"

    def document(self) -> dict[str, Any]:
        """Return the sheet as lists and dictionaries for JSON."""
        return {
            "format": self.format_name,
            "held": list(self.held),
            "omitted": [{"part": o.part, "reason": o.reason} for o in self.omitted],
            "undetermined": dict(self.undetermined),
            "remarks": list(self.remarks),
        }
