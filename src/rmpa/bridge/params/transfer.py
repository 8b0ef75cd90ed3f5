"""Which parameters peers may read, set and follow, and how they cross. Without I/O.

Values cross as the text of an XML-RPC response (``ros.wire.xmlrpc``), so that their types survive: JSON has neither
binary data nor dates. ``bridge.rpc`` carries large ones aside of commands. ::

    param.get {key}                → {text}
    param.names {}                 → {text}       a list of the names of all parameters that may be read
    param.set {key, text}          → {count}
    param.delete {key}             → {}
    param.follow {keys}            → {refused}    from now on the owner asks:
    param.value {key, text}        → null         the value now; text null: there is none
    param.value {key, refused}     → null         it may not be followed any more
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.config import limits as config_limits
from rmpa.config.rules import SIM_TIME, FollowRule, overlap, untouchable
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import matches_any
from rmpa.ros import limits as ros_limits
from rmpa.ros.master.parameters import leaves

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.config.settings import Settings
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_ROOT: Final = "the root holds every parameter: name those that you mean"


def replaced(names: Iterable[str], at: str, present: XmlRpcValue) -> Iterator[str]:
    """Yield the parameters that are lost if others are set: a value becomes a namespace, or a namespace a value.

    Args:
        names: The parameters that are set; all are ``at``, or below it.
        at: The name of the present value, a namespace around them all.
        present: The value; empty if there is none.
    """
    given = set(names)
    around = set(chain.from_iterable(map(_namespaces, given)))
    for name, _ in leaves(at, present):
        if name in around or not given.isdisjoint(_namespaces(name)):
            yield name


def _namespaces(name: str) -> list[str]:
    """The namespaces around a parameter, without the root."""
    parts = name.split("/")
    return ["/".join(parts[:length]) for length in range(2, len(parts))]


def key_problem(key: object) -> str:
    """Why a key from a peer is not a parameter's global name; empty if it is one."""
    if not isinstance(key, str) or not key.startswith("/"):
        return f"{str(key)[:100]!r} is not the global name of a parameter"
    if len(key) > config_limits.CROSSING_NAME_MAX or key.count("/") > ros_limits.PARAM_DEPTH_MAX:
        return f"the name of a parameter has {len(key)} characters, or too many namespaces"
    # Masters accept any characters, and names such as joint-1 have long been in use.
    if "//" in key or not key.isprintable() or any(c.isspace() for c in key):
        return f"{key[:100]!r} is not a parameter's name"
    return ""


def why_not_get(settings: Settings, key: str) -> str:
    """Why peers may not read a parameter; empty if they may."""
    if matches_any(settings.params.remote_get, key):
        return ""
    return f"{key} may not be read by peers: no glob of params.remote_get fits"


def why_not_set(settings: Settings, key: str) -> str:
    """Why peers may not set or delete a parameter; empty if they may."""
    if key == "/":
        return _ROOT
    if why := untouchable(key):
        return f"{key} is never set from another module: {why}"
    for rule in settings.params.follow:
        if overlap(rule.to, key):
            owner = f"{rule.owner}:{rule.key}"
            return f"{key} cannot be set here: it is followed from {owner} ([[param]]); ask or set it there"
    if matches_any(settings.params.remote_set, key):
        return ""
    return f"{key} may not be set by peers: no glob of params.remote_set fits"


def why_not_follow(settings: Settings, key: str) -> str:
    """Why peers may not follow a parameter; empty if they may."""
    if key == "/":
        return _ROOT
    if overlap(key, SIM_TIME):
        if owner := settings.time.follow:
            return f"time comes from {owner} here; follow that one's"
        return "" if settings.time.share else "this module does not share its time; set share = true in its [time]"
    for rule in settings.params.follow:
        if overlap(rule.to, key):
            # If two modules followed each other, their values would never settle.
            return f"{rule.to} is followed from {rule.owner}:{rule.key} here; follow that one"
    return why_not_get(settings, key)


def follow_rules(settings: Settings) -> tuple[FollowRule, ...]:
    """All parameters that this module follows, including the time if ``[time]`` has it followed."""
    owner = settings.time.follow
    return settings.params.follow + ((FollowRule(SIM_TIME, owner, SIM_TIME),) if owner else ())


GET: Final = "param.get"
NAMES: Final = "param.names"
SET: Final = "param.set"
DELETE: Final = "param.delete"
FOLLOW: Final = "param.follow"
VALUE: Final = "param.value"
# The requests that the command line may have its agent send.
QUESTIONS: Final = (GET, NAMES, SET, DELETE)


def text_of(fields: object) -> str:
    """The value in a request to set a parameter, or in the answer to ``param.get`` or ``param.names``.

    Raises:
        RemoteProtocolError: There is none.
        LimitExceeded: It is above ``limits.PARAM_TEXT_MAX``.
    """
    text = fields.get("text") if isinstance(fields, dict) else None
    if not isinstance(text, str):
        raise RemoteProtocolError("the text of a parameter's value is missing")
    if len(text) > limits.PARAM_TEXT_MAX:
        raise LimitExceeded("parameter", len(text), limits.PARAM_TEXT_MAX)
    return text


def count_of(answer: object) -> int:
    """How many parameters were set.

    Raises:
        RemoteProtocolError: The answer does not say it.
    """
    count = answer.get("count") if isinstance(answer, dict) else None
    if not isinstance(count, int):
        raise RemoteProtocolError(f"an answer about a parameter that is none: {str(answer)[:100]!r}")
    return count


def too_large(key: str, size: int) -> str:
    """The error text for a value that is too large to cross."""
    most = limits.PARAM_TEXT_MAX
    return (
        f"{key} has {size} characters as XML-RPC text, above the {most} ({most >> 20} MiB) that cross between "
        "modules; take its parts one by one, or let a latched topic carry it"
    )
