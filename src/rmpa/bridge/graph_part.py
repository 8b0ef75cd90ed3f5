"""What the parts for topics and for services have in common."""

from __future__ import annotations

import asyncio
import logging
from abc import abstractmethod
from collections import OrderedDict, deque
from itertools import chain
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rmpa.bridge import limits
from rmpa.bridge.messages import Advertise, AdvertiseServices, Origin, SubscriptionChanges, decode, encode
from rmpa.bridge.peer_offers import ImportBook, ImportEffects, Remote
from rmpa.bridge.sessions import Part, PeerSession, guarded
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.log import RefusalLog, logged_failure
from rmpa.runtime.loop import MachineTimer, turn_end, until, yield_to_data

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.direct.grants import Grants
    from rmpa.bridge.direct.paths import Paths
    from rmpa.bridge.messages import Message, Source
    from rmpa.bridge.offers import OfferBook
    from rmpa.bridge.policy import BridgeContext, Place
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.master.parameters import GraphState

_log = logging.getLogger(__name__)

_END: Final = object()


def _while(queue: Collection[object]) -> Iterator[None]:
    """Yield for as long as something is queued."""
    while queue:
        yield


def go_on(queue: deque[Any]) -> None:
    """Do the next item of the work that has waited longest; what has none any more leaves the queue."""
    if next(queue[0][1], _END) is _END:
        queue.popleft()


