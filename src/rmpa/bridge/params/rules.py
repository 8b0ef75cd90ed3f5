"""Which parameters peers may read, set and follow, and the parameters that this module follows. Without I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.config import limits as config_limits
from rmpa.config.rules import SIM_TIME, overlap, untouchable
from rmpa.config.settings import FollowRule, ParamSettings, TimeSettings
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import matches
from rmpa.ros import limits as ros_limits
from rmpa.ros.master.parameters import leaves

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_OF_OTHERS: Final = "it is followed from {owner} ([[param]]); ask or set it there"


def replaced(names: Iterable[str], at: str, present: XmlRpcValue) -> Iterator[str]:
    """Yield the parameters that are lost if others are set: a value becomes a namespace, or a namespace a value.

    Args:
        names: The parameters that are set; all are ``at``, or below it.
        at: The name of the present value, a namespace around them all.
        present: The value; empty if there is none.
    """
    for name in names:
        where, value = at, present
        for part in filter(None, name[len(at) :].split("/")):
            if not isinstance(value, dict):
                yield where
                break
            where = f"{where.rstrip('/')}/{part}"
            if part not in value:
                break
            value = value[part]
        else:
            if isinstance(value, dict):
                yield from (lost for lost, _ in leaves(name, value))


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


class ParamPolicy:
    """What peers may do with this module's parameters.

    Args:
        params: The globs of ``[params]``, and what this module follows.
        time: Whether this module shares its time, and whose time it follows.
    """

    def __init__(self, params: ParamSettings, time: TimeSettings) -> None:
        self._params = params
        self._time = time

    @property
    def all_get(self) -> bool:
        """Whether peers may read every parameter."""
        return "/**" in self._params.remote_get or "**" in self._params.remote_get

    def why_not_get(self, key: str) -> str:
        """Why peers may not read a parameter; empty if they may."""
        if any(matches(glob, key) for glob in self._params.remote_get):
            return ""
        return f"{key} may not be read by peers: no glob of params.remote_get fits"

    def why_not_set(self, key: str) -> str:
        """Why peers may not set or delete a parameter; empty if they may."""
        if key == "/":
            return "the root holds every parameter: name those that you mean"
        if why := untouchable(key):
            return f"{key} is never set from another module: {why}"
        for rule in self._params.follow:
            if overlap(rule.to, key):
                return f"{key} cannot be set here: " + _OF_OTHERS.format(owner=f"{rule.owner}:{rule.key}")
        if any(matches(glob, key) for glob in self._params.remote_set):
            return ""
        return f"{key} may not be set by peers: no glob of params.remote_set fits"

    def why_not_follow(self, key: str) -> str:
        """Why peers may not follow a parameter; empty if they may."""
        if key == "/":
            return "the root holds every parameter: name those that you mean"
        if overlap(key, SIM_TIME):
            if self._time.follow:
                return f"time comes from {self._time.follow} here; follow that one's"
            return "" if self._time.share else "this module does not share its time; set share = true in its [time]"
        for rule in self._params.follow:
            if overlap(rule.to, key):
                # If two modules followed each other, their values would never settle.
                return f"{rule.to} is followed from {rule.owner}:{rule.key} here; follow that one"
        return self.why_not_get(key)


def follow_rules(params: ParamSettings, time: TimeSettings) -> tuple[FollowRule, ...]:
    """All parameters that this module follows, including the time if ``[time]`` has it followed."""
    return params.follow + ((FollowRule(SIM_TIME, time.follow, SIM_TIME),) if time.follow else ())


@dataclass(slots=True)
class Followed:
    """One followed parameter.

    Args:
        rule: Its owner, the owner's key, and the key here.
        peer: The number of the peer that it is followed from; ``None`` while its owner is not linked.
        last: ``peer`` of the last link: another run of the owner has another number.
        text: The owner's value as XML-RPC text; ``None`` if the owner has none, or it is unknown.
        known: Whether the owner's value, or its absence, is known.
        had: Whether this run of the owner has had a value. Before that, an absent value does not delete the one here.
        news: How often the owner has told of it.
        ask: Whether the value is to be requested, because it was too large to be told.
        due: Whether the local core is to be compared with the owner's value, and set.
        doubted: Whether the local core has reported a change of it since the last comparison.
        problem: Why it is not followed, or empty.
    """

    rule: FollowRule
    peer: int | None = None
    last: int | None = None
    text: str | None = None
    known: bool = False
    had: bool = False
    news: int = 0
    ask: bool = False
    due: bool = False
    doubted: bool = False
    problem: str = ""

    @property
    def state(self) -> str:
        """The state for the user: ``followed``, ``waiting`` (for the owner) or ``refused``."""
        if self.problem:
            return "refused" if self.peer is not None else "waiting"
        return "followed" if self.peer is not None and self.known else "waiting"


class Following:
    """Which parameters are followed from which peer; each has one owner.

    Args:
        rules: What is followed.
    """

    def __init__(self, rules: Iterable[FollowRule] = ()) -> None:
        self._entries: dict[FollowRule, Followed] = {rule: Followed(rule) for rule in rules}

    def __iter__(self) -> Iterator[Followed]:
        """All followed parameters, in the order of the rules."""
        return iter(self._entries.values())

    def change(self, rules: Iterable[FollowRule]) -> tuple[list[Followed], list[Followed]]:
        """Replace the rules; the parameters of rules that stay are not touched.

        Returns:
            Those that are no longer followed, and the new ones.
        """
        before = self._entries
        self._entries = {rule: before.get(rule) or Followed(rule) for rule in rules}
        gone = [entry for rule, entry in before.items() if rule not in self._entries]
        return gone, [entry for rule, entry in self._entries.items() if rule not in before]

    def linked(self, peer: int, name: str) -> tuple[list[Followed], list[Followed]]:
        """Follow the parameters of a peer that is linked now.

        Args:
            peer: The peer's number.
            name: The peer's name; several peers may have it, and the first one is the owner.

        Returns:
            Those that are followed from this peer now, and those that another peer of the same name owns already.
        """
        mine, others = [], []
        for entry in self._entries.values():
            if entry.rule.owner != name:
                continue
            if entry.peer in (None, peer):
                entry.peer, entry.problem = peer, ""
                entry.had = entry.had and entry.last == peer
                entry.last = peer
                mine.append(entry)
            else:
                others.append(entry)
        return mine, others

    def unlinked(self, peer: int) -> list[Followed]:
        """Note that a link is gone; the values stay as they are.

        Returns:
            The parameters that were followed over it: another peer of the same name may own them now.
        """
        gone = [entry for entry in self._entries.values() if entry.peer == peer]
        for entry in gone:
            entry.peer, entry.ask, entry.problem = None, False, ""
        return gone

    def told(self, peer: int, key: str, *, exists: bool, text: str | None) -> list[Followed]:
        """Store the value that the owner has reported.

        Args:
            peer: The owner's number.
            key: The owner's key.
            exists: Whether the owner has a value.
            text: The value as XML-RPC text; ``None`` if there is none, or (with ``exists``) it is to be requested.

        Returns:
            The parameters that follow this key.
        """
        found = [entry for entry in self._entries.values() if entry.peer == peer and entry.rule.key == key]
        for entry in found:
            entry.news += 1
            if exists and text is None:
                entry.ask = True
            else:
                learn(entry, text if exists else None)
        return found

    def touched(self, key: str) -> list[Followed]:
        """The followed parameters that a change of this local key may concern."""
        return [entry for entry in self._entries.values() if overlap(entry.rule.to, key)]

    @property
    def size(self) -> int:
        """Characters of all values that are kept."""
        return sum(len(entry.text or "") for entry in self._entries.values())


def learn(entry: Followed, text: str | None) -> None:
    """Store the owner's value, or that the owner has none (``None``).

    If this run of the owner has never had a value, the one here is kept; else the local core is to be set.
    """
    entry.ask = False
    entry.known = True
    if text is not None:
        entry.had = True
    entry.due = text is not None or entry.had
    entry.text = text


# The names of the requests between two agents about parameters.
#
# Values cross as the text of an XML-RPC response (``ros.wire.xmlrpc``), so that their types survive: JSON has
# neither
# binary data nor dates. ``bridge.driver`` carries large ones aside of commands. ::
#
#     param.get {key}                       → {text}
#     param.names {}                        → {text}        a list of the names of all parameters that may be read
#     param.set {key, text}                 → {count}
#     param.delete {key}                    → {}
#     param.follow {keys}                   → {refused}     from now on their changes, as below
#     notification param.value {key, exists, size, text}    without text: it is large; read it
#
# A gateway that asks for another site adds ``site`` (empty for a program that names none) and ``askers``, modules
# of
# that site. Then the owner asks the permissions of the gateway, of the site, and denials of those modules.


GET: Final = "param.get"
NAMES: Final = "param.names"
SET: Final = "param.set"
DELETE: Final = "param.delete"
FOLLOW: Final = "param.follow"
VALUE: Final = "param.value"
QUESTIONS: Final = (GET, NAMES, SET, DELETE)
"""The requests that the command line may have its agent send."""


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
