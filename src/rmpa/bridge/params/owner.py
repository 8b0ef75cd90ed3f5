"""The owner's side of parameters: which of this module's peers may read, set, delete and follow, and their requests.

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

import asyncio
import logging
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.policy import Needs, PermissionGate
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.rules import SIM_TIME, FollowRule, overlap, untouchable
from rmpa.core.errors import LimitExceeded, LocalProtocolError, PeerRefused, RemoteProtocolError, RmpaError
from rmpa.core.identity import OWN_NODE, matches_any
from rmpa.ros import limits as ros_limits
from rmpa.ros.http.rpc import read_large, slices
from rmpa.ros.master.parameters import holds_nil, leaves
from rmpa.ros.wire.xmlrpc import XmlRpcValue, response_pieces
from rmpa.runtime.loop import yield_to_data, yielding_to_data
from rmpa.runtime.tasks import start_task
from rmpa.trust.permissions import refusal

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.sessions import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.slave_node import SlaveNode

_log = logging.getLogger(__name__)

GET: Final = "param.get"
NAMES: Final = "param.names"
SET: Final = "param.set"
DELETE: Final = "param.delete"
FOLLOW: Final = "param.follow"
VALUE: Final = "param.value"
# The requests that the command line may have its agent send.
QUESTIONS: Final = (GET, NAMES, SET, DELETE)

# The caller's name when parameters are set for peers. A core does not notify a node of its own changes, and the
# agent's node has to be notified of these.
PEERS: Final = f"{OWN_NODE}/peers"
# The globs that every parameter fits.
_ALL: Final = frozenset({"/**", "**"})
# Pieces, of some KiB each, that are written before the event loop goes on with other tasks.
_PIECES: Final = 16
_EACH: Final = Needs((Access.PARAM,), "each parameter, all within a namespace and all that would be lost")


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


async def write_text(what: str, value: XmlRpcValue) -> str:
    """Write a value as the text of an XML-RPC response.

    Args:
        what: The parameter's name, for the error.
        value: Its value.

    Raises:
        LocalProtocolError: XML-RPC cannot represent the value, or the text is above ``limits.PARAM_TEXT_MAX``.
    """
    parts: list[str] = []
    size = 0
    for number, piece in enumerate(yielding_to_data(response_pieces(value)), start=1):
        parts.append(piece.decode())  # pieces end between characters
        size += len(piece)
        if size > limits.PARAM_TEXT_MAX:
            raise LocalProtocolError(too_large(what, size))
        if number % _PIECES == 0:
            await asyncio.sleep(0)
    return "".join(parts)


async def read_text(text: str) -> XmlRpcValue:
    """Read the value of a text that ``write_text`` has written.

    Raises:
        RemoteProtocolError: The text is malformed, or contains a nil, which ROS does not have.
    """
    try:
        value = (await read_large(piece.encode() for piece in slices(text))).response()
    except UnicodeEncodeError as error:
        raise RemoteProtocolError(f"a parameter's text is not Unicode: {error.reason}") from None
    if holds_nil(value, yielding_to_data):
        raise RemoteProtocolError("the value is nil or contains one, which ROS does not have; leave it out")
    return value


class ParamCore:
    """The requests of the parameter classes to the local core.

    Args:
        core: The local core, embedded or external.
        node: The agent's own node, which the core notifies of changes.

    Attributes:
        subscribed: The keys of which the core notifies the agent's node.
    """

    def __init__(self, core: Core, node: SlaveNode) -> None:
        self.ask = core.ask
        self._node = node
        self.subscribed: set[str] = set()

    async def get(self, key: str) -> tuple[bool, XmlRpcValue]:
        """Whether a parameter or namespace exists, and its value, which must not be modified."""
        reply = await self.ask("getParam", OWN_NODE, key)
        return reply.code == 1, reply.value

    async def get_text(self, key: str) -> str | None:
        """The value of a parameter or namespace as text; ``None`` if it does not exist.

        Raises:
            LocalProtocolError: It is too large.
        """
        found, value = await self.get(key)
        return await write_text(key, value) if found else None

    async def set(self, key: str, value: XmlRpcValue, caller: str = OWN_NODE) -> None:
        """Set a parameter, or a namespace as a whole; the value must not be modified afterwards.

        Raises:
            PeerRefused: The core does not accept it.
        """
        reply = await self.ask("setParam", caller, key, value)
        if reply.code != 1:
            raise PeerRefused("the ROS core", f"{key}: {reply.status}", code="core-refuses")

    async def delete(self, key: str, caller: str = OWN_NODE) -> bool:
        """Delete a parameter or namespace; return whether it existed."""
        return (await self.ask("deleteParam", caller, key)).code == 1

    async def follow(self, key: str) -> None:
        """Have the core notify the agent's node of changes; a repeated call has no further effect."""
        await self.ask("subscribeParam", OWN_NODE, self._node.uri, key)
        self.subscribed.add(key)

    async def leave_others(self, wanted: Iterable[str]) -> None:
        """End the notifications of other keys than these."""
        for key in self.subscribed.difference(wanted):
            await self.ask("unsubscribeParam", OWN_NODE, self._node.uri, key)
            self.subscribed.discard(key)


