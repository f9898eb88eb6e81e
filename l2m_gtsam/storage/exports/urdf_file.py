"""A URDF of a robot as text, and where in it links and joints stand."""

import re
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat

from l2m_gtsam.errors import ConfigError

ENCODINGS = (None, "utf-8", "us-ascii", "ascii")
TAG_END = re.compile(rb"""[^"'>]*(?:"[^"]*"[^"'>]*|'[^']*'[^"'>]*)*>""")


@dataclass
class Joint:
    """A joint between two links, and the bytes it takes."""

    name: str
    start: int
    end: int = 0
    parent: str = ""
    child: str = ""


@dataclass
class UrdfFile:
    """A URDF and what stands in it where.

    Attributes
    ----------
    name
        Of the file, for messages.
    data
        Its content.
    links
        Names of its links.
    joints
        Its joints in their order.
    end
        Where the end tag of the robot begins.
    """

    name: str
    data: bytes
    links: list[str] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    end: int = -1

    @classmethod
    def parse(cls, name: str, data: bytes) -> "UrdfFile":
        """Read the links and joints of a URDF; entities and document types are refused.

        Raises
        ------
        ConfigError
            It is no XML in UTF-8, no robot, brings definitions of its own, or still is a xacro.
        """
        found = cls(name, data)
        try:
            data.decode("utf-8")
            _Reader(found).read()
        except UnicodeDecodeError as error:
            raise ConfigError(f"{name}: is not text in UTF-8; save it so") from error
        except expat.ExpatError as error:
            raise ConfigError(f"{name}: not valid XML: {error}") from error
        return found

    def joint_of(self, link: str) -> Joint | None:
        """Return the joint whose child is a link, if there is one."""
        return next((joint for joint in self.joints if joint.child == link), None)

    def ancestors(self, link: str) -> list[str]:
        """Return the links above one, from near to far."""
        above: list[str] = []
        joint = self.joint_of(link)
        while joint is not None and joint.parent not in above:
            above.append(joint.parent)
            joint = self.joint_of(joint.parent)
        return above


class _Reader:
    """Goes once through the elements of a URDF."""

    def __init__(self, found: UrdfFile) -> None:
        self._found, self._depth = found, 0
        self._joint: Joint | None = None
        self._parser: Any = expat.ParserCreate()
        self._parser.XmlDeclHandler = self._declaration
        self._parser.StartDoctypeDeclHandler = self._doctype
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._finish

    def read(self) -> None:
        self._parser.Parse(self._found.data, True)

    def _declaration(self, _version: str, encoding: str | None, _standalone: int) -> None:
        if encoding is not None and encoding.lower() not in ENCODINGS:
            raise ConfigError(f"{self._found.name}: its encoding is {encoding}; save it as UTF-8")

    def _doctype(self, *_: object) -> None:
        raise ConfigError(
            f"{self._found.name}: has a document type definition, which a URDF does not need and "
            "which is not read; remove it"
        )

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        if self._depth == 0 and tag != "robot":
            raise ConfigError(f"{self._found.name}: not a URDF: its root is <{tag}>, not <robot>")
        if tag.startswith("xacro:"):
            raise ConfigError(f"{self._found.name}: is a xacro file; run `xacro` on it first")
        if self._depth == 1 and tag == "link":
            self._found.links.append(attributes.get("name", ""))
        elif self._depth == 1 and tag == "joint":
            self._joint = Joint(attributes.get("name", ""), self._parser.CurrentByteIndex)
        elif self._depth == 2 and self._joint is not None and tag in ("parent", "child"):
            setattr(self._joint, tag, attributes.get("link", ""))
        self._depth += 1

    def _finish(self, tag: str) -> None:
        self._depth -= 1
        here = self._parser.CurrentByteIndex
        if self._depth == 0:
            self._found.end = here
        elif self._depth == 1 and self._joint is not None:
            self._joint.end = self._end_of(self._joint.start, here)
            self._found.joints.append(self._joint)
            self._joint = None

    def _end_of(self, start: int, here: int) -> int:
        """Return where an element ends, of which the parser tells where its end tag begins."""
        data = self._found.data
        first = TAG_END.match(data, start)
        if first is not None and data[first.end() - 2 : first.end()] == b"/>":
            return first.end()
        return data.index(b">", here) + 1
