"""Reading of the XML of a URDF file."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from armident.configs.errors import ConfigError

LONGEST = 500
"""Maximum length of an attribute in characters; longer ones are refused."""

XACRO = "xacro}"
"""End of the namespace of xacro elements, such as ``{http://www.ros.org/wiki/xacro}macro``."""


_ELEMENTS: Mapping[str, tuple[str, ...]] = {
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
}
"""Elements that are read, by the element around them."""
_ATTRIBUTES: Mapping[str, tuple[str, ...]] = {
    "joint": ("name", "type"),
    "link": ("name",),
    "origin": ("xyz", "rpy", "quat_xyzw"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "velocity", "effort"),
    "parent": ("link",),
    "child": ("link",),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
}
"""Attributes that are read, by element."""


def expand(file: Path) -> str:
    """Text with the command that makes a URDF of a xacro file."""
    stem = file.name.split(".")[0]
    return f"this is xacro, expand it first: xacro {file.name} > {stem}_expanded.urdf"


def parse_urdf(file: Path) -> ET.Element:
    """Root element of a URDF file; raises ConfigError if it is unreadable or xacro, or has names in another case."""
    try:
        content = file.read_bytes().lstrip()
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror or 'input error'}") from error
    root = _without_namespace(_parsed(file, content))
    if any(XACRO in element.tag for element in root.iter()):
        raise ConfigError(f"{file}: {expand(file)}")
    for element in root.iter():
        for key, value in element.items():
            if len(value) > LONGEST:
                raise ConfigError(f"{file}: {element.tag:.40} {key:.40}: {len(value)} characters, expected {LONGEST}")
    if root.tag == "robot":
        _check_names(file, root)
    return root


def limit_places(file: Path, joints: Iterable[str]) -> tuple[str, ...]:
    """File and line of the limits of joints of a URDF; the file alone where its text has none in plain sight."""
    text = file.read_text(encoding="utf-8", errors="replace")
    places = []
    for joint in joints:
        name = re.escape(joint)
        found = re.search(rf"<joint\b[^>]*?\bname\s*=\s*[\"']{name}[\"'].*?(<limit\b|</joint>)", text, re.DOTALL)
        line = 0 if found is None or found[1] == "</joint>" else text.count("\n", 0, found.start(1)) + 1
        places.append(f"{file.name}, line {line}" if line else file.name)
    return tuple(places)


def _parsed(file: Path, content: bytes) -> ET.Element:
    """Return the root element; text without a declared encoding may be Windows-1252, as in comments."""
    try:
        return ET.fromstring(content)
    except ET.ParseError as error:
        if b"xacro:" in content and "unbound prefix" in str(error):
            raise ConfigError(f"{file}: {expand(file)}") from error
        if b"encoding" not in content[:100]:
            try:
                content.decode()
            except UnicodeDecodeError:
                return _parsed(file, content.decode("cp1252", errors="replace").encode())
        line, column = error.position
        raise ConfigError(f"{file}: not valid XML: line {line}, column {column + 1}") from error
    except (LookupError, ValueError) as error:
        raise ConfigError(f"{file}: not valid XML: unknown encoding") from error


def _without_namespace(root: ET.Element) -> ET.Element:
    """Return the tree with plain names of the elements that are in the namespace of the root, as Drake writes them."""
    space, brace, _ = root.tag.rpartition("}")
    if brace and not root.tag.endswith(XACRO):
        for element in root.iter():
            element.tag = element.tag.removeprefix(space + brace)
    return root


def _check_names(file: Path, root: ET.Element) -> None:
    """Refuse names in capitals, which readers of URDF pass over, and expressions of xacro in names."""
    _refuse_capitals(f"{file}: robot", [element.tag for element in root], ("joint", "link"))
    for element in [*root.findall("joint"), *root.findall("link")]:
        where = f"{file}: {element.tag} {element.get('name', '')!r:.80}"
        if any(each in value for value in element.attrib.values() for each in ("${", "$(")):
            raise ConfigError(f"{where}: {expand(file)}")
        _refuse_capitals(where, list(element.keys()), _ATTRIBUTES[element.tag])
        for part in (element, *element.findall("inertial")):
            _refuse_capitals(where, [child.tag for child in part], _ELEMENTS[part.tag])
            for child in part:
                _refuse_capitals(f"{where}: {child.tag}", list(child.keys()), _ATTRIBUTES.get(child.tag, ()))


def _refuse_capitals(where: str, found: Iterable[str], known: Sequence[str]) -> None:
    for name in found:
        if name not in known and name.lower() in known:
            raise ConfigError(f"{where}: {name} is no name of URDF, which has {name.lower()}")
