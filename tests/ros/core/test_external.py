from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, Final

import pytest

from rmpa.core.errors import LocalProtocolError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.core import liveness
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.external import MASTER_FAREWELL, MASTER_RETRY, ExternalCore
from rmpa.ros.core.liveness import Liveness, Unreachable
from rmpa.ros.http.server import XmlRpcServer
from rmpa.ros.master.parameters import GraphChange
from rmpa.ros.node import ask
from rmpa.ros.wire.xmlrpc import RosFault, XmlRpcValue
from tests.waiting import DEADLINE, until

# The external core against masters: the embedded one as another program's, and such that do wrong.


STRING: Final = "std_msgs/String"


OURS: Final = "http://127.0.0.1:1/"


@asynccontextmanager
async def a_master(port: int = 0) -> AsyncIterator[RosCore]:
    """A master, which here is somebody else's."""
    made = RosCore(port=port, rosout=False)
    await made.start()
    yield made
    await made.close()


@asynccontextmanager
async def serving(answer: Callable[..., Any] = lambda *_: [1, "", 0], port: int = 0) -> AsyncIterator[str]:
    """A program that answers calls; by default somebody else's node."""
    server = XmlRpcServer(answer, "127.0.0.1", port)
    await server.start()
    yield f"http://127.0.0.1:{server.port}/"
    await server.close()


@asynccontextmanager
async def external(uri: str) -> AsyncIterator[ExternalCore]:
    """Ours."""
    made = ExternalCore(uri, own_node="/rmpa")
    await made.start()
    yield made
    await made.close()


@pytest.fixture
async def master() -> AsyncIterator[RosCore]:
    async with a_master() as made:
        yield made


@pytest.fixture
async def core(master: RosCore) -> AsyncIterator[ExternalCore]:
    async with external(master.uri) as made:
        yield made


async def test_what_is_called_arrives_in_order_and_is_gone_at_the_end(master: RosCore) -> None:
    seen: list[tuple[bool, str]] = []
    master.on_change(lambda change: seen.append((change.added, change.name)))
    async with external(master.uri) as core:
        told: list[GraphChange] = []
        core.on_change(told.append)
        for number in range(3):
            assert core.call("registerPublisher", "/rmpa", f"/t{number}", STRING, OURS).code == 1
        core.call("unregisterPublisher", "/rmpa", "/t1", OURS)
        core.call("registerService", "/rmpa", "/srv", "rosrpc://127.0.0.1:1", OURS)
        core.call("setParam", "/rmpa", "/key", 5)
        assert [(change.added, change.name) for change in told][-2:] == [(False, "/t1"), (True, "/srv")], "at once"
        assert (await core.ask("getParam", "/rmpa", "/key")).value == 5, "behind what was called"
        expected = [(True, "/t0"), (True, "/t1"), (True, "/t2"), (False, "/t1"), (True, "/srv")]
        assert seen == expected
        assert (await core.ask("subscribeParam", "/rmpa", OURS, "/key")).value == 5
    assert sorted(seen[len(expected) :]) == [(False, "/srv"), (False, "/t0"), (False, "/t2")]
    assert master.state().nodes == {}


async def test_a_master_that_is_not_there_yet_is_waited_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    async with contextlib.AsyncExitStack() as stack:
        core = await stack.enter_async_context(external(f"http://127.0.0.1:{port}/"))
        assert "does not answer" in core.notes()[0]
        assert core.call("registerPublisher", "/rmpa", "/t", STRING, OURS).code == 1
        assert core.call("setParam", "/rmpa", "/key", 5).code == 0
        for method in ("getParam", "deleteParam"):
            with pytest.raises(UnreachableError):
                await core.ask(method, "/rmpa", "/key")
        master = await stack.enter_async_context(a_master(port))
        await until(lambda: master.publishers("/t"))
        assert core.notes() == ()


