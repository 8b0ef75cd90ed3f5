"""The owner's side of direct transport: grants the nodes of peers a connection to a local node.

A change here is one notification, "ask again": the answer then says whether a grant ended, and why.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.direct.nodes import Condition, Grant, Unmet, end_from, reply_of, unmet_by_trust
from rmpa.bridge.messages import is_crossing_name
from rmpa.bridge.policy import OPEN_GATE, PermissionGate
from rmpa.core.contract import Contract  # noqa: TC001 - msgspec reads the annotations
from rmpa.core.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSession, PeerSessions
    from rmpa.core.counters import Counters


# The arguments of the requests and notifications about direct transport, as JSON.
#
# Topics and services have the same three messages: ``direct.topic`` or ``direct.service`` asks, ``…_again`` makes
# the
# asking side ask again, ``…_release`` gives a grant back. docs/design/protocol.md has examples.


class Want(NamedTuple):
    """What is to be reached directly.

    Args:
        name: The topic or service, by its name on the wire.
        node: The node that publishes or provides it.
        user: The subscribing node; empty: a service, for every node of the asking module.
    """

    name: str
    node: str
    user: str = ""


class DirectAsk(msgspec.Struct, frozen=True, omit_defaults=True):
    """May this be reached directly?

    Args:
        name: As in ``Want``.
        node: As in ``Want``.
        user: As in ``Want``.
        contract: What the subscriber's module asks for; topics only.
        broken: Whether an earlier connection ended by itself, so that the publisher may be dead.
    """

    name: str
    node: str
    user: str = ""
    contract: Contract | None = None
    broken: bool = False

    @property
    def want(self) -> Want:
        """What is asked for."""
        return Want(self.name, self.node, self.user)


def write(asked: DirectAsk) -> dict[str, Any]:
    """The arguments as values that JSON can represent."""
    values: dict[str, Any] = msgspec.to_builtins(asked)
    return values


def read_ask(args: dict[str, Any]) -> DirectAsk:
    """Read and validate a request; it is about a topic if it has a user and a contract.

    Raises:
        RemoteProtocolError: A name or a value is invalid.
    """
    try:
        found = msgspec.convert(args, DirectAsk)
    except (msgspec.ValidationError, RecursionError) as error:
        raise RemoteProtocolError(f"direct transport: {error}") from error
    if bool(found.user) != (found.contract is not None):
        raise RemoteProtocolError("direct transport: a subscriber has a contract, and a service has neither")
    for name in found.want if found.user else found.want[:2]:
        if not is_crossing_name(name):
            raise RemoteProtocolError(f"direct transport: {name[:200]!r} is not a global ROS name")
    return found


def read_want(args: dict[str, Any]) -> Want:
    """Read and validate a notification; errors as ``read_ask``."""
    names = args.get("name"), args.get("node"), args.get("user", "")
    for name in names if names[2] else names[:2]:
        if not isinstance(name, str) or not is_crossing_name(name):
            raise RemoteProtocolError(f"direct transport: {str(name)[:200]!r} is not a global ROS name")
    return Want(*map(str, names))


_log = logging.getLogger(__name__)
_GIVEN_UP = Unmet(Condition.AGENT, "it was given up meanwhile")


@dataclass(slots=True, eq=False)
class Asked:
    """What a peer asked for.

    Args:
        asked: Its request.
        found: The answer; ``None`` while it is looked for.
    """

    asked: DirectAsk
    found: Grant | Unmet | None = None


class Grants:
    """What peers asked for, and what they were answered. Subclasses know the conditions, and where nodes listen.

    Args:
        sessions: The peers.
        rpc: Carries the requests.
        counters: Count ``direct.granted`` and ``direct.ended``.
        gate: Whether the mesh is secured.
    """

    kind = ""
    """The middle of the names of the messages."""

    def __init__(
        self, sessions: PeerSessions, rpc: PeerRpc, counters: Counters, gate: PermissionGate = OPEN_GATE
    ) -> None:
        self._sessions = sessions
        self._rpc = rpc
        self._counters = counters
        self._gate = gate
        self._asked: dict[tuple[str, str], dict[tuple[int, str], Asked]] = {}
        """By name and node; then by peer and user."""

    def __iter__(self) -> Iterator[tuple[int, Want, Grant]]:
        """Every grant: peer, what is granted, and where; changes during the iteration are allowed."""
        for peer, want, asked in self._all():
            if isinstance(asked.found, Grant):
                yield peer, want, asked.found

    def of(self, name: str, node: str) -> list[tuple[int, str, Grant]]:
        """The grants for one node's topic or service: peer, user, and where."""
        found = self._asked.get((name, node), {}).items()
        return sorted((*key, asked.found) for key, asked in found if isinstance(asked.found, Grant))

    def _all(self, peer: int | None = None) -> list[tuple[int, Want, Asked]]:
        return [
            (owner, Want(*place, user), asked)
            for place, users in self._asked.items()
            for (owner, user), asked in users.items()
            if peer in {None, owner}
        ]

    def _of_peer(self, peer: int, kind: type[Grant | Unmet]) -> list[tuple[str, str, str]]:
        """What a peer was granted, or refused."""
        return [
            (*place, user)
            for place, users in self._asked.items()
            for (owner, user), asked in users.items()
            if owner == peer and isinstance(asked.found, kind)
        ]

    # --- what subclasses know ---------------------------------------------------------------------------------------

    def _unmet(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        """The condition that does not hold for a peer by the rules and the graph."""
        raise NotImplementedError

    async def _find(self, session: PeerSession, want: Want) -> Grant | Unmet:
        """Where the node listens, if the peer may reach it."""
        raise NotImplementedError

    def _changed(self, session: PeerSession, want: Want, *, granted: bool) -> None:
        """A user has got a grant, or has none any more."""

    def _broke(self, want: Want) -> None:
        """A peer's user says that its connection ended by itself."""

    # --- requests ---------------------------------------------------------------------------------------------------

    async def _ask(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        asked = read_ask(args)
        want, peer = asked.want, session.peer
        users = self._asked.setdefault(want[:2], {})
        before = users.get((peer, want.user))
        if asked.broken and before is not None and isinstance(before.found, Grant):
            self._broke(want)
        entry = users[peer, want.user] = Asked(asked, before.found if before is not None else None)
        found: Grant | Unmet | None = self._judged(session, asked)
        if found is None:
            found = await self._find(session, want)
            found = self._judged(session, asked) or found  # the graph may have changed meanwhile
            if self._asked.get(want[:2], {}).get((peer, want.user)) is not entry:
                return reply_of(_GIVEN_UP)  # released, or asked again
        self._set(session, want, entry, found)
        if isinstance(found, Grant):
            self._counters.add("direct.granted")
        _log.debug("< %s: %s: %s", session.link.name, want, found)
        return reply_of(found)

    def _judged(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        """The condition that does not hold for a peer; the name of a user is granted once for each node."""
        unmet = self._unmet(session, asked)
        if unmet is not None:
            return unmet
        granted = self.of(asked.name, asked.node)
        if asked.user and any(user == asked.user and peer != session.peer for peer, user, _ in granted):
            return Unmet(Condition.CALLER_ID, f"a node {asked.user} of another module is connected already")
        mine = self._of_peer(session.peer, Grant)
        if len(mine) >= limits.DIRECT_MAX and asked.want not in mine:
            return Unmet(Condition.LIMIT, f"more than {limits.DIRECT_MAX} direct connections to this module")
        return None

    def _unmet_by_trust(self, session: PeerSession, where: str) -> Unmet | None:
        return unmet_by_trust(self._gate, where, same_machine=session.same_machine)

    def _hidden(self, found: Grant | Unmet) -> bool:
        """Whether a peer must not learn of changes: it may not have this topic or service."""
        return self._gate.on and isinstance(found, Unmet) and found.condition is Condition.OFFERED

    def _set(self, session: PeerSession, want: Want, entry: Asked, found: Grant | Unmet) -> None:
        before, entry.found = entry.found, found
        if isinstance(before, Grant) != isinstance(found, Grant):
            self._changed(session, want, granted=isinstance(found, Grant))
        if self._hidden(found):
            self._forget(session.peer, want)
        if isinstance(found, Unmet):
            mine = self._of_peer(session.peer, Unmet)
            if len(mine) > limits.DIRECT_MAX:
                self._forget(session.peer, Want(*mine[0]))
        if isinstance(before, Grant) and isinstance(found, Unmet):
            self._freed(session, want)

    def _forget(self, peer: int, want: Want) -> Asked | None:
        users = self._asked.get(want[:2], {})
        found = users.pop((peer, want.user), None)
        if not users:
            self._asked.pop(want[:2], None)
        return found

    def _drop(self, session: PeerSession, want: Want) -> None:
        found = self._forget(session.peer, want)
        if found is not None and isinstance(found.found, Grant):
            self._changed(session, want, granted=False)
            self._freed(session, want)

    def _freed(self, session: PeerSession, want: Want) -> None:
        """Lets other peers ask again that were refused because of a user's name."""
        for (peer, user), asked in list(self._asked.get(want[:2], {}).items()):
            other = self._sessions.get(peer)
            refused = user == want.user and isinstance(asked.found, Unmet)
            if refused and other is not None and other is not session and other.linked:
                self._tell(other, want)

    def _again(self, which: Callable[[Want], bool]) -> None:
        """Lets peers ask again: something has changed."""
        for peer, want, asked in self._all():
            session = self._sessions.get(peer)
            if session is not None and session.linked and asked.found is not None and which(want):
                self._tell(session, want)

    def _tell(self, session: PeerSession, want: Want) -> None:
        self._rpc.notify(session, f"direct.{self.kind}_again", want._asdict())

    def _released(self, session: PeerSession, args: dict[str, Any]) -> None:
        self._drop(session, read_want(args))

    # --- the bridge's part ------------------------------------------------------------------------------------------

    def judge_again(self, *, refused: bool = True) -> None:
        """Compare the answers with other rules: connections that are not allowed any more end, others ask again.

        In a secured mesh ending them is not left to the peer's agent.

        Args:
            refused: Have the peers ask again for what they were refused, too.
        """
        for peer, want, asked in self._all():
            session, before = self._sessions.get(peer), asked.found
            if session is None or before is None or not (refused or isinstance(before, Grant)):
                continue
            unmet = self._judged(session, asked.asked)
            changed = isinstance(before, Grant) is (unmet is not None)
            if unmet is not None:
                if self._gate.on and isinstance(before, Grant):
                    self._end(session, before.port)
                if changed or self._hidden(unmet):
                    self._set(session, want, asked, unmet)
                changed = changed and not self._hidden(unmet)
            if changed and session.linked:
                self._tell(session, want)

    def link_up(self, session: PeerSession) -> None:
        """Let a peer ask again for what it uses; what it was granted over an earlier link ends a little later."""
        before = [(want, asked) for _, want, asked in self._all(session.peer)]
        if before:
            asyncio.get_running_loop().call_later(limits.DIRECT_ADOPT, self._expire, session, before)

    def _expire(self, session: PeerSession, before: list[tuple[Want, Asked]]) -> None:
        for want, asked in before:
            if self._asked.get(want[:2], {}).get((session.peer, want.user)) is asked:
                self._drop(session, want)

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """Forget what a peer asked for, and end its connections if it is silent; unless only its agent has died.

        The nodes of a peer that left in order go on. So do those of another module on its host.
        On this machine no connection outlives its process, and the nodes of all modules have the same address.
        """
        if crashed:
            return
        shared = any(other.address == session.address for other in self._sessions.linked() if other is not session)
        if session.link.silent and not shared:
            for port in {grant.port for peer, _, grant in self if peer == session.peer}:
                self._end(session, port)
        self.gone(session)

    def gone(self, session: PeerSession) -> None:
        """Forget what a peer asked for."""
        for _, want, _ in self._all(session.peer):
            self._drop(session, want)

    def _end(self, session: PeerSession, port: int) -> None:
        if session.same_machine:
            return
        self._counters.add("direct.ended")
        if problem := end_from(port, session.address):
            text = "! %s: connections of local nodes to it may hang: they cannot be ended (%s)"
            _log.info(text, session.link.name, problem)
