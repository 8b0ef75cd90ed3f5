"""The one error tree.

::

    RmpaError
    ├── ConfigError            a flag, variable or file says something that cannot be
    ├── StartError             this machine does not allow what was asked (port taken, name taken)
    ├── LocalProtocolError     our own code broke a protocol: a bug here
    ├── RemoteProtocolError    the other side broke a protocol: close that connection, count it
    │   └── LimitExceeded      … by claiming more than ``core.limits`` allows
    ├── PeerRefused            a peer said no, with its reason
    └── UnreachableError       no program answers at an address where one should
        └── OutOfDescriptors   … or this process has no file descriptor left to ask it

Errors hold fields and build their text in ``__str__``. A text says what happened, where, and what to do. ``code`` is
its code of ``core.codes``, by its class or by what raises it; the command line and the log show it behind the text.
"""

from __future__ import annotations

import functools
import re
import sys
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

_PAGE: Final = re.compile(r"(?<![\w/])docs/[\w/-]+\.md(?:#[\w-]+)?")


class RmpaError(Exception):
    """Root of every error that this package raises on purpose."""

    code: str = "failed"

    def __init__(self, *args: object, code: str = "") -> None:
        super().__init__(*args)
        self.code = code or self.code


@dataclass(eq=False)
class ConfigError(RmpaError):
    """A setting cannot be used.

    Args:
        source: Where it was written: a flag (``--port``), a variable (``RMPA_PORT``) or a key (``mesh.port``).
        problem: What is wrong with it.
        remedy: What to write instead; may be empty.
        path: The file, for a key in a file.
        line: The line in that file, counted from 1, if known.
    """

    source: str
    problem: str
    remedy: str = ""
    path: Path | None = None
    line: int | None = None
    code: str = field(default="invalid-value", kw_only=True)

    def __str__(self) -> str:
        """Say ``file:line: key: problem; remedy``."""
        where = ""
        if self.path is not None:
            where = f"{self.path}:{self.line}: " if self.line is not None else f"{self.path}: "
        return _advised(f"{where}{self.source}: {self.problem}", self.remedy)


@dataclass(eq=False)
class StartError(RmpaError):
    """The agent, or a part of it, cannot start on this machine as asked."""

    what: str
    problem: str
    remedy: str = ""
    code: str = field(default="cannot-start", kw_only=True)

    def __str__(self) -> str:
        """Say ``what: problem; remedy``."""
        return _advised(f"{self.what}: {self.problem}", self.remedy)


class LocalProtocolError(RmpaError):
    """Our side used a protocol machine in a way that its state does not allow."""

    code = "internal-error"


class RemoteProtocolError(RmpaError):
    """The other side sent bytes that its protocol does not allow."""

    code = "protocol-error"


@dataclass(eq=False)
class LimitExceeded(RemoteProtocolError):  # noqa: N818 - the name says what happened, as in websockets
    """The other side claimed a size beyond a limit; nothing of it was stored."""

    what: str
    claimed: int
    limit: int
    code: str = field(default="limit-reached", kw_only=True)

    def __str__(self) -> str:
        """Say what was claimed and what is allowed."""
        return f"{self.what} of {self.claimed} bytes exceeds the limit of {self.limit}"


# In the answer of an agent that does not know a question.
UNKNOWN_QUESTION: Final = "does not know the question"


@dataclass(eq=False)
class PeerRefused(RmpaError):  # noqa: N818 - an event's name
    """A peer answered, and the answer was no."""

    peer: str
    reason: str
    remedy: str = ""
    code: str = field(default="refused", kw_only=True)

    @property
    def unknown(self) -> bool:
        """Whether the peer's agent does not know the question: it is of an earlier release."""
        return UNKNOWN_QUESTION in self.reason

    def __str__(self) -> str:
        """``<peer> refused: reason; remedy``."""
        return _advised(f"{self.peer} refused: {self.reason}", self.remedy)


# By the first word of what does not answer.
_UNREACHABLE = {
    "agent": "no-agent",
    "ROS master": "master-unreachable",
    "server": "no-server",
    "service": "no-server",
    "gateway": "site-unreachable",
    "site": "site-unreachable",
    "XML-RPC": "node-unreachable",
    "machine": "unresolved-name",
    "linked peer": "unknown-name",
    "authority": "certificate-trouble",
}


@dataclass(eq=False)
class UnreachableError(RmpaError):
    """No program answers at an address where one should."""

    what: str
    where: str
    remedy: str = ""
    code: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        """Take the code from what does not answer, where none is given."""
        kinds = (code for word, code in _UNREACHABLE.items() if self.what.startswith(word))
        self.code = self.code or next(kinds, "unreachable")

    def __str__(self) -> str:
        """``no <what> answers at <where>; remedy``."""
        return _advised(f"no {self.what} answers at {self.where}", self.remedy)


@dataclass(eq=False)
class OutOfDescriptors(UnreachableError):  # noqa: N818 - the name says what happened
    """This process has no file descriptor left for a connection; the other side was not asked."""

    code: str = field(default="out-of-descriptors", kw_only=True)

    def __str__(self) -> str:
        """Say what could not be reached, why, and what to do."""
        return _advised(
            f"no file descriptor is left for a connection to the {self.what} at {self.where}", self.remedy
        )


def missing_extra(name: str) -> str:
    """What adds an extra to this rmpa: pip takes the one that its Python has, and none from an index."""
    if find_spec("pip") is None:  # pipx, uv
        return f"the command that installed rmpa, with the extra {name}: docs/start/install.md#the-extras"
    return f"{sys.executable} -m pip install 'rmpa[{name}]'"


def with_places(text: str) -> str:
    """A text for users whose pages, such as ``docs/guides/trust.md``, say where this rmpa has them."""
    if "docs/" not in text:
        return text
    before, after = _place_of_docs()
    return _PAGE.sub(rf"{before}\g<0>{after}", text)


@functools.cache
def _place_of_docs() -> tuple[str, str]:
    """What stands before and behind ``docs/….md``: a folder of this machine, an address, or else in words."""
    from importlib.metadata import PackageNotFoundError, metadata  # noqa: PLC0415 - they load 50 modules
    from pathlib import Path  # noqa: PLC0415

    source = Path(__file__).parents[2]
    if source.name == "src" and (source.parent / "docs").is_dir():
        return "", ""  # a clone
    for place in (f"{sys.prefix}/share/doc/rmpa/", "/usr/share/doc/rmpa/"):
        if Path(place, "docs").is_dir():
            return place, ""
    try:
        urls = dict(url.split(", ", 1) for url in metadata("rmpa").get_all("Project-URL") or ())
    except PackageNotFoundError:
        urls = {}
    before, docs, _ = urls.get("Documentation", "").partition("docs/")
    return (before, "") if docs and ".invalid/" not in before else ("", " of RMPA's repository")


def _advised(text: str, remedy: str) -> str:
    return f"{text}; {remedy}" if remedy else text
