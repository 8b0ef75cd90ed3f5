"""What programs use of a node beside topics and services: its clock, its log, and waiting."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import threading
import time
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import UnreachableError
from rmpa.ros.node.node import Node
from tests.ros.node.peers import DEADLINE, node, until

if TYPE_CHECKING:
    from rmpa.ros.core.embedded import RosCore


async def test_a_rate_does_not_drift_and_leaves_out_what_is_past(core: RosCore) -> None:
    loop = asyncio.get_running_loop()
    async with node(core, "n") as one:
        begun = first = late = loop.time()  # the rate begins in between the first two
        async for count in one.rate(50):
            assert begun + count / 50 - 0.001 <= loop.time()
            if count == 0:
                first = loop.time()
            elif count == 3:
                await asyncio.sleep(0.1)  # five periods
                late = loop.time()
            elif count > 3:
                # The next number is the one that is due now, not 4.
                assert (late - first) * 50 - 1 <= count <= (loop.time() - begun) * 50 + 1
                break
        assert count >= 8


async def test_a_rate_ends_with_its_node(core: RosCore) -> None:
    async with node(core, "n") as one:
        async for count in one.rate(0.001):
            assert count == 0
            asyncio.get_running_loop().call_soon(lambda: asyncio.ensure_future(one.close()))


async def test_a_timer_goes_on_after_an_exception_and_until_it_is_cancelled(
    core: RosCore, caplog: pytest.LogCaptureFixture
) -> None:
    plain: list[int] = []
    awaited: list[int] = []

    def tick() -> None:
        plain.append(len(plain))
        if len(plain) == 2:
            raise ValueError("the second")

    async def later() -> None:
        await asyncio.sleep(0)
        awaited.append(len(awaited))

    async with node(core, "n") as one:
        timer = one.timer(0.01, tick)
        one.timer(0.01, later)
        await until(lambda: len(plain) > 3 and len(awaited) > 3)
        timer.cancel()
        done, more = len(plain), len(awaited)
        await until(lambda: len(awaited) > more + 3)
        assert len(plain) == done
    assert "ValueError: the second" in caplog.text


async def test_the_log_is_on_rosout_from_its_first_line(core: RosCore, capsys: pytest.CaptureFixture[str]) -> None:
    async with node(core, "eye") as one, node(core, "rqt_console") as console:
        seen = await console.subscribe("/rosout_agg", "rosgraph_msgs/Log")
        await until(lambda: seen.publishers)
        await one.advertise("/t", "std_msgs/String")
        one.logger.info("opened %d lenses", 2)
        one.logger.debug("not told: the level is INFO")
        threading.Thread(target=one.logger.warning, args=("from a thread",)).start()
        async with asyncio.timeout(DEADLINE):
            iterator = aiter(seen)
            records = [(await anext(iterator)).message for _ in range(2)]
        assert [(r.name, r.level, r.msg) for r in records] == [
            ("/eye", 2, "opened 2 lenses"),
            ("/eye", 4, "from a thread"),
        ]
        assert records[0].topics == ["/rosout", "/t"]
        assert records[0].file == __file__
        assert records[0].function == "test_the_log_is_on_rosout_from_its_first_line"
        assert records[0].line > 0
        assert abs(records[0].header.stamp.sec - time.time()) < DEADLINE
    assert logging.getLogger("rosout.eye").handlers == []
    assert "opened 2 lenses" not in capsys.readouterr().err  # pytest has configured logging


async def test_what_is_logged_last_arrives_too(core: RosCore) -> None:
    async with node(core, "rqt_console") as console:
        seen = await console.subscribe("/rosout_agg", "rosgraph_msgs/Log")
        await until(lambda: seen.publishers)
        async with node(core, "brief") as brief:
            brief.logger.error("no camera")
        async with asyncio.timeout(DEADLINE):
            async for received in seen:
                assert (received.message.msg, received.message.level) == ("no camera", 8)
                break


async def test_a_parameters_changes_are_told_to_its_own_callback(core: RosCore) -> None:
    told: list[tuple[str, object]] = []
    async with node(core, "n") as one, node(core, "other") as other:
        await one.follow_param("/gains", lambda key, value: told.append((key, value)))
        await one.follow_param("/else", lambda *_: pytest.fail("another parameter"))
        await other.set_param("/gains/p", 2.5)
        await until(lambda: told)
        await other.delete_param("/gains/p")
        await until(lambda: len(told) == 2)
    assert told == [("/gains/p", 2.5), ("/gains/p", {})]


async def test_waiting_for_a_message(core: RosCore) -> None:
    async with node(core, "n") as one, node(core, "talker") as talker:
        with pytest.raises(UnreachableError, match=r"no publisher of /t answers at /n in 0.05 s; `rmpa why /t`"):
            await one.wait_for_message("t", "std_msgs/String", 0.05)
        (await talker.advertise("/t", "std_msgs/String", latch=True)).publish("hello")
        assert (await one.wait_for_message("t", timeout=DEADLINE)).message.data == "hello"
        waiting = asyncio.create_task(one.wait_for_message("/never"))
        await until(lambda: "/never" in core.state().subscribers)
        await one.close()
        with pytest.raises(UnreachableError, match="which is closed"):
            await waiting


async def test_waiting_for_a_service(core: RosCore) -> None:
    async with node(core, "n") as one, node(core, "server") as server:
        with pytest.raises(UnreachableError, match="no server of service /s"):
            await one.wait_for_service("s", 0.05)
        waiting = asyncio.create_task(one.wait_for_service("s", DEADLINE))
        await asyncio.sleep(0)
        await server.advertise_service("/s", "std_srvs/Trigger", lambda _: {"success": True})
        await waiting
        assert (await one.call_service("s", "std_srvs/Trigger")).success


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_signal_closes_a_node_that_handles_it(core: RosCore, number: signal.Signals) -> None:
    async with node(core, "n", handle_signals=True) as one:
        subscriber = await one.subscribe("/t", "std_msgs/String")
        os.kill(os.getpid(), number)
        async with asyncio.timeout(DEADLINE):
            async for _ in subscriber:
                pytest.fail("nobody publishes")
        await one.close()
    assert "/t" not in core.state().subscribers
    assert signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL)


async def test_arguments_replace_names_and_set_private_parameters(
    core: RosCore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", core.uri)
    argv = ("2", "chatter:=/talk", "__name:=speaker", "_gain:=2", "--loud", "__log:=/tmp/speaker.log")
    async with Node("talker", argv=argv) as one:
        assert (one.name, await one.get_param("/speaker/gain")) == ("/speaker", 2)
        assert (await one.advertise("chatter", "std_msgs/String")).topic == "/talk"