async def test_restarted_master_gets_all_registrations(
    master: RosCore, core: ExternalCore, caplog: pytest.LogCaptureFixture
) -> None:
    core.call("registerPublisher", "/rmpa", "/t", STRING, OURS)
    async with serving() as api:
        master.call("registerPublisher", "/n", "/u", STRING, api)
        await until(lambda: core.publishers("/u"))
        await master.close()
        await until(core.notes)
        await asyncio.sleep(2 * MASTER_RETRY)
        assert len([r for r in caplog.records if "rmpa waits for it" in r.getMessage()]) == 1, "said once"
        assert core.publishers("/u") == {"/n": api}
        async with a_master(master.port) as again:
            await until(lambda: again.publishers("/t"))
            assert core.publishers("/u") == {"/n": api}, "it goes on, and so do its connections"
            await core.close()


async def test_stopped_master_holds_up_nothing(master: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.ros.core.external.MASTER_TIMEOUT", 0.2)
    stopped = asyncio.Event()

    async def answer(method: str, params: tuple[XmlRpcValue, ...]) -> XmlRpcValue:
        if stopped.is_set():
            await asyncio.sleep(DEADLINE)
        return master._answer(method, params)

    async with serving(answer) as uri, external(uri) as core:
        stopped.set()
        await until(core.notes)
        assert "no answer to system.multicall in 0.2 s" in core.notes()[0]
        assert core.call("registerPublisher", "/rmpa", "/t", STRING, OURS).code == 1
        stopped.clear()
        await until(lambda: master.publishers("/t"))
        stopped.set()
        core.call("unregisterPublisher", "/rmpa", "/t", OURS)
        asking = asyncio.create_task(core.ask("setParam", "/rmpa", "/key", 1))
        async with asyncio.timeout(MASTER_FAREWELL + 2.0):
            await asyncio.sleep(0.01)
            await core.close()
            with pytest.raises(UnreachableError):
                await asking


@pytest.mark.parametrize(
    "wrong", [RosFault(1, "no such method"), "no", [], [[[1, "", 5]]], [[[1, "", [1, 2, 3]]]] * 9]
)
async def test_malformed_master_is_reported_and_polled_again(master: RosCore, wrong: Any) -> None:
    talking = asyncio.Event()

    def answer(method: str, params: tuple[XmlRpcValue, ...]) -> XmlRpcValue:
        if not talking.is_set():
            return master._answer(method, params)
        if isinstance(wrong, RosFault):
            raise wrong
        answered: XmlRpcValue = wrong
        return answered

    async with serving(answer) as uri, external(uri) as core:
        talking.set()
        await until(core.notes)
        assert "otherwise than a ROS master" in core.notes()[0]
        talking.clear()
        await until(lambda: not core.notes())


async def test_refused_registration_is_reported_and_dropped(
    master: RosCore, core: ExternalCore, caplog: pytest.LogCaptureFixture
) -> None:
    core.call("registerPublisher", "/rmpa", "/good", STRING, OURS)
    core.call("registerPublisher", "/rmpa", "no good", STRING, OURS)
    core.call("setParam", "/rmpa", "/none", None)
    core.call("registerPublisher", "/rmpa", "/good2", STRING, OURS)
    with pytest.raises(LocalProtocolError):
        await core.ask("setParam", "/rmpa", "/large", 1 << 40)
    await until(lambda: master.publishers("/good2"))
    assert master.publishers("/good")
    assert core.publishers("no good") == {}
    looks = core.counters.as_dict()["master.looks"]
    await until(lambda: core.counters.as_dict()["master.looks"] >= looks + 2)
    assert core.counters.as_dict()["master.refused"] == 2
    assert "does not accept registerPublisher('/rmpa', 'no good'" in caplog.text
    assert core.call("getParam", "/rmpa", "/good").code == -1, "only the master knows"


async def test_writes_beyond_the_bound_are_found_by_the_next_look(
    master: RosCore, core: ExternalCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.ros.core.external.MASTER_WRITES_MAX", 3)
    for number in range(10):
        core.call("registerPublisher", "/rmpa", f"/t{number}", STRING, OURS)
    await until(lambda: len(master.state().publishers) == 10)


async def test_another_agent_at_the_roscore_is_named(
    master: RosCore, core: ExternalCore, caplog: pytest.LogCaptureFixture
) -> None:
    core.call("registerPublisher", "/rmpa", "/t", STRING, OURS)
    await until(lambda: master.publishers("/t"))
    assert core.notes() == ()
    async with serving() as other:
        master.call("registerPublisher", "/rmpa", "/u", STRING, other)
        await until(core.notes)
        assert f"another agent (its node at {other}) is at the roscore {master.uri}" in core.notes()[0]
        await until(lambda: master.publishers("/t"))
    assert caplog.text.count("another agent") == 1


async def test_dead_node_is_hidden_and_shown_again_if_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "NODE_CHECK_INTERVAL", 0.1)
    monkeypatch.setattr("rmpa.ros.core.liveness.NODE_RECHECK_DELAY", 0.01)
    monkeypatch.setattr(liveness.Liveness, "start", lambda _: None)  # only what is suspected is looked at
    async with a_master() as master, external(master.uri) as core:
        await master.liveness.close()  # a roscore has none: it keeps what is dead
        async with serving() as api:
            master.call("registerPublisher", "/n", "/t", STRING, api)
            await until(lambda: core.publishers("/t"))
        core.suspect("/n")
        await until(lambda: not core.publishers("/t"))
        assert master.publishers("/t") == {"/n": api}
        async with serving(port=int(api.rsplit(":")[-1].rstrip("/"))):
            await until(lambda: core.publishers("/t"))


AT = "http://10.9.9.9:1234/"


AFTER = limits.NODE_UNREACHABLE_AFTER


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OSError(errno.EHOSTUNREACH, "as asked"), "No route to host"),
        (OSError("no number"), "no number"),
        (TimeoutError(), "no answer in 3 s"),
        (UnreachableError("machine", "x", "the name does not resolve here"), "the name does not resolve here"),
        (None, ""),
    ],
)
async def test_why_a_node_cannot_be_reached(
    monkeypatch: pytest.MonkeyPatch, error: Exception | None, text: str
) -> None:
    async def connect(*_: object) -> socket.socket:
        if error is not None:
            raise error
        return socket.socket()

    monkeypatch.setattr(ask, "connect", connect)
    assert await ask.try_connect("http://10.9.9.9:1234/") == text
    assert not await ask.refuses("http://10.9.9.9:1234/")