class GraphPart(Part, ImportEffects):
    """Offers to peers what the local graph has, and shows in it what they offer.

    A graph of thousands of names must not delay a message. Names to look at, advertisements to apply and entries to
    judge by new rules are therefore queued. A millisecond of this work is done in each turn of the event loop, and
    data may be handled between any two items. Nothing else lets data pass: what ``exports`` and ``imports`` have done
    here (a message is sent, a topic is published) is done at once, and calls neither of them back in the same turn.

    Args:
        bridge: The core, the peers and the rules.
        exports: The class of ``exports``.
        imports: The class of ``imports``.

    Attributes:
        bridge: The core, the peers and the rules.
        exports: What is offered.
        imports: What peers offer.
        direct: The direct connections of local nodes to peers' ones, and of peers' nodes to local ones.
        verb: What a peer does with its entries, for the log.
        refusals: Logs and counts warnings, and peers that break the protocol.
    """

    exports: OfferBook[Any, Any, Any, Any]
    imports: ImportBook[Any, Any, Any]
    direct: tuple[Grants | Paths[Any], ...] = ()
    verb: ClassVar[str]

    def __init__(
        self, bridge: Bridge, exports: type[OfferBook[Any, Any, Any, Any]], imports: type[ImportBook[Any, Any, Any]]
    ) -> None:
        self.bridge = bridge
        self.rng = bridge.rng
        self.refusals = RefusalLog(_log, bridge.counters)
        self.exports = exports(self)
        self.imports = imports(self)
        self._timer = MachineTimer(self.imports.next_timer, self.imports.handle_timer)
        # Ordered: in a plain dict, taking the first item skips over the places of all items taken before.
        self._changed: OrderedDict[str, None] = OrderedDict()
        self._advertisements: deque[tuple[PeerSession, Iterator[None]]] = deque()
        self._unread_bytes = 0
        self._slowly: deque[tuple[None, Iterator[None]]] = deque()
        self._scan_handle: asyncio.Handle | None = None
        self._compared: GraphState | None = None
        self._skipped = 0
        self._closed = False

    @property
    def context(self) -> BridgeContext:
        """The rules that hold now."""
        return self.bridge.context

    async def close(self) -> None:
        """Stop all slices and the timer."""
        self._closed = True
        self._timer.close()
        if self._scan_handle is not None:
            self._scan_handle.cancel()

    def send(self, peer: int, message: Message) -> None:
        """As of ``ImportEffects``."""
        session = self.bridge.sessions.get(peer)
        if session is not None and session.linked:
            session.link.send_control(encode(message))

    def warn(self, kind: str, who: str, text: str) -> None:
        """As of ``ImportEffects``."""
        self.refusals.refuse(self.now(), kind, who, text)

    def arm_timer(self) -> None:
        """As of ``ImportEffects``."""
        self._timer.arm()

    def path_changed(self, entry: Remote[Any]) -> None:
        """As of ``ImportEffects``."""
        if entry.shown:
            self.pass_on(entry)
            self.look((entry.name,))

    def pass_on(self, entry: Remote[Any]) -> None:
        """Have what a peer offers relayed to others, if this module relays."""
        relay, session = self.bridge.relay, self.bridge.sessions.get(entry.peer)
        if relay.enabled and session is not None:
            source, place = self._relayed(entry, self.bridge.sessions.proxy_name(session, entry.node, entry.origin))
            whose = session.link.identity
            own = Origin(whose.name, str(whose.guid), whose.instance.hex(), source.node, ())
            relay.shown(entry.peer, source, place, entry.origin or own)

    @abstractmethod
    def _relayed(self, entry: Remote[Any], proxy: str) -> tuple[Source, Place]:
        """What ``policy.Relay`` knows an entry by: its source, and its place at its proxy."""

    def refuse(self, session: PeerSession, error: RemoteProtocolError) -> None:
        """Log that a peer broke the protocol, and close its link."""
        text = f"{session.link.name} broke the protocol: {error}"
        self.warn("link.malformed", session.link.remote_endpoint[0], text)
        session.link.abort(text)

    def now(self) -> float:
        """Monotonic seconds."""
        return asyncio.get_running_loop().time()

    def link_up(self, session: PeerSession) -> None:
        """Begin the advertisement to a peer, and wait for the peer's own."""
        self.imports.ways.instance = self.bridge.relay.instance
        self.imports.link_up(session)
        self.exports.link_up(session)
        for each in self.direct:
            each.link_up(session)
        self.schedule()

    def link_down(self, session: PeerSession) -> None:
        """A link is gone; what the peer offers stays in the graph until ``grace_over``."""
        for each in self.direct:
            each.link_down(session)
        self.exports.link_down(session.peer)
        self.imports.link_down(session.peer)

    def grace_over(self, session: PeerSession) -> bool:
        """Remove what the peer offers from the local graph; nothing is kept for it."""
        self.run(self.imports.gone(session.peer))
        return False

    def gone(self, session: PeerSession) -> None:
        """Forget a peer."""
        for each in self.direct:
            each.gone(session)
        self.run(self.imports.gone(session.peer))

    def depends(self, session: PeerSession) -> bool:
        """Whether an advertisement of a peer is not applied yet."""
        return any(one is session for one, _ in self._advertisements)

    def reached_here(self, instance: str, *, reached: bool) -> None:
        """Set whether this module reaches another one outside the mesh; what relays bring of that one is hidden."""
        self.imports.reached_here(instance, reached=reached)

    def advertised(self, session: PeerSession, payload: bytes) -> None:
        """Queue a peer's advertisement. Parsing takes long, so it is done later, unless too many bytes wait.

        Raises:
            LimitExceeded: It is longer than ``limits.ADVERTISEMENT_MAX``.
        """
        if len(payload) > limits.ADVERTISEMENT_MAX:
            raise LimitExceeded("advertisement", len(payload), limits.ADVERTISEMENT_MAX)
        self._unread_bytes += len(payload)
        self._advertisements.append((session, self._apply(session, session.link, payload)))
        self.schedule()
        while self._unread_bytes > limits.ADVERTISED_WAITING_BYTES:
            go_on(self._advertisements)

    def _apply(
        self, session: PeerSession, link: PeerLink, message: bytes | Message | SubscriptionChanges
    ) -> Iterator[None]:
        """Parse an advertisement, and apply it, an entry with each item, while the link stands by which it came."""
        if isinstance(message, bytes):
            self._unread_bytes -= len(message)
            if session.link is not link or not session.linked:
                return
            try:
                message = decode(message)
            except RemoteProtocolError as error:
                self.refuse(session, error)
                return
            yield
        if isinstance(message, Advertise | AdvertiseServices | SubscriptionChanges):
            if message.added or message.removed:
                more, less = len(message.added), len(message.removed)
                _log.debug("< %s %s %d more %s, %d less", session.link.name, self.verb, more, self.exports.kind, less)
            for change in self.imports.changes(session.peer, message):
                if session.link is not link or not session.linked:
                    return
                with logged_failure(_log, "an offer of %s failed; the others are taken", session.link.name):
                    self.imports.take_in(session.peer, *change, self.now())
                yield

    @abstractmethod
    def _look_at(self, name: str) -> None:
        """Take the present state of a name in the local graph."""

    @abstractmethod
    def _names(self) -> Iterable[str]:
        """All names of the local graph, and those that were seen in it."""

    def _settled(self) -> None:
        """Nothing is left to do after a change."""

    def start(self) -> None:
        """Follow the local graph."""
        self.look(self._names())

    def look(self, names: Iterable[str]) -> None:
        """Queue names under which the local graph may have changed."""
        self._changed |= dict.fromkeys(names)
        self.schedule()

    def look_again(self) -> bool:
        """Queue all names, unless nothing can have changed since they were; return whether it was done.

        A graph of 1,000 modules has tens of thousands of names, and comparing them takes half a second of processor
        time. A core returns the same object until something is registered, so an idle agent compares seldom. Whether
        a node is reachable decides, too.
        """
        state = self.bridge.core.state()
        if self._skipped < limits.RECONCILE_SKIPS and state is self._compared and not self.bridge.core.unreachable():
            self._skipped += 1
            return False
        self._compared, self._skipped = state, 0
        self.look(self._names())
        return True

    def reload(self) -> None:
        """Judge by new rules; entries and routes that they do not change go on untouched."""
        self.slowly(chain(self.exports.reload(), self.imports.reload(self.now())))

    def slowly(self, steps: Iterator[None]) -> None:
        """Queue work of many items, behind what is queued already."""
        self._slowly.append((None, steps))
        self.schedule()

    def run(self, steps: Iterator[object]) -> None:
        """Take all items now; data is handled between any two."""
        for _ in steps:
            yield_to_data()

    def schedule(self, delay: float = 0.0) -> None:
        """Do a slice of the queued work in the next turn of the loop, or after a delay in seconds."""
        if self._scan_handle is None and not self._closed:
            loop = asyncio.get_running_loop()
            self._scan_handle = loop.call_later(delay, self._scan) if delay else loop.call_soon(self._scan)

    def _scan(self) -> None:
        """Take one turn of the loop for it; each kind of work gets on by one item at least."""
        self._scan_handle = None
        end, told, slow = turn_end(), False, bool(self._slowly)
        with logged_failure(_log, "a slice of work failed; the rest goes on"):
            for _ in until(end, _while(self._changed)):
                self._look_at(self._changed.popitem(last=False)[0])
            for _ in until(end, self.exports.advertise(self.now(), self._is_busy)):
                told = True
            for _ in until(end, _while(self._advertisements)):
                go_on(self._advertisements)
            for _ in until(end, _while(self._slowly)):
                go_on(self._slowly)
        pending = self.exports.pending
        if self._changed or self._advertisements or slow or (told and pending):
            self.schedule()
        elif pending:  # earlier portions are still on their way
            self.schedule(limits.TELL_PAUSE)
        else:
            with guarded(self):
                self._settled()

    def _is_busy(self, peer: int) -> bool:
        session = self.bridge.sessions.get(peer)
        return session is not None and session.link.busy
