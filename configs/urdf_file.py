"""Reading of the XML of a URDF file."""

import xml.etree.ElementTree as ET
from pathlib import Path

from armident.configs.errors import ConfigError

LONGEST = 500
"""Maximum length of an attribute in characters; longer ones are refused."""

XACRO = "xacro}"
"""End of the namespace of xacro elements, such as ``{http://www.ros.org/wiki/xacro}macro``."""


def expand(file: Path) -> str:
    """Text with the command that makes a URDF of a xacro file.

    Parameters
    ----------
    file
        Path of the file.
    """
    stem = file.name.split(".")[0]
    return f"this is xacro, expand it first: xacro {file.name} > {stem}_expanded.urdf"


def parse_urdf(file: Path) -> ET.Element:
    """Root element of a URDF file; xacro is refused by its name.

    Parameters
    ----------
    file
        Path of the file.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not XML, is xacro, or has an attribute of more than ``LONGEST`` characters.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror or 'input error'}") from error
    try:
        root = ET.fromstring(content)
    except ET.ParseError as error:
        if b"xacro:" in content and "unbound prefix" in str(error):
            raise ConfigError(f"{file}: {expand(file)}") from error
        line, column = error.position
        raise ConfigError(f"{file}: not valid XML: line {line}, column {column + 1}") from error
    except (LookupError, ValueError) as error:
        raise ConfigError(f"{file}: not valid XML: unknown encoding") from error
    if any(XACRO in element.tag for element in root.iter()):
        raise ConfigError(f"{file}: {expand(file)}")
    for element in root.iter():
        for key, value in element.items():
            if len(value) > LONGEST:
                raise ConfigError(f"{file}: {element.tag:.40} {key:.40}: {len(value)} characters, expected {LONGEST}")
    return root
