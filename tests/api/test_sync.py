"""``rmpa.connect``, as scripts use it, at a core in another thread."""

from __future__ import annotations

import asyncio
import os
import queue
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest

import rmpa
from rmpa import sync
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call_api

DEADLINE = 30.0


@pytest.fixture
def core(monkeypatch: pytest.MonkeyPatch) -> Iterator[RosCore]:
    ready: Future[RosCore] = Future()
    loop = asyncio.new_event_loop()
    ended = asyncio.Event()

    async def serve() -> None:
        made = RosCore("127.0.0.1", 0)
        await made.start()
        ready.set_result(made)
        await ended.wait()
        await made.close()

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
    thread.start()
    made = ready.result(DEADLINE)
    monkeypatch.setenv("ROS_MASTER_URI", made.uri)
    yield made
    loop.call_soon_threadsafe(ended.set)
    thread.join()
    loop.close()


@pytest.fixture(autouse=True)
def _nothing_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    for thread in set(threading.enumerate()) - before:
        thread.join(DEADLINE)
        assert not thread.is_alive(), thread.name
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_a_script_publishes_and_another_hears_it(core: RosCore) -> None:
    heard: list[str] = []
    three = threading.Event()

    def hear(message: Any) -> None:
        heard.append(message.data)
        if len(heard) == 1:
            raise ValueError("the first")  # which is told, and no more
        if len(heard) == 3:
            three.set()

    with rmpa.connect("listener") as listener, rmpa.connect("talker") as talker:
        listener.subscribe("/chatter", "std_msgs/String", hear)
        chatter = talker.advertise("/chatter", "std_msgs/String")
        assert chatter.wait_for_subscriber(DEADLINE)
        for count in talker.rate(100):
            chatter.publish(data=f"hello {count}")
            if count >= 2:
                break
        while not three.wait(0.05):
            chatter.publish("again")
        with pytest.raises(rmpa.MessageError, match="has no field 'dat'"):
            chatter.publish(dat="hello")
        assert (talker.name, chatter.topic, chatter.subscribers) == ("/talker", "/chatter", 1)
    assert heard[0] == "hello 0"
    assert "/chatter" not in core.state().publishers


def test_a_callback_may_wait_for_a_service_and_a_handler_too(core: RosCore) -> None:
    answers: Future[int] = Future()
    with rmpa.connect("server") as server, rmpa.connect("client") as client:

        def double(request: Any) -> dict[str, int]:
            return {"sum": 2 * request.a}

        def add(request: Any) -> dict[str, int]:
            if request.b < 0:
                raise ValueError("less than nothing")
            twice = server.call_service("/double", "rospy_tutorials/AddTwoInts", [request.a, 0]).sum
            return {"sum": twice + request.b}

        server.advertise_service("/double", "rospy_tutorials/AddTwoInts", double)
        server.advertise_service("/add", "rospy_tutorials/AddTwoInts", add)
        client.wait_for_service("/add", DEADLINE)
        client.subscribe(
            "/go",
            "std_msgs/Int64",
            lambda m: answers.set_result(client.call_service("/add", "rospy_tutorials/AddTwoInts", [m.data, 1]).sum),
        )
        server.advertise("/go", "std_msgs/Int64", latch=True).publish(20)
        assert answers.result(DEADLINE) == 41
        with pytest.raises(rmpa.PeerRefused, match="ValueError: less than nothing"):
            client.call_service("/add", "rospy_tutorials/AddTwoInts", {"b": -1})
        with pytest.raises(rmpa.UnreachableError, match="no server of service /never"):
            client.wait_for_service("/never", 0.05)


