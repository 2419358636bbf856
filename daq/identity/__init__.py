"""Identities on the wire: certificates of a plant, where their keys are, signatures, and who may do what."""

from pathlib import Path

VARIABLE = "ARMIDENT_KEYS"
"""Environment variable that names the folder of a plant's keys."""
OF_PLANT = Path("/etc/armident/keys")
"""Folder of a plant's keys, where it exists."""
