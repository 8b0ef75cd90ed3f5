from __future__ import annotations

import asyncio
import selectors
import socket
import time
from collections.abc import Callable, Coroutine, Iterator

import pytest

from rmpa.runtime.loop import AgentLoop, DirectSelector, sorted_yielding, until, yield_to_data, yielding_to_data

DEADLINE = 20.0
Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    one, other = socket.socketpair()
    one.setblocking(False)
    other.setblocking(False)
    yield one, other
    one.close()
    other.close()


Ends = tuple[AgentLoop, socket.socket, socket.socket]


def in_agent_loop(test: Callable[[Ends], Coroutine[object, object, None]]) -> Callable[[Pair], None]:
    """A test that runs in an agent's loop with both ends of a pair of sockets."""

    def run(pair: Pair) -> None:
        with asyncio.Runner(loop_factory=AgentLoop) as runner:
            loop = runner.get_loop()
            assert isinstance(loop, AgentLoop)
            runner.run(asyncio.wait_for(test((loop, *pair)), DEADLINE))

    run.__name__ = test.__name__
    return run


@in_agent_loop
async def test_a_direct_reader_is_called_and_ends_with_remove_reader(ends: Ends) -> None:
    loop, one, other = ends
    got: list[bytes] = []
    came = asyncio.Event()

    def read() -> None:
        got.append(one.recv(100))
        came.set()

    loop.add_direct_reader(one.fileno(), read)
    for word in (b"a", b"b"):
        came.clear()
        other.send(word)
        await came.wait()
    assert got == [b"a", b"b"]
    loop.remove_reader(one.fileno())
    other.send(b"c")
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert got == [b"a", b"b"]


@in_agent_loop
async def test_reader_and_writer_of_one_socket_both_work(ends: Ends) -> None:
    loop, one, other = ends
    read, written = asyncio.Event(), asyncio.Event()

    def take() -> None:
        one.recv(100)
        read.set()

    loop.add_direct_reader(one.fileno(), take)
    loop.add_writer(one.fileno(), written.set)
    other.send(b"a")
    await read.wait()
    await written.wait()
    loop.remove_writer(one.fileno())
    read.clear()
    other.send(b"b")
    await read.wait()
    loop.remove_reader(one.fileno())


@in_agent_loop
async def test_timers_and_callbacks_set_by_a_direct_reader_run(ends: Ends) -> None:
    loop, one, other = ends
    soon, later = asyncio.Event(), asyncio.Event()

    def read() -> None:
        one.recv(100)
        loop.call_soon(soon.set)
        loop.call_later(0.001, later.set)

    loop.add_direct_reader(one.fileno(), read)
    other.send(b"a")
    await soon.wait()
    await later.wait()
    loop.remove_reader(one.fileno())


