"""The owner's side of parameters: answers what peers read, set, delete and follow of the local core.

The parameters of the local core as XML-RPC text; long values are converted without blocking the event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.params import rules as transfer
from rmpa.bridge.params.rules import key_problem, replaced, too_large
from rmpa.bridge.policy import OPEN_GATE, Needs, PermissionGate
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.rules import overlap
from rmpa.core.errors import LocalProtocolError, PeerRefused, RemoteProtocolError, RmpaError
from rmpa.core.identity import OWN_NODE, peer_name_problem
from rmpa.ros.http.rpc import read_large, slices
from rmpa.ros.master.parameters import holds_nil, leaves
from rmpa.ros.wire.xmlrpc import ResponseReader, response_pieces
from rmpa.runtime.loop import yield_to_data, yielding_to_data
from rmpa.trust.permissions import refusal

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.bridge.params.rules import ParamPolicy
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSession
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue
    from rmpa.trust.permissions import PermissionDecision

PEERS: Final = f"{OWN_NODE}/peers"
"""The caller's name when parameters are set for peers. A core does not notify a node of its own changes, and the
agent's node has to be notified of these."""
_PIECES: Final = 16
"""Pieces, of some KiB each, that are written before the event loop goes on with other tasks."""


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
    for number, piece in enumerate(yielding_to_data(response_pieces(value), every=1), start=1):
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
        value = await read_large(ResponseReader(), (piece.encode() for piece in slices(text)))
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
    """

    def __init__(self, core: Core, node: SlaveNode) -> None:
        self._core = core
        self._node = node

    async def get(self, key: str) -> tuple[bool, XmlRpcValue]:
        """Whether a parameter or namespace exists, and its value, which must not be modified."""
        reply = await self._ask("getParam", OWN_NODE, key)
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
        reply = await self._ask("setParam", caller, key, value)
        if reply.code != 1:
            raise PeerRefused("the ROS core", f"{key}: {reply.status}")

    async def delete(self, key: str, caller: str = OWN_NODE) -> bool:
        """Delete a parameter or namespace; return whether it existed."""
        return (await self._ask("deleteParam", caller, key)).code == 1

    async def names(self) -> list[str]:
        """The names of all parameters."""
        reply = await self._ask("getParamNames", OWN_NODE)
        return [str(name) for name in reply.value] if isinstance(reply.value, list) else []

    async def follow(self, key: str) -> None:
        """Have the core notify the agent's node of changes; a repeated call has no further effect."""
        await self._ask("subscribeParam", OWN_NODE, self._node.uri, key)

    async def leave(self, key: str) -> None:
        """End these notifications."""
        await self._ask("unsubscribeParam", OWN_NODE, self._node.uri, key)

    async def run_id(self) -> XmlRpcValue:
        """The id of this run of the core; another run has none of the values and subscriptions of the one before."""
        return (await self.get("/run_id"))[1]

    async def _ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        return await self._core.ask(method, *params)


# Answers the peers' requests about this module's parameters, and notifies them of changes of those they follow.


_log = logging.getLogger(__name__)

_EACH: Final = Needs((Access.PARAM,), "each parameter, all within a namespace and all that would be lost")
_LISTED: Final = Needs((Access.PARAM,), "each parameter; others are left out")
_FOLLOWED: Final = Needs((Access.PARAM,), "each parameter, and again at each change")


@dataclass(frozen=True, slots=True)
class _Asker:
    """What asks: a peer, or by way of a peer that is a gateway another site.

    Args:
        peer: The peer's name, as its certificate proves it.
        site: The other site; ``None``: the peer asks for itself.
        modules: Its modules that ask, as the gateways say.
    """

    peer: str
    site: str | None
    modules: tuple[str, ...]

    @classmethod
    def read(cls, session: PeerSession, args: dict[str, Any]) -> _Asker:
        """Read ``site`` and ``askers`` of a request.

        Raises:
            RmpaError: They are none.
        """
        site, modules = args.get("site"), args.get("askers", [])
        if not isinstance(modules, list) or len(modules) > limits.PARAM_ASKERS_MAX:
            raise RmpaError(f"askers is not a list of at most {limits.PARAM_ASKERS_MAX} modules")
        for name in [*(() if site is None or site == "" else (site,)), *modules]:
            # Globs of permissions have the name put in for {peer}: it must be a name, and no glob.
            if not isinstance(name, str) or peer_name_problem(name) is not None:
                raise RmpaError(f"{str(name)[:80]!r} is not the name of a site or a module")
        return cls(session.link.name, site, tuple(dict.fromkeys(modules)))

    def __str__(self) -> str:
        return self.peer if self.site is None else self.site or "a program without a site"


