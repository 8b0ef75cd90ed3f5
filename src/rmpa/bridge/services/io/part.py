"""Services across the mesh: what this module provides is called by peers, and what they provide stands here.

The two plans are pure (``services.imports``, ``services.exports``); this part of the bridge carries
them out. A call takes this way::

    client → proxy's ServiceEndpoint → Caller ⇢ link ⇢ Server → ServicePool → server
                                              ⇠      ⇠
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.actions import Send, Warn
from rmpa.bridge.messages import (
    AdvertiseServices,
    CloseService,
    OpenService,
    ServiceClosed,
    ServiceOpened,
    Source,
    encode,
)
from rmpa.bridge.naming import Names
from rmpa.bridge.pacing import Pacing
from rmpa.bridge.policy import Policy, is_own
from rmpa.bridge.services.exports import ExportAction, LocalService, ServiceAbout, ServiceExports
from rmpa.bridge.services.imports import (
    EndedService,
    ForgetAbout,
    ImportAction,
    OpenedService,
    Provide,
    ServiceImports,
    SessionState,
    Withdraw,
)
from rmpa.bridge.services.io.calls import Budgets, Caller, CallStats
from rmpa.bridge.services.io.serving import Serving
from rmpa.bridge.services.rules import ServiceRules
from rmpa.bridge.session.part import Part
from rmpa.config.settings import LimitSettings
from rmpa.core.counters import RefusalLog
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.master.effects import GraphChange, RegistrationKind
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.wire.services import ServiceDescription
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.event_loop import yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.bridge.io.bridge import Bridge, PeerSession
    from rmpa.bridge.messages import Message
    from rmpa.config.settings import Settings
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode

_log = logging.getLogger(__name__)

_MISMATCH: Final = "service.mismatch"


@dataclass(slots=True, eq=False)
class ShownService:
    """A peer's service in the local graph.

    Args:
        peer: Whose.
        service: Its name here.
        node: Its node, in the peer's graph.
        whose: The peer's name.
        stats: What became of its calls.
        proxy: The node that stands for that one, once it is there.
        endpoint: What clients connect to, likewise.
        caller: Where calls go, while the service is open.
        waiting: Calls that wait until it is.
        asking: Who wants to know what it is.
        mismatch: What a client was told whose md5 sum did not fit; empty if none was.
    """

    peer: int
    service: str
    node: str
    whose: str
    stats: CallStats = field(default_factory=CallStats)
    proxy: SlaveNode | None = None
    endpoint: ServiceEndpoint | None = None
    caller: Caller | None = None
    waiting: list[ServiceCall] = field(default_factory=list)
    asking: list[asyncio.Future[ServiceDescription | str]] = field(default_factory=list)
    mismatch: str = ""


class Services(Part):
    """Both directions, for all peers.

    Args:
        core: The local core.
        bridge: Whose part this is.
        rules: What may cross, under which names, and for how long.
        most: How much of one peer is taken, and how much is offered.
    """

    def __init__(self, core: Core, bridge: Bridge, rules: ServiceRules, most: LimitSettings | None = None) -> None:
        self._most = most if most is not None else LimitSettings()
        self._core = core
        self._bridge = bridge
        self.rules = rules
        """What may cross, for the monitor too."""
        self.exports = ServiceExports(rules, self._most)
        """The outbound plan, for the monitor."""
        self.imports = ServiceImports(rules, self._most)
        """The inbound plan, for the monitor."""
        self._refusals = RefusalLog(_log, bridge.counters)
        self._attached: dict[int, PeerSession] = {}
        self._budgets: dict[int, Budgets] = {}
        self._shown: dict[tuple[int, str], ShownService] = {}
        self._callers: dict[tuple[int, int], ShownService] = {}
        self._serving = Serving(core, self.exports, self._attached, self._budgets, self._act)
        self._grace: dict[int, asyncio.TimerHandle] = {}
        self._changed: OrderedDict[str, None] = OrderedDict()
        self._rejudging: Iterator[list[ExportAction] | list[ImportAction]] | None = None
        self._pacing = Pacing()
        self._lessons: deque[tuple[int, AdvertiseServices]] = deque()
        self._actions: deque[ExportAction | ImportAction] = deque()
        self._acting = False
        self._rescan: asyncio.Handle | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._closed = False
        bridge.asks.on_tell(_MISMATCH, self._told_of_mismatch)

    def __iter__(self) -> Iterator[ShownService]:
        """The peers' services in the local graph."""
        return iter(self._shown.values())

    def shown(self, peer: int, service: str) -> ShownService | None:
        """One of them."""
        return self._shown.get((peer, service))

    @property
    def served(self) -> Mapping[str, CallStats]:
        """What became of the calls of our services by peers."""
        return self._serving.stats

    def reload(self, settings: Settings) -> None:
        """Other settings hold from now on."""
        policy, names = Policy(settings.policy, settings.peers, settings.time), Names(settings.peers)
        self._most = settings.limits
        self.obey(ServiceRules(settings.services, policy, names))

    def obey(self, rules: ServiceRules) -> None:
        """Other rules hold from now on; what they do not touch goes on."""
        self.rules = rules
        self._rejudging = chain(self.exports.obey(rules, self._most), self.imports.obey(rules, self._most))
        for shown in yielding_to_data(list(self._shown.values()), every=16):
            timeout, endpoint = rules.timeout(shown.service), shown.endpoint
            if endpoint is not None and endpoint.timeout != timeout:
                endpoint.timeout = timeout
                if shown.caller is not None and not shown.caller.active:
                    # The next call opens it anew, and tells how long it waits now.
                    self._act(self.imports.release(shown.peer, shown.service, "its timeout has changed"))
        self._schedule()

    # --- the bridge's part -------------------------------------------------------------------------------------

    def start(self) -> None:
        """Follow the local graph."""
        self._loop = asyncio.get_running_loop()
        self._changed |= dict.fromkeys(self._core.state().services)
        self._schedule()
        self._serving.start()

    async def close(self) -> None:
        """End every call, and every connection to a server."""
        self._closed = True
        for handle in (self._rescan, self._timer, *self._grace.values()):
            if handle is not None:
                handle.cancel()
        await self._serving.close()

    def link_up(self, attached: PeerSession) -> None:
        """Tell what we have; what the peer has is told by it."""
        peer, link = attached.peer, attached.link
        if (grace := self._grace.pop(peer, None)) is not None:
            grace.cancel()
        self._attached[peer] = attached
        self._budgets[peer] = Budgets()
        instance = link.identity.instance.hex()
        self.imports.ways.instance = self._bridge.relay.instance
        self._act(self.imports.link_up(peer, link.name, link.guid.value, instance))
        self._act(self.exports.link_up(peer, link.name, instance))
        for shown in [one for one in self._shown.values() if one.peer == peer and (one.waiting or one.asking)]:
            self._want(shown)
        self._schedule()

    def link_down(self, attached: PeerSession) -> None:
        """Calls under way fail; the services stay for a moment if the link just fell silent."""
        peer = attached.peer
        self._act(self.imports.link_down(peer))
        self._act(self.exports.link_down(peer))
        if peer in self._grace:
            return
        if attached.link.silent and not self._closed:
            self._grace[peer] = self._loop.call_later(mesh_limits.AWAY_GRACE, self._stay_away, peer)
        else:
            self._stay_away(peer)

    def gone(self, attached: PeerSession) -> None:
        """The peer will not come back."""
        self._stay_away(attached.peer)
        self._act(self.imports.unlinked(attached.peer))
        self._attached.pop(attached.peer, None)
        self._budgets.pop(attached.peer, None)
        self._pacing.forget(attached.peer)

    def _stay_away(self, peer: int) -> None:
        if (grace := self._grace.pop(peer, None)) is not None:
            grace.cancel()
        self._act(self.imports.gone(peer))

    def message(self, attached: PeerSession, message: Message) -> bool:
        """Take what is said of services."""
        peer = attached.peer
        match message:
            case AdvertiseServices():
                if message.added or message.removed:
                    changes = (len(message.added), len(message.removed))
                    _log.info("< %s provides %d more services, %d less", attached.link.name, *changes)
                self._lessons.append((peer, message))
                self._schedule()
            case OpenService():
                self._act(self.exports.opened(peer, message))
            case CloseService():
                self._act(self.exports.closed(peer, message))
            case ServiceOpened():
                self._act(self.imports.opened(peer, message))
            case ServiceClosed():
                _log.debug("< %s closes route %d: %s", attached.link.name, message.route, message.reason)
                self._act(self.imports.closed(peer, message))
            case _:
                return False
        return True

    def graph_changed(self, change: GraphChange) -> None:
        """Somebody provides a service, or no longer does."""
        if change.kind is RegistrationKind.SERVICE:
            self._changed[change.name] = None
            self._schedule()

    def lane_lost(self, attached: PeerSession) -> None:
        """Calls that used the bulk lane may never be answered."""
        peer = attached.peer
        for (owner, _), shown in list(self._callers.items()):
            if owner == peer and shown.caller is not None:
                shown.caller.lane_lost()
        self._serving.lane_lost(peer)

    def reconcile(self) -> None:
        """Register again what is missing, and close what nobody uses."""
        services = self._core.state().services
        self._changed |= dict.fromkeys((*self.exports.seen, *services))
        self._schedule()
        before = self._loop.time() - limits.SERVICE_IDLE
        for shown in yielding_to_data(list(self._shown.values()), every=16):
            proxy, caller = shown.proxy, shown.caller
            if proxy is not None and shown.service not in services:
                self._register(shown, proxy)
            if caller is not None and not caller.active and caller.used_at < before:
                self._act(self.imports.release(shown.peer, shown.service))
        self._serving.close_idle(before)

    # --- the local graph ---------------------------------------------------------------------------------------

    def _schedule(self) -> None:
        if self._rescan is None and not self._closed:
            self._rescan = self._loop.call_soon(self._scan)

    def _scan(self) -> None:
        """Do a part of what has to be done since graphs have changed, the local one or a peer's."""
        self._rescan = None
        services = self._core.state().services
        for _ in range(min(len(self._changed), limits.RESCANNED_AT_ONCE)):
            service, _ = self._changed.popitem(last=False)
            yield_to_data()
            self._look_at(service, services.get(service, {}))
        told = self.exports.tell(self._may_tell)
        self._act(told)
        if self._lessons:
            self._learn()
        if self._rejudging is not None:
            self._rejudge(self._rejudging)
        if self._changed or self._lessons or self._rejudging is not None or (told and self.exports.untold):
            self._schedule()
        elif self.exports.untold:
            self._scan_later()

    def _scan_later(self) -> None:
        """Peers have to be told more, but what they were told is still on its way."""
        if self._rescan is None and not self._closed:
            self._rescan = self._loop.call_later(limits.TELL_PAUSE, self._scan)

    def _may_tell(self, peer: int) -> bool:
        attached = self._attached.get(peer)
        busy = attached is not None and attached.link.busy
        return self._pacing.ready(peer, self._loop.time(), busy=busy)

    def _rejudge(self, rest: Iterator[list[ExportAction] | list[ImportAction]]) -> None:
        """Judge a portion by rules that have changed."""
        for _ in range(limits.LEARNT_AT_ONCE):
            actions = next(rest, None)
            if actions is None:
                if self._rejudging is rest:
                    self._rejudging = None
                return
            self._act(actions)
            yield_to_data()

    def _look_at(self, service: str, providers: Mapping[str, str]) -> None:
        local = next((LocalService(node, uri) for node, uri in providers.items() if not is_own(node)), None)
        # That it is taken is known before it is told on: nobody may be shown two of a name.
        self._act(self.imports.local(service, local.node if local is not None else None))
        offered = local if local is not None and not self._withdrawn(service, local.node) else None
        self._act(self.exports.graph(service, offered or self._to_relay(service, providers)))

    def _withdrawn(self, service: str, node: str) -> bool:
        """Whether nothing can connect to a server; one that a peer has open answers, whatever the core found."""
        found = self._core.unreachable().get(node)
        return found is not None and found.withdrawn and not self.exports.callers(service)

    def _to_relay(self, service: str, providers: Mapping[str, str]) -> LocalService | None:
        """What of a service is passed on for another module."""
        for node, uri in providers.items():
            if (origin := self._bridge.relay.origin(_relayed(service, node))) is not None:
                return LocalService(node, uri, origin)
        return None

    def _learn(self) -> None:
        """Take in a portion of what a peer provides."""
        peer, message = self._lessons.popleft()
        first, rest = message.added[: limits.LEARNT_AT_ONCE], message.added[limits.LEARNT_AT_ONCE :]
        if rest:
            # What is no more is taken in at the end: what takes its place must not find it there.
            self._lessons.appendleft((peer, AdvertiseServices(rest, more=message.more)))
            message = AdvertiseServices(first, message.removed, message.full, more=True)
        self._act(self.imports.advertised(peer, message))

    # --- carrying out ------------------------------------------------------------------------------------------

    def _act(self, actions: list[ExportAction] | list[ImportAction]) -> None:
        """Do these behind those that are being done: in between data may come first, and bring more of them."""
        self._actions.extend(actions)
        if self._acting:
            return
        self._acting = True
        try:
            while self._actions:
                self._do(self._actions.popleft())
                yield_to_data()
        finally:
            self._acting = False
        self._set_timer()

    def _do(self, action: ExportAction | ImportAction) -> None:
        match action:
            case Send():
                attached = self._attached.get(action.peer)
                if attached is not None and attached.away is None:
                    attached.link.send_control(encode(action.message))
            case Warn():
                self._refusals.refuse(self._loop.time(), action.kind, action.who, action.text)
            case Provide() | Withdraw() | OpenedService() | EndedService() | ForgetAbout():
                self._do_shown(action)
            case _:
                self._serving.do(action)

    def _do_shown(self, action: Provide | Withdraw | OpenedService | EndedService | ForgetAbout) -> None:
        match action:
            case Provide():
                self._provide(action)
            case Withdraw():
                self._withdraw(action)
            case OpenedService():
                self._opened(action)
            case EndedService():
                self._ended(action)
            case ForgetAbout():
                shown = self._shown.get((action.peer, action.service))
                if shown is not None and shown.endpoint is not None:
                    shown.endpoint.description = None

    def _set_timer(self) -> None:
        due = self.imports.next_timer()
        if self._timer is not None:
            if self._timer.when() == due:
                return
            self._timer.cancel()
            self._timer = None
        if due is not None and not self._closed:
            self._timer = self._loop.call_at(due, self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        # The loop's clock may round a timer to a moment before it is due.
        self._act(self.imports.handle_timer(self._loop.time() + 0.001))

    # --- peers' services here ----------------------------------------------------------------------------------

    def _provide(self, action: Provide) -> None:
        attached = self._attached.get(action.peer)
        if attached is None:
            return
        remote = self.imports.get(action.peer, action.service)
        name = self._bridge.stand_in(attached, action.node, remote.origin if remote is not None else None)
        self._bridge.relay_on(
            attached,
            Source(f"service {action.service}", action.node),
            _relayed(action.service, name),
            remote.origin if remote is not None else None,
        )
        shown = self._shown[action.peer, action.service] = ShownService(
            action.peer, action.service, action.node, self.imports.peer_name(action.peer)
        )
        attached.inbound.hold(action.node, f"service {action.service}", lambda proxy: self._expose(shown, proxy))

    def _expose(self, shown: ShownService, proxy: SlaveNode) -> None:
        """The proxy is there: register the service, unless it is gone again."""
        if self._shown.get((shown.peer, shown.service)) is not shown or shown.endpoint is not None:
            return
        shown.proxy = proxy
        shown.endpoint = ServiceEndpoint(
            shown.service,
            proxy.name,
            lambda call: self._call(shown, call),
            lambda: self._describe(shown),
            timeout=self.rules.timeout(shown.service),
            on_mismatch=lambda fields, text: self._mismatched(shown, fields, text),
        )
        proxy.add_service(shown.endpoint)
        self._register(shown, proxy)

    def _register(self, shown: ShownService, proxy: SlaveNode) -> None:
        providers = self._core.state().services.get(shown.service, {})
        if any(node != proxy.name for node in providers):
            return  # somebody came first: the scan hides ours, or did so already
        code, status, _ = self._core.call("registerService", proxy.name, shown.service, proxy.service_uri, proxy.uri)
        if code != 1:
            _log.error("! the local core does not take %s of %s: %s", shown.service, proxy.name, status)

    def _withdraw(self, action: Withdraw) -> None:
        self._bridge.relay.gone(action.peer, Source(f"service {action.service}", action.node))
        shown = self._shown.pop((action.peer, action.service), None)
        if shown is None:
            return
        proxy = shown.proxy
        text = f"service [{shown.service}] of {shown.whose}: {action.reason}"
        self._fail_waiting(shown, text)
        if proxy is not None:
            self._core.call("unregisterService", proxy.name, shown.service, proxy.service_uri)
            proxy.remove_service(shown.service, text)
        attached = self._attached.get(action.peer)
        if attached is not None:
            attached.inbound.release(action.node, f"service {action.service}")

    def _call(self, shown: ShownService, call: ServiceCall) -> None:
        """A client's request; the hot path."""
        if shown.caller is not None:
            shown.caller.call(call)
            return
        shown.waiting.append(call)
        call.on_gone = lambda: shown.waiting.remove(call) if call in shown.waiting else None
        self._want(shown)

    async def _describe(self, shown: ShownService) -> ServiceDescription | str:
        remote = self.imports.get(shown.peer, shown.service)
        if remote is not None and remote.about is not None:
            return _description(remote.about)
        answer: asyncio.Future[ServiceDescription | str] = self._loop.create_future()
        shown.asking.append(answer)
        self._want(shown)
        return await answer

    def _want(self, shown: ShownService) -> None:
        """Open a service; if its peer has no link at this moment, its next link or its end will go on from here."""
        remote = self.imports.get(shown.peer, shown.service)
        if remote is None or not remote.shown:
            self._fail_waiting(shown, f"service [{shown.service}] of {shown.whose} has just gone")
        elif remote.state is SessionState.IDLE and not self.imports.is_away(shown.peer):
            self._act(self.imports.want(shown.peer, shown.service, self._loop.time()))

    def _opened(self, action: OpenedService) -> None:
        shown = self._shown.get((action.peer, action.service))
        attached = self._attached.get(action.peer)
        if shown is None or attached is None or attached.away is not None:
            return
        what = f"service [{shown.service}] of {shown.whose}"
        caller = shown.caller = Caller(attached.link, action.requests, what, self._budgets[action.peer], shown.stats)
        attached.takers[action.route] = caller
        self._callers[action.peer, action.route] = shown
        description = _description(action.about)
        asking, shown.asking = shown.asking, []
        for future in asking:
            if not future.done():
                future.set_result(description)
        waiting, shown.waiting = shown.waiting, []
        for call in waiting:
            caller.call(call)

    def _ended(self, action: EndedService) -> None:
        attached = self._attached.get(action.peer)
        if attached is not None:
            attached.takers.pop(action.route, None)
        shown = self._callers.pop((action.peer, action.route), None)
        if shown is not None and shown.caller is not None:
            caller, shown.caller = shown.caller, None
            caller.close(action.reason)
        shown = self._shown.get((action.peer, action.service))
        if shown is not None and shown.caller is None:
            self._fail_waiting(shown, f"service [{shown.service}] of {shown.whose}: {action.reason}")

    def _fail_waiting(self, shown: ShownService, text: str) -> None:
        asking, shown.asking = shown.asking, []
        for future in asking:
            if not future.done():
                future.set_result(text)
        waiting, shown.waiting = shown.waiting, []
        for call in waiting:
            shown.stats.calls += 1
            shown.stats.fail(text)
            call.fail(text)

    def _mismatched(self, shown: ShownService, fields: Mapping[str, str], text: str) -> None:
        """A client was refused, here and at once; said on both sides."""
        caller_id = printable(fields.get("callerid", ""))
        shown.mismatch = text
        shown.stats.calls += 1
        shown.stats.fail(text)
        self._refusals.refuse(self._loop.time(), _MISMATCH, f"{shown.service}{caller_id}", text)
        attached, remote = self._attached.get(shown.peer), self.imports.get(shown.peer, shown.service)
        if attached is not None and attached.away is None and remote is not None:
            args: dict[str, Any] = {"service": remote.wire, "text": text[: limits.CONTROL_TEXT_MAX]}
            self._bridge.asks.tell(attached, _MISMATCH, args)

    def _told_of_mismatch(self, attached: PeerSession, args: dict[str, Any]) -> None:
        text = printable(str(args.get("text", ""))[: limits.CONTROL_TEXT_MAX])
        self._refusals.refuse(
            self._loop.time(), "service.mismatch_remote", attached.link.name, f"{attached.link.name}: {text}"
        )


def _relayed(service: str, node: str) -> tuple[str, str]:
    """A service's place among what is relayed: a topic may have its name."""
    return f"service {service}", node


def _description(about: ServiceAbout) -> ServiceDescription:
    return ServiceDescription(about.type, about.md5, about.request_type, about.response_type)