@in_agent_loop
async def test_a_direct_reader_that_raises_does_not_end_the_loop(ends: Ends) -> None:
    loop, one, other = ends
    problems: list[object] = []
    told = asyncio.Event()

    def handler(_loop: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
        problems.append(context["exception"])
        told.set()

    def read() -> None:
        one.recv(100)
        raise RuntimeError("mine")

    loop.set_exception_handler(handler)
    loop.add_direct_reader(one.fileno(), read)
    other.send(b"a")
    await told.wait()
    assert [str(problem) for problem in problems] == ["mine"]
    loop.remove_reader(one.fileno())


@in_agent_loop
async def test_a_reader_may_close_another_that_is_ready_too(ends: Ends) -> None:
    loop = ends[0]
    pairs = [socket.socketpair() for _ in range(2)]
    called = asyncio.Event()
    calls: list[int] = []

    def read(index: int) -> None:
        calls.append(index)
        for one, _ in pairs:
            loop.remove_reader(one.fileno())
            one.close()
        called.set()

    for index, (one, _) in enumerate(pairs):
        loop.add_direct_reader(one.fileno(), lambda index=index: read(index))  # type: ignore[misc]
    for _, other in pairs:
        other.send(b"a")
    await called.wait()
    await asyncio.sleep(0)
    assert len(calls) == 1
    for _, other in pairs:
        other.close()


def test_the_selector_keeps_to_the_contract_of_selectors(pair: Pair) -> None:
    one, other = pair
    selector = DirectSelector()
    key = selector.register(one, selectors.EVENT_READ, "mine")
    with pytest.raises(KeyError):
        selector.register(one, selectors.EVENT_READ)
    assert selector.get_key(one) is key
    assert selector.select(0) == []
    other.send(b"a")
    assert selector.select(None) == [(key, selectors.EVENT_READ)]
    changed = selector.modify(one, selectors.EVENT_READ | selectors.EVENT_WRITE, "ours")
    assert selector.select(5.0) == [(changed, selectors.EVENT_READ | selectors.EVENT_WRITE)]
    selector.unregister(one)
    with pytest.raises(KeyError):
        selector.unregister(one)
    with pytest.raises(KeyError):
        selector.get_key(one)
    assert not selector.get_map()
    selector.close()


@in_agent_loop
async def test_a_peer_that_hangs_up_is_a_read(ends: Ends) -> None:
    loop, one, other = ends
    ended = asyncio.Event()
    loop.add_direct_reader(one.fileno(), lambda: ended.set() if one.recv(10) == b"" else None)
    other.close()
    await ended.wait()
    loop.remove_reader(one.fileno())


@in_agent_loop
async def test_data_goes_before_every_ordinary_callback(ends: Ends) -> None:
    loop, one, other = ends
    order: list[str] = []
    loop.add_direct_reader(one.fileno(), lambda: order.append(one.recv(100).decode()))

    def work(index: int) -> None:
        order.append(f"work {index}")
        other.send(f"data {index}".encode())

    ended = asyncio.Event()
    for index in range(3):
        loop.call_soon(work, index)
    loop.call_soon(ended.set)
    await ended.wait()
    assert order == ["work 0", "data 0", "work 1", "data 1", "work 2", "data 2"]
    loop.remove_reader(one.fileno())


@in_agent_loop
async def test_data_is_handled_when_work_yields(ends: Ends) -> None:
    loop, one, other = ends
    got: list[bytes] = []
    loop.add_direct_reader(one.fileno(), lambda: got.append(one.recv(100)))
    for index in range(3):
        other.send(b"a")
        assert len(got) == index
        yield_to_data()
        assert len(got) == index + 1
    loop.remove_reader(one.fileno())
    other.send(b"a")
    yield_to_data()
    assert len(got) == 3


@in_agent_loop
async def test_a_reader_that_yields_is_not_called_within_itself(ends: Ends) -> None:
    loop, one, other = ends
    inside: list[int] = []
    ended = asyncio.Event()

    def read() -> None:
        one.recv(1)
        inside.append(1)
        yield_to_data()
        assert len(inside) == 1
        inside.pop()
        if one.recv(1, socket.MSG_PEEK) == b"z":
            ended.set()
            loop.remove_reader(one.fileno())

    loop.add_direct_reader(one.fileno(), read)
    other.send(b"abz")
    await ended.wait()


@in_agent_loop
async def test_a_writer_of_a_direct_reader_is_called_in_between_too(ends: Ends) -> None:
    loop, one, _ = ends
    written: list[str] = []
    loop.add_direct_reader(one.fileno(), lambda: written.append("read"))
    loop.add_writer(one.fileno(), written.append, "a")
    yield_to_data()
    yield_to_data()
    assert written == ["a", "a"]
    loop.remove_writer(one.fileno())
    yield_to_data()
    assert written == ["a", "a"]
    loop.add_writer(one.fileno(), written.append, "b")
    loop.remove_reader(one.fileno())
    yield_to_data()
    assert written == ["a", "a"]
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert "b" in written
    loop.remove_writer(one.fileno())


@in_agent_loop
async def test_a_socket_that_was_closed_first_is_forgotten(ends: Ends) -> None:
    loop, one, _ = ends
    number = one.fileno()
    loop.add_direct_reader(number, lambda: None)
    one.close()
    loop.remove_reader(number)
    yield_to_data()


@in_agent_loop
async def test_a_long_iteration_yields_by_the_clock_and_not_by_the_number_of_items(ends: Ends) -> None:
    loop, one, other = ends
    got: list[bytes] = []
    loop.add_direct_reader(one.fileno(), lambda: got.append(one.recv(100)))
    seen = []
    for item in yielding_to_data(range(5)):
        assert len(got) == item  # each item is slow, so data is handled before the next one
        seen.append(item)
        other.send(b"a")
        slow = time.monotonic() + 2e-3
        while time.monotonic() < slow:
            pass
    assert seen == list(range(5))
    loop.remove_reader(one.fileno())


@in_agent_loop
async def test_work_up_to_a_time_gets_on_by_one_item_at_least_and_leaves_the_rest(ends: Ends) -> None:
    loop, one, other = ends
    got: list[bytes] = []
    loop.add_direct_reader(one.fileno(), lambda: got.append(one.recv(100)))
    other.send(b"a")
    work = iter(range(4))
    assert list(until(time.monotonic(), work)) == [0]
    assert got == [b"a"]
    assert list(until(time.monotonic() + 60.0, work)) == [1, 2, 3]
    assert list(until(time.monotonic() + 60.0, work)) == []
    loop.remove_reader(one.fileno())


@pytest.mark.parametrize("count", [0, 1, 255, 256, 257, 5000])
def test_sorting_yields_and_sorts(count: int) -> None:
    words = [f"/{(index * 7919) % 4999}" for index in range(count)]
    assert list(sorted_yielding(words)) == sorted(words)