class ParamOwner:
    """The owner's side: this module's parameters, for peers.

    Args:
        core: The local core.
        policy: What peers may do.
        rpc: Carries the peers' requests, and notifications to them.
        followed_max: How many parameters one peer may follow.
        gate: Decides which parameters each peer may read and set.
    """

    def __init__(
        self,
        core: ParamCore,
        policy: ParamPolicy,
        rpc: PeerRpc,
        followed_max: int = config_limits.FOLLOWED_MAX,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._core = core
        self.followed_max = followed_max
        self.policy = policy
        self._rpc = rpc
        self._followers: dict[int, tuple[PeerSession, set[str]]] = {}
        self._last: dict[str, str | None] = {}
        """The text that was last sent of each followed key: ``None`` if there was no value, empty if it is above
        ``limits.PARAM_SMALL`` or nothing was sent yet."""
        self._left: set[str] = set()
        self._changed: dict[str, None] = {}
        self._telling: asyncio.Task[None] | None = None
        rpc.on_request(transfer.GET, self._get, _EACH)
        rpc.on_request(transfer.NAMES, self._names, _LISTED)
        rpc.on_request(transfer.SET, self._set, _EACH)
        rpc.on_request(transfer.DELETE, self._delete, _EACH)
        rpc.on_request(transfer.FOLLOW, self._follow, _FOLLOWED)

    # --- events from the part ------------------------------------------------------------------------------------

    def link_down(self, peer: int) -> None:
        """Forget what a peer follows."""
        if self._followers.pop(peer, None) is not None:
            self._forget_unfollowed()

    def touched(self, key: str) -> bool:
        """Notify the followers of a parameter that has changed.

        Returns:
            Whether a peer follows it, a namespace around it, or something inside it.
        """
        found = [followed for followed in self._last if overlap(followed, key)]
        self._tell_soon(found)
        return bool(found)

    async def look(self, *, restarted: bool) -> None:
        """Compare the values with those that were sent, and subscribe again: a core may have lost a notification.

        Args:
            restarted: Whether the core was restarted: it has none of the subscriptions.
        """
        for key in [key for key in self._left if key not in self._last]:
            await self._core.leave(key)
        self._left.clear()
        for key, last in list(self._last.items()):
            if restarted:
                await self._core.follow(key)
                self._tell_soon([key])
            elif last != "":
                await self._core.follow(key)
                with contextlib.suppress(LocalProtocolError):  # too large, which was reported when it was sent
                    if await self._small_text(key) != last:
                        self._tell_soon([key])

    def judge_again(self) -> None:
        """Notify the peers of parameters that the new rules no longer let them follow."""
        for session, keys in self._followers.values():
            for key in list(keys):
                if why := self.policy.why_not_follow(key) or self._why_denied(_Asker.read(session, {}), key):
                    keys.discard(key)
                    self._rpc.notify(session, transfer.VALUE, _refusal(key, why))
        self._forget_unfollowed()

    async def close(self) -> None:
        """Stop the notifications to peers."""
        if self._telling is not None:
            self._telling.cancel()
            await asyncio.gather(self._telling, return_exceptions=True)

    @property
    def followed(self) -> Iterator[str]:
        """The keys that at least one peer follows."""
        return iter(self._last)

    # --- requests -----------------------------------------------------------------------------------------------

    async def _get(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        key, asker = self._key(args.get("key")), _Asker.read(session, args)
        found, value = await self._core.get(key)
        # The permissions come first: the error of ``[params]`` may name a parameter that they hide.
        self._refuse(self._why_denied(asker, key, value) or self._why_not_get(key, value))
        if not found:
            raise RmpaError(f"there is no parameter {key}")
        return {"text": await write_text(key, value)}

    async def _names(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        asker = _Asker.read(session, args)
        names = [
            name
            for name in yielding_to_data(await self._core.names())
            if not self.policy.why_not_get(name) and self._judge(asker, name)[0].allowed
        ]
        return {"text": await write_text("the list of parameters", names)}

    async def _set(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        key, asker = self._key(args.get("key")), _Asker.read(session, args)
        value = await read_text(transfer.text_of(args))
        parameters: list[tuple[str, XmlRpcValue]] = []
        for given, one in yielding_to_data(leaves(key, value)):
            if len(parameters) >= limits.PARAMS_SET_MAX:
                raise RmpaError(f"{key} has more than {limits.PARAMS_SET_MAX} parameters: set its parts one by one")
            if len(parameters) % limits.APPLIED_AT_ONCE == 0:
                await asyncio.sleep(0)
            # A member may be named "" or "a/": the core drops the slash at the end, so the name is judged without it.
            name = given.rstrip("/") or "/"
            self._refuse(key_problem(given) or self.policy.why_not_set(name) or self._why_denied(asker, name))
            parameters.append((name, one))
        await self._keep_others(asker, key, [name for name, _ in parameters])
        for number, (name, one) in enumerate(parameters):
            await self._core.set(name, one, PEERS)
            yield_to_data()
            if number % limits.APPLIED_AT_ONCE == 0:
                await asyncio.sleep(0)
        _log.info("< %s sets %d parameters at %s", asker, len(parameters), key)
        return {"count": len(parameters)}

    async def _delete(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        key, asker = self._key(args.get("key")), _Asker.read(session, args)
        self._refuse(self.policy.why_not_set(key))
        if self._gate.on:
            # All of a namespace, and the namespace itself: a rule may name either.
            _, value = await self._core.get(key)
            self._refuse(self._why_denied(asker, key) or self._why_denied(asker, key, value))
        if not await self._core.delete(key, PEERS):
            raise RmpaError(f"there is no parameter {key}")
        _log.info("< %s deletes parameter %s", asker, key)
        return {}

    async def _follow(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        """Replace the set of keys that a peer follows."""
        keys = args.get("keys")
        if not isinstance(keys, list) or len(keys) > config_limits.FOLLOW_RULES_MAX:
            raise RmpaError(f"keys is not a list of at most {config_limits.FOLLOW_RULES_MAX} parameters")
        asker = _Asker.read(session, args)
        refused: dict[str, str] = {}
        wanted: set[str] = set()
        for given in keys:
            problem = key_problem(given)
            key = str(given).rstrip("/") or "/"
            why = problem or self.policy.why_not_follow(key) or self._why_denied(asker, key)
            if not why and key not in wanted and len(wanted) >= self.followed_max:
                text = f"more parameters than limits.params = {self.followed_max} over there"
                why = f"{text}; raise it, or follow a namespace"
            if why:
                refused[str(given)[: config_limits.CROSSING_NAME_MAX]] = why
            else:
                wanted.add(key)
        self._followers[session.peer] = (session, wanted)
        self._forget_unfollowed()
        for key in wanted:
            self._last.setdefault(key, "")
            await self._core.follow(key)
        self._tell_soon(wanted)
        return {"refused": refused}

    def _why_not_get(self, key: str, value: XmlRpcValue) -> str:
        if not isinstance(value, dict):
            return self.policy.why_not_get(key)
        if self.policy.all_get or not value:
            return "" if self.policy.all_get else self.policy.why_not_get(key)
        return next(
            (why for name, _ in yielding_to_data(leaves(key, value)) if (why := self.policy.why_not_get(name))), ""
        )

    def _judge(self, asker: _Asker, name: str) -> tuple[PermissionDecision, str]:
        """Decide whether a parameter may be had by the peer and by the site for which it asks, and name those judged.

        A peer that may not have it is judged by its own name alone: the site that it names may be invented.
        """
        decision = self._gate.judge(Access.PARAM, asker.peer, name)
        if asker.site is None or not decision.allowed:
            return decision, asker.peer
        by_site = self._gate.judge_site(Access.PARAM, asker.site, asker.modules, name)
        return by_site, f"{asker} by way of {asker.peer}"

    def _why_denied(self, asker: _Asker, key: str, value: XmlRpcValue = None) -> str:
        """Why the permissions do not let a peer have a parameter, or all of a namespace; empty if they do."""
        if not self._gate.on:
            return ""
        names = [name for name, _ in leaves(key, value)] if isinstance(value, dict) and value else [key]
        for name in yielding_to_data(names):
            decision, whose = self._judge(asker, name)
            if not decision.allowed:
                self._gate.refused(Access.PARAM, whose, name, decision)
                return refusal(Access.PARAM, str(asker), key)  # not the name: it may be a secret
        return ""

    async def _keep_others(self, asker: _Asker, key: str, names: list[str]) -> None:
        """Refuse to set parameters where others would be lost by it that the peer may not set.

        Raises:
            RmpaError: It may not.
        """
        if not self._gate.on:
            return
        around = "/".join(key.split("/")[:2])
        _, present = await self._core.get(around)
        for name in yielding_to_data(list(replaced(names, around, present))):
            if self._why_denied(asker, name):
                raise RmpaError(refusal(Access.PARAM, str(asker), key))

    def _key(self, given: object) -> str:
        self._refuse(key_problem(given))
        return str(given).rstrip("/") or "/"

    def _refuse(self, why: str) -> None:
        if why:
            raise RmpaError(why)

    # --- notifications -------------------------------------------------------------------------------------------

    def _tell_soon(self, keys: Iterable[str]) -> None:
        self._changed |= dict.fromkeys(keys)
        if self._changed and self._telling is None:
            self._telling = asyncio.create_task(self._tell(), name="tell of parameters")

    async def _tell(self) -> None:
        try:
            while self._changed:
                await asyncio.sleep(limits.PARAM_GATHER)
                changed, self._changed = self._changed, {}
                for key in changed:
                    if key in self._last:
                        await self._tell_one(key)
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! telling peers of parameters failed")
        finally:
            self._telling = None

    async def _tell_one(self, key: str) -> None:
        args: dict[str, object] = {"key": key, "exists": False, "size": 0}
        value: XmlRpcValue = None
        try:
            found, value = await self._core.get(key)
            why = self._why_not_get(key, value) if found and isinstance(value, dict) else ""
            if why:
                args["refused"] = why
                found = False
            text = await write_text(key, value) if found else None
        except RmpaError as error:
            # The core does not answer, or the value is too large to cross; ``look`` sends it when that has changed.
            _log.warning("! peers are not told of %s: %s", key, error)
            args["refused"] = str(error)
            text = None
        if text is not None:
            args |= {"exists": True, "size": len(text)}
            if len(text) <= limits.ASK_EXPRESS_MAX:
                args["text"] = text
        if key in self._last:
            self._last[key] = text if text is None or len(text) <= limits.PARAM_SMALL else ""
        for session, keys in list(self._followers.values()):
            if key in keys:
                why = self._why_denied(_Asker.read(session, {}), key, value)
                self._rpc.notify(session, transfer.VALUE, _refusal(key, why) if why else args)

    async def _small_text(self, key: str) -> str | None:
        text = await self._core.get_text(key)
        return text if text is None or len(text) <= limits.PARAM_SMALL else ""

    def _forget_unfollowed(self) -> None:
        kept = set().union(*(keys for _, keys in self._followers.values())) if self._followers else set()
        for key in [key for key in self._last if key not in kept]:
            del self._last[key]
            self._left.add(key)


def _refusal(key: str, why: str) -> dict[str, object]:
    """The notification that a peer may not follow a parameter."""
    return {"key": key, "exists": False, "size": 0, "refused": why}