@dataclass(slots=True, eq=False)
class _Follower:
    """A peer that follows parameters of this module.

    Args:
        session: The peer.
        keys: What it follows.
        told: The mark (``_mark``) of the value that it was told last of each key; it is told of keys without one.
        task: Tells it.
    """

    session: PeerSession
    keys: set[str] = field(default_factory=set)
    told: dict[str, int] = field(default_factory=dict)
    task: asyncio.Task[None] | None = None


class ParamOwner:
    """The owner's side: this module's parameters, for peers.

    Args:
        core: The local core.
        bridge: The peers and the rules.
    """

    def __init__(self, core: ParamCore, bridge: Bridge) -> None:
        self._core = core
        self._bridge = bridge
        self._followers: dict[int, _Follower] = {}
        rpc = bridge.rpc
        rpc.on_request(GET, self._get, _EACH)
        rpc.on_request(NAMES, self._names, Needs((Access.PARAM,), "each parameter; others are left out"))
        rpc.on_request(SET, self._set, _EACH)
        rpc.on_request(DELETE, self._delete, _EACH)
        again = Needs((Access.PARAM,), "each parameter, and again at each change")
        rpc.on_request(FOLLOW, self._follow, again)

    @property
    def _settings(self) -> Settings:
        return self._bridge.context.settings

    @property
    def _gate(self) -> PermissionGate:
        return self._bridge.context.gate

    @property
    def followed(self) -> set[str]:
        """What peers follow."""
        return set().union(*(follower.keys for follower in self._followers.values()))

    def link_down(self, peer: int) -> None:
        """Forget what a peer follows."""
        follower = self._followers.pop(peer, None)
        if follower is not None and follower.task is not None:
            follower.task.cancel()

    def touched(self, key: str) -> bool:
        """Tell the followers of a parameter that has changed.

        Returns:
            Whether a peer follows it, a namespace around it, or something inside it.
        """
        for follower in self._followers.values():
            self._tell_soon(follower, {followed for followed in follower.keys if overlap(followed, key)})
        return any(overlap(followed, key) for followed in self.followed)

    async def look(self, *, restarted: bool) -> None:
        """Compare the values with those that were told, and subscribe again: a core may have lost a notification.

        Args:
            restarted: Whether the core was restarted: it has none of the subscriptions.
        """
        for key in self.followed:
            await self._core.follow(key)
            compared = [one for one in self._followers.values() if restarted or one.told.get(key)]
            mark = None
            if compared and not restarted:
                try:
                    mark = _mark(await self._core.get_text(key))
                except LocalProtocolError:  # too large, which was reported when it was told
                    continue
            for one in compared:
                if one.told.get(key) != mark:
                    self._tell_soon(one, {key})
        for one in self._followers.values():
            self._tell_soon(one, set())  # what could not be told

    def judge_again(self) -> None:
        """Tell the peers of parameters that the new rules no longer let them follow."""
        for one in self._followers.values():
            self._tell_soon(one, {key for key in one.keys if self._why_not_follow(one.session.link.name, key)})

    def tasks(self) -> Iterable[asyncio.Task[None] | None]:
        """Those that tell peers."""
        return (follower.task for follower in self._followers.values())

    async def _get(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        key, peer = self._key(args.get("key")), session.link.name
        found, value = await self._core.get(key)
        # The permissions come first: the error of ``[params]`` may name a parameter that they hide.
        self._refuse(self._why_denied(peer, key, value) or self._why_not_get(key, value))
        if not found:
            raise RmpaError(f"there is no parameter {key}", code="unknown-name")
        return {"text": await write_text(key, value)}

    async def _names(self, session: PeerSession, _args: dict[str, Any]) -> dict[str, object]:
        known = (await self._core.ask("getParamNames", OWN_NODE)).value
        names = [
            name
            for name in yielding_to_data(map(str, known) if isinstance(known, list) else ())
            if not why_not_get(self._settings, name)
            and self._gate.judge(Access.PARAM, session.link.name, name).allowed
        ]
        return {"text": await write_text("the list of parameters", names)}

    async def _set(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        key, peer = self._key(args.get("key")), session.link.name
        value = await read_text(text_of(args))
        parameters: list[tuple[str, XmlRpcValue]] = []
        for given, one in yielding_to_data(leaves(key, value)):
            if len(parameters) >= limits.PARAMS_SET_MAX:
                raise RmpaError(
                    f"{key} has more than {limits.PARAMS_SET_MAX} parameters: set its parts one by one",
                    code="limit-reached",
                )
            if len(parameters) % limits.APPLIED_AT_ONCE == 0:
                await asyncio.sleep(0)
            # A member may be named "" or "a/": the core drops the slash at the end, so the name is judged without it.
            name = given.rstrip("/") or "/"
            self._refuse(key_problem(given) or why_not_set(self._settings, name) or self._why_denied(peer, name))
            parameters.append((name, one))
        if self._gate.on:  # parameters that the peer may not set must not be lost by it
            around = "/".join(key.split("/")[:2])
            _, present = await self._core.get(around)
            lost = list(replaced((name for name, _ in parameters), around, present))
            if any(self._why_denied(peer, name) for name in yielding_to_data(lost)):
                raise RmpaError(refusal(Access.PARAM, peer, key), code="not-permitted")
        for number, (name, one) in enumerate(parameters):
            await self._core.set(name, one, PEERS)
            yield_to_data()
            if number % limits.APPLIED_AT_ONCE == 0:
                await asyncio.sleep(0)
        _log.info("< %s sets %d parameters at %s", peer, len(parameters), key)
        return {"count": len(parameters)}

    async def _delete(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        key, peer = self._key(args.get("key")), session.link.name
        self._refuse(why_not_set(self._settings, key))
        if self._gate.on:
            # All of a namespace, and the namespace itself: a rule may name either.
            _, value = await self._core.get(key)
            self._refuse(self._why_denied(peer, key) or self._why_denied(peer, key, value))
        if not await self._core.delete(key, PEERS):
            raise RmpaError(f"there is no parameter {key}", code="unknown-name")
        _log.info("< %s deletes parameter %s", peer, key)
        return {}

    async def _follow(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        """Replace the set of keys that a peer follows."""
        keys = args.get("keys")
        if not isinstance(keys, list) or len(keys) > config_limits.FOLLOW_RULES_MAX:
            raise RmpaError(f"keys is not a list of at most {config_limits.FOLLOW_RULES_MAX} parameters")
        peer, most = session.link.name, self._settings.limits.params
        refused: dict[str, str] = {}
        wanted: set[str] = set()
        for given in keys:
            key = str(given).rstrip("/") or "/"
            why = key_problem(given) or self._why_not_follow(peer, key)
            if not why and key not in wanted and len(wanted) >= most:
                why = f"more parameters than limits.params = {most} there; raise it, or follow a namespace"
            if why:
                refused[str(given)[: config_limits.CROSSING_NAME_MAX]] = why
            else:
                wanted.add(key)
        follower = self._followers.setdefault(session.peer, _Follower(session))
        follower.keys = wanted
        for key in wanted:
            await self._core.follow(key)
        follower.told = {}
        self._tell_soon(follower, set())
        return {"refused": refused}

    def _why_not_get(self, key: str, value: XmlRpcValue) -> str:
        if _ALL & {*self._settings.params.remote_get}:
            return ""
        names = yielding_to_data(leaves(key, value or None))  # an empty namespace is judged by its own name
        return next((why for name, _ in names if (why := why_not_get(self._settings, name))), "")

    def _why_not_follow(self, peer: str, key: str) -> str:
        return why_not_follow(self._settings, key) or self._why_denied(peer, key)

    def _why_denied(self, peer: str, key: str, value: XmlRpcValue = None) -> str:
        """Why the permissions do not let a peer have a parameter, or all of a namespace; empty if they do."""
        if not self._gate.on:
            return ""
        for name, _ in yielding_to_data(leaves(key, value or None)):
            decision = self._gate.judge(Access.PARAM, peer, name)
            if not decision.allowed:
                self._gate.refused(Access.PARAM, peer, name, decision)
                return refusal(Access.PARAM, peer, key)  # not the name: it may be a secret
        return ""

    def _key(self, given: object) -> str:
        self._refuse(key_problem(given))
        return str(given).rstrip("/") or "/"

    def _refuse(self, why: str) -> None:
        if why:
            raise RmpaError(why, code="not-permitted")

    def _tell_soon(self, follower: _Follower, keys: set[str]) -> None:
        for key in keys:
            follower.told.pop(key, None)
        idle = follower.task is None or follower.task.done()
        if idle and not follower.keys <= follower.told.keys():
            name = f"tell {follower.session.link.name} of parameters"
            follower.task = start_task(self._tell(follower), name)

    async def _tell(self, follower: _Follower) -> None:
        """Tell a peer the present values of what has changed, one after the other; what fails is left to ``look``."""
        while not follower.keys <= follower.told.keys():
            await asyncio.sleep(limits.PARAM_GATHER)
            for key in follower.keys - follower.told.keys():
                follower.told[key] = 0  # before it is read: a change meanwhile takes the mark away
                if key in follower.keys and not await self._tell_one(follower, key):
                    follower.told.pop(key, None)
                    return

    async def _tell_one(self, follower: _Follower, key: str) -> bool:
        """Tell a peer a parameter's present value, or why it may not follow it; return whether that has arrived."""
        text = None
        if why := self._why_not_follow(follower.session.link.name, key):
            follower.keys.discard(key)
        else:
            try:
                found, value = await self._core.get(key)
                if found:
                    # What is followed by itself was judged above: the time is shared whatever may be read.
                    hidden = self._why_not_get(key, value) if isinstance(value, dict) else ""
                    why = self._why_denied(follower.session.link.name, key, value) or hidden
                    text = None if why else await write_text(key, value)
            except RmpaError as error:  # the core does not answer, or the value is too large to cross
                _log.warning("! peers do not get the parameter %s: %s [param-trouble]", key, error)
                why = str(error)
        args = {"key": key, "refused": why} if why else {"key": key, "text": text}
        try:
            await self._bridge.rpc.request(follower.session, VALUE, args, limits.PARAM_ASK_TIMEOUT)
        except RmpaError as error:
            _log.warning(
                "! %s does not get the parameter %s: %s [param-trouble]", follower.session.link.name, key, error
            )
            return False
        if key in follower.told:
            follower.told[key] = _mark(text)
        return True


def _mark(text: str | None) -> int:
    """A number by which a value is known again; 0: it is above ``limits.PARAM_SMALL``, and not compared."""
    return 0 if text is not None and len(text) > limits.PARAM_SMALL else hash(text) or 1
