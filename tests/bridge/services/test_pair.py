"""Both plans of services back to back, in every order that hypothesis finds; peers that say anything at any time."""

from __future__ import annotations

import contextlib
from collections import deque
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.messages import (
    AdvertiseServices,
    CloseService,
    Message,
    OpenService,
    ServiceClosed,
    ServiceOffer,
    ServiceOpened,
    decode,
    encode,
)
from rmpa.bridge.services.bodies import LocalService
from rmpa.config.settings import ServiceSettings
from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.wire.tcpros import ServiceDescription
from tests.bridge.recorder import (
    EndedService,
    EndRoute,
    ForgetAbout,
    OpenedService,
    Probe,
    Provide,
    Send,
    ServerGone,
    ServeRoute,
    ServiceExports,
    ServiceImports,
    Warn,
    Withdraw,
)
from tests.bridge.services.test_rules import apply_rules, rules

SERVICES = ["/a", "/b", "/c"]
ABOUT = ServiceDescription("a/Add", "6a2e34150c00229791cc89ff309fff21")
OPEN, STRICT = rules(), rules(ServiceSettings(deny=("/b",)))


class World:
    """A serving and a calling bridge, the wires between them, and what their drivers have in hand."""

    def __init__(self) -> None:
        self.exports = ServiceExports(OPEN)
        self.imports = ServiceImports(OPEN)
        self.now = 0.0
        self.linked = False
        self.known = False
        self.rules = OPEN
        self.to_caller: deque[bytes] = deque()
        self.to_server: deque[bytes] = deque()
        self.servers: dict[str, LocalService] = {}
        self.mine: set[str] = set()
        self.visible: dict[str, str] = {}
        self.open: dict[str, tuple[int, int]] = {}
        self.serving: dict[int, str] = {}
        self.probes: deque[Probe] = deque()
        self.starts = 0
        self.link()

    def act(self, actions: list[Any]) -> None:
        for action in actions:
            match action:
                case Send(_, AdvertiseServices() | ServiceOpened() | ServiceClosed() as message):
                    self.to_caller.append(encode(message))
                case Send(_, message):
                    self.to_server.append(encode(message))
                case Probe():
                    self.probes.append(action)
                case ServeRoute():
                    assert action.requests not in self.serving
                    assert self.servers[action.service] == action.server
                    self.serving[action.requests] = action.service
                case EndRoute():
                    del self.serving[action.requests]
                case _:
                    self.act_shown(action)

    def act_shown(self, action: Any) -> None:
        match action:
            case Provide():
                assert action.service not in self.visible
                assert action.service not in self.mine
                self.visible[action.service] = action.node
            case Withdraw():
                assert self.visible.pop(action.service) == action.node
                assert action.service not in self.open
            case OpenedService():
                assert action.service not in self.open
                assert action.service in self.visible
                self.open[action.service] = (action.route, action.requests)
            case EndedService():
                if action.service in self.open:
                    assert self.open.pop(action.service)[0] == action.route
                assert action.reason
            case ServerGone() | ForgetAbout() | Warn():
                pass
            case _:
                raise AssertionError(action)

    # --- what happens -------------------------------------------------------------------------------------------

    def server(self, service: str) -> None:
        """A server comes, or comes back at another address."""
        self.starts += 1
        self.servers[service] = LocalService(f"/n{self.starts % 2}", f"rosrpc://127.0.0.1:{self.starts}")
        self.act(self.exports.graph(service, self.servers[service]))

    def stop(self, service: str) -> None:
        if self.servers.pop(service, None) is not None:
            self.act(self.exports.graph(service, None))

    def own(self, service: str) -> None:
        """The calling module has, or no longer has, one of its own."""
        self.mine ^= {service}
        if service in self.mine:
            # The master puts it in the place of ours at once.
            self.act(self.imports.local(service, "/mine"))
        else:
            self.act(self.imports.local(service, None))

    def want(self, service: str) -> None:
        if service in self.visible and self.linked:
            self.act(self.imports.want(self.imports.get(1, service), self.now))

    def release(self, service: str) -> None:
        if (remote := self.imports.get(1, service)) is not None:
            self.act(self.imports.release(remote, "no node calls it"))

    def change_rules(self, _service: str) -> None:
        self.rules = STRICT if self.rules is OPEN else OPEN
        self.act(apply_rules(self.exports, self.rules))
        self.act(apply_rules(self.imports, self.rules))

    def link(self, _service: str = "") -> None:
        if not self.linked:
            self.linked = self.known = True
            self.act(self.imports.link_up(1, "base", rank=10))
            self.act(self.exports.link_up(1, "pc"))

    def cut(self, _service: str = "") -> None:
        if self.linked:
            self.linked = False
            self.to_caller.clear()
            self.to_server.clear()
            self.act(self.imports.link_down(1))
            self.act(self.exports.link_down(1))
            assert not self.open
            assert not self.serving

    def forget(self, _service: str = "") -> None:
        self.cut()
        self.act(self.imports.gone(1))
        assert not self.visible

    def answer(self, _service: str = "") -> None:
        """The oldest probe is answered, as far as its server is still there."""
        if self.probes:
            probe = self.probes.popleft()
            if self.servers.get(probe.service) == probe.server:
                self.act(self.exports.described(probe.service, probe.server, ABOUT))
            else:
                self.act(self.exports.refused(probe.service, probe.server, "no answer"))

    def deliver(self, _service: str = "") -> bool:
        self.act(self.exports.advertise())
        if self.to_caller:
            self._to_caller(decode(self.to_caller.popleft()))
        elif self.to_server:
            self._to_server(decode(self.to_server.popleft()))
        else:
            return False
        return True

    def time(self, _service: str = "") -> None:
        self.now += 30.0
        self.act(self.imports.handle_timer(self.now))

    def _to_caller(self, message: Message) -> None:
        match message:
            case AdvertiseServices():
                self.act(self.imports.advertised(1, message))
            case ServiceOpened():
                self.act(self.imports.opened(1, message))
            case ServiceClosed():
                self.act(self.imports.closed(1, message))
            case _:
                raise AssertionError(message)

    def _to_server(self, message: Message) -> None:
        match message:
            case OpenService():
                self.act(self.exports.opened(1, message))
            case CloseService():
                self.act(self.exports.closed(1, message))
            case _:
                raise AssertionError(message)

    # --- what must be true ---------------------------------------------------------------------------------------

    def settle(self) -> None:
        self.link()
        while self.deliver() or self.probes:
            self.answer()
        allowed = {service for service in self.servers if self.rules.judge(service, "/n").allowed}
        assert self.visible == {s: self.servers[s].node for s in allowed - self.mine}
        for service in SERVICES:
            self.want(service)
        while self.deliver() or self.probes:
            self.answer()
        assert set(self.open) == set(self.visible), "what is shown can be called"
        assert {requests: service for service, (_, requests) in self.open.items()} == self.serving
        assert self.imports.next_timer() is None