class Bed:
    """Attempts to reach the node ``/n``, and what the log says of them."""

    def __init__(self, caplog: pytest.LogCaptureFixture) -> None:
        self.liveness = Liveness(nodes=lambda: {"/n": "http://127.0.0.1:1/"}, on_dead=lambda _node, _api: None)
        self.log = caplog

    def tried(self, problem: str, now: float, api: str = AT) -> str:
        """An attempt; returns what was logged."""
        self.log.clear()
        self.liveness.tried("/n", api, problem, now)
        return self.log.text


@pytest.fixture
def bed(caplog: pytest.LogCaptureFixture) -> Bed:
    return Bed(caplog)


def test_a_node_is_withdrawn_after_a_while_and_comes_back(bed: Bed) -> None:
    assert not bed.tried("no route", 100.0)
    assert bed.liveness.unreachable == {"/n": Unreachable(AT, "no route", 100.0)}
    assert not bed.tried("no answer", 99.9 + AFTER)
    assert "cannot be reached (no answer)" in bed.tried("no answer", 100.0 + AFTER)
    assert not bed.tried("no answer", 200.0 + AFTER), "told once"
    assert bed.liveness.unreachable == {"/n": Unreachable(AT, "no answer", 100.0, withdrawn=True)}
    assert "can be reached again" in bed.tried("", 300.0)
    assert not bed.tried("", 301.0)
    assert not bed.liveness.unreachable


def test_a_short_outage_withdraws_nothing(bed: Bed) -> None:
    bed.tried("no route", 0.0)
    assert not bed.tried("", 1.0)
    assert not bed.tried("no route", AFTER), "the time counts anew"


def test_a_node_that_moves_is_forgotten(bed: Bed) -> None:
    bed.tried("no route", 0.0)
    assert not bed.tried("no route", AFTER, "http://10.9.9.8:1/"), "another address begins anew"
    assert bed.liveness._not_listening(None) == ["/n"]
    assert not bed.liveness.unreachable