def test_parameters_messages_timers_and_the_log(core: RosCore) -> None:
    changes: list[tuple[str, object]] = []
    changed = threading.Event()
    ticks: list[int] = []

    def change(key: str, value: object) -> None:
        changes.append((key, value))
        changed.set()

    with rmpa.connect("n") as node, rmpa.connect("other") as other:
        other.set_param("/gain", 1.5)
        assert node.follow_param("/gain", change) == 1.5
        assert (node.has_param("/gain"), node.get_param("/gain"), node.get_param("/none", 7)) == (True, 1.5, 7)
        with pytest.raises(rmpa.PeerRefused):
            node.get_param("/none")
        other.set_param("/gain", 2.5)
        assert changed.wait(DEADLINE)
        assert changes == [("/gain", 2.5)]
        other.delete_param("/gain")
        with pytest.raises(rmpa.UnreachableError, match="no publisher of /t"):
            node.wait_for_message("/t", "std_msgs/String", timeout=0.05)
        other.advertise("/t", "std_msgs/String", latch=True).publish("hello")
        assert node.wait_for_message("/t", timeout=DEADLINE).data == "hello"
        end = node.timer(0.01, lambda: ticks.append(1))
        while len(ticks) < 3:
            assert node.sleep(0.01)
        end()
        other.logger.warning("low")
        assert node.wait_for_message("/rosout", timeout=DEADLINE).msg == "low"


def test_each_end_can_be_closed(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["script.py", "t:=/talk", "__name:=me"])
    pair = rmpa.MessageType.learn("my_msgs/Pair", "int32 a\nint32 b\n")
    with rmpa.connect("n") as node:
        assert node.name == "/me"
        heard = node.subscribe("t", "std_msgs/String", print)
        serves = node.advertise_service("/s", "std_srvs/Trigger", lambda _: {"success": True})
        publisher = node.advertise("/pair", pair, latch=True)
        publisher.publish([1, 2])
        assert node.wait_for_message("/pair", timeout=DEADLINE).b == 2
        assert ("/pair", "my_msgs/Pair") in node.get_published_topics()
        assert "/talk" in core.state().subscribers
        assert "/s" in core.state().services
        for close in (heard, serves, publisher.close):
            close()
        assert "/talk" not in core.state().subscribers
        assert "/s" not in core.state().services
        assert "/pair" not in core.state().publishers


def test_ctrl_c_ends_the_with_and_nothing_else(core: RosCore) -> None:
    for number, wait in (
        (signal.SIGINT, lambda n: n.spin()),
        (signal.SIGTERM, lambda n: n.wait_for_message("/never")),
        (signal.SIGINT, lambda n: list(n.rate(0.001))),
        (signal.SIGINT, lambda n: n.sleep(DEADLINE)),
    ):
        with rmpa.connect("n") as node:
            threading.Timer(0.1, os.kill, (os.getpid(), number)).start()
            wait(node)
            pytest.fail("it was not interrupted")
        assert node.stopped


def test_a_node_that_the_master_ends_is_stopped(core: RosCore) -> None:
    with rmpa.connect("n") as node:
        publisher = node.advertise("/t", "std_msgs/String")
        uri = str(asyncio.run(call_api(core.uri, "lookupNode", "/me", "/n")).value)
        threading.Timer(0.1, lambda: asyncio.run(call_api(uri, "shutdown", "/me", "enough"))).start()
        for count in node.rate(0.001):
            assert count == 0
        node.spin()
        assert node.stopped
        with pytest.raises(rmpa.RmpaError, match="/t is not published any more"):
            publisher.wait_for_subscriber(DEADLINE)
        with pytest.raises(rmpa.RmpaError, match="/n is closed"):
            node.advertise("/u", "std_msgs/String")


def test_calls_that_wait_end_with_the_node(core: RosCore) -> None:
    told: Future[BaseException] = Future()
    with rmpa.connect("n") as node:

        def wait() -> None:
            try:
                node.wait_for_message("/never")
            except rmpa.RmpaError as error:
                told.set_result(error)

        threading.Thread(target=wait).start()
        while "/never" not in core.state().subscribers:
            node.sleep(0.01)
    assert "is closed" in str(told.result(DEADLINE))
    with pytest.raises(rmpa.RmpaError, match="n is closed"):
        node.get_param("/gain")
    with pytest.raises(rmpa.RmpaError, match=r"with rmpa\.connect"):
        rmpa.connect("n").get_param("/gain")