_STEPS = [
    "server", "stop", "own", "want", "release", "change_rules", "link", "cut", "forget", "answer", "deliver",
    "time",
]  # fmt: skip


@settings(max_examples=120, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(_STEPS + ["deliver"] * 6 + ["want", "server"]), st.sampled_from(SERVICES)),
        max_size=60,
    )
)
def test_whatever_happens_both_sides_agree_in_the_end(steps: list[tuple[str, str]]) -> None:
    world = World()
    for step, service in steps:
        getattr(world, step)(service)
    world.settle()


_routes = st.integers(limits.SERVICE_ROUTES, limits.SERVICE_ROUTES + 4)
_anything = st.one_of(
    st.builds(
        AdvertiseServices,
        st.lists(st.builds(ServiceOffer, st.sampled_from(SERVICES), st.sampled_from(["/n", "/m"])), max_size=4).map(
            tuple
        ),
        st.lists(st.sampled_from(SERVICES), max_size=2).map(tuple),
        st.booleans(),
        st.booleans(),
    ),
    st.builds(OpenService, _routes, st.sampled_from(SERVICES)),
    st.builds(ServiceOpened, _routes, _routes, st.just("a/Add"), st.just(ABOUT.md5sum)),
    st.builds(CloseService, _routes),
    st.builds(ServiceClosed, _routes, st.just("why not")),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.one_of(_anything, st.sampled_from(SERVICES)), max_size=40))
def test_a_peer_may_say_anything(said: list[Message | str]) -> None:
    world = World()
    world.server("/a")
    for word in said:
        if isinstance(word, str):
            world.want(word)
            world.answer()
            continue
        with contextlib.suppress(RemoteProtocolError):
            if isinstance(word, OpenService | CloseService):
                world._to_server(word)
            else:
                world._to_caller(word)
    for _, remote in world.imports:
        assert (remote.state == "open") is (remote.requests != 0)
    world.forget()