def test_without_a_master_it_says_what_to_do_in_a_short_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:1")
    with pytest.raises(rmpa.UnreachableError, match=r"no ROS master answers .* start one \(rmpa up") as caught:
        rmpa.connect("n").__enter__()
    assert caught.value.__cause__ is None
    assert len(caught.traceback) <= 3


def test_a_node_is_opened_once(core: RosCore) -> None:
    with rmpa.connect("n") as node:
        with pytest.raises(rmpa.RmpaError, match="n was opened before: make another"):
            node.__enter__()
        assert node.get_param("/none", 7) == 7


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_a_program_whose_node_does_not_close(core: RosCore, number: signal.Signals) -> None:
    text = """
    import asyncio, rmpa
    with rmpa.connect("n") as node:
        async def hang():
            print("closing", flush=True)
            await asyncio.Event().wait()
        node._node.close = hang
        print("open", flush=True)
        node.spin()
    """
    program = [sys.executable, "-c", textwrap.dedent(text)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as started:
        assert started.stdout is not None
        try:
            for line in ("open\n", "closing\n"):
                assert started.stdout.readline() == line
                started.send_signal(number)
            assert started.wait(30) in (-number, 1), "an end in order would be 0"
        finally:
            started.kill()


def test_a_node_that_does_not_close_is_left_after_a_while(
    core: RosCore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sync, "_CLOSE_WITHIN", 0.2)
    with rmpa.connect("n") as node:
        close = node._open_node.close

        async def hang() -> None:
            await close()
            await asyncio.Event().wait()

        monkeypatch.setattr(node._open_node, "close", hang)
    assert "n has not unregistered in 0.2 s" in caplog.text
    assert node.stopped


def test_a_forked_process_is_told_that_the_node_is_not_its_own(core: RosCore) -> None:
    with rmpa.connect("n") as node:
        publisher = node.advertise("/t", "std_msgs/String")
        child = os.fork()
        if not child:
            signal.alarm(int(DEADLINE))
            told = 0
            for call in (lambda: publisher.publish("x"), lambda: node.get_param("/a"), node.spin):
                try:
                    call()
                except rmpa.RmpaError as error:
                    told += "belongs to process" in str(error)
            node.close()
            os._exit(told)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
        assert publisher.publish("x") == 0
        assert "/t" in core.state().publishers


def test_a_callback_may_close_the_node(core: RosCore) -> None:
    closed = threading.Event()

    def close(_: object) -> None:
        node.close()
        closed.set()

    with rmpa.connect("n") as node:
        node.subscribe("/t", "std_msgs/String", close)
        node.advertise("/t", "std_msgs/String", latch=True).publish("x")
        assert closed.wait(DEADLINE)  # before the main thread restores the signals' handlers
        assert node.stopped
        assert "/t" not in core.state().subscribers


def test_what_ends_after_its_node_has_ended_already(core: RosCore) -> None:
    counts: list[int] = []
    with rmpa.connect("n") as node, ThreadPoolExecutor() as threads:
        publisher = node.advertise("/t", "std_msgs/String")
        ends = [
            publisher.close,
            node.subscribe("/t", "std_msgs/String", print),
            node.advertise_service("/s", "std_srvs/Trigger", print),
        ]
        counting = threads.submit(lambda: counts.extend(node.rate(100)))
        publisher.close()
        with pytest.raises(rmpa.RmpaError, match="/t is not published any more"):
            publisher.publish("x")
        node.close()
        assert counting.result(DEADLINE) is None
        for end in ends:
            end()
    assert list(node.rate(1)) == []
    with pytest.raises(rmpa.RmpaError, match="n is closed"):
        publisher.publish("x")


def test_a_topic_can_be_subscribed_to_more_than_once(core: RosCore) -> None:
    first: queue.Queue[str] = queue.Queue()
    second: queue.Queue[str] = queue.Queue()
    with rmpa.connect("n") as node, rmpa.connect("other") as other, ThreadPoolExecutor() as threads:
        ends = [
            node.subscribe("/t", "std_msgs/String", lambda m: first.put(m.data)),
            node.subscribe("/t", "std_msgs/String", lambda m: second.put(m.data)),
        ]
        other.advertise("/t", "std_msgs/String", latch=True).publish("x")
        assert [q.get(timeout=DEADLINE) for q in (first, second)] == ["x", "x"]
        for _ in range(5):
            waiting = [threads.submit(node.wait_for_message, "/t", timeout=DEADLINE) for _ in range(4)]
            assert [each.result(DEADLINE).data for each in waiting] == ["x"] * 4
        ends[0]()
        assert list(core.state().subscribers["/t"]) == ["/n"]
        ends[1]()
        assert "/t" not in core.state().subscribers


@pytest.mark.parametrize("value", [0, -1, float("inf"), float("nan")])
def test_a_rate_is_above_0_and_finite(core: RosCore, value: float) -> None:
    with rmpa.connect("n") as node:
        with pytest.raises(ValueError, match=f"a rate is above 0 and finite, not {value}"):
            node.rate(value)
        with pytest.raises(ValueError, match=f"a timer's period is above 0 and finite, not {value}"):
            node.timer(value, print)


@pytest.mark.parametrize("error", [SystemExit(3), StopIteration()])
def test_whatever_a_handler_raises_is_the_clients_answer(
    core: RosCore, caplog: pytest.LogCaptureFixture, error: BaseException
) -> None:
    def fail(_: object) -> None:
        raise error

    with rmpa.connect("n") as node:
        node.advertise_service("/s", "std_srvs/Trigger", fail)
        with pytest.raises(rmpa.PeerRefused, match=type(error).__name__):
            node.call_service("/s", "std_srvs/Trigger", timeout=DEADLINE)
    assert "a call of /n failed" in caplog.text


def test_callbacks_are_plain_functions(core: RosCore) -> None:
    async def later(*_: object) -> None: ...

    with rmpa.connect("n") as node:
        for wrong in (later, None):
            for call in (
                lambda f: node.subscribe("/t", "std_msgs/String", f),
                lambda f: node.advertise_service("/s", "std_srvs/Trigger", f),
                lambda f: node.follow_param("/gain", f),
                lambda f: node.timer(1, f),
            ):
                with pytest.raises(
                    TypeError, match=r"(callback|handler).* is a plain function, not (None|<function )"
                ):
                    call(wrong)
        assert "/t" not in core.state().subscribers


def test_values_are_checked_without_a_subscriber(core: RosCore) -> None:
    with rmpa.connect("n") as node:
        publisher = node.advertise("/t", "std_msgs/String")
        wrongs: tuple[object, ...] = (b"x", [1, 2], {"data": {}})
        for wrong in wrongs:
            with pytest.raises(rmpa.MessageError):
                publisher.publish(wrong)
        publisher.publish(data=5)


def test_what_a_slow_callback_for_a_parameter_misses_is_the_oldest(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sync, "_QUEUE", 2)
    seen: queue.Queue[object] = queue.Queue()
    go_on = threading.Event()

    def slow(_: str, value: object) -> None:
        seen.put(value)
        go_on.wait(DEADLINE)

    with rmpa.connect("n") as node:
        node.follow_param("/gain", slow)
        told = node._open_node._followed["/gain"]
        assert told is not None
        assert node._loop is not None
        node._loop.call_soon_threadsafe(told, "/gain", 0)
        assert seen.get(timeout=DEADLINE) == 0
        for value in range(1, 6):
            node._loop.call_soon_threadsafe(told, "/gain", value)
        node.has_param("/gain")  # which the loop does after them
        go_on.set()
        assert [seen.get(timeout=DEADLINE) for _ in range(2)] == [4, 5]
