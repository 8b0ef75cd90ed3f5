from __future__ import annotations

import asyncio
import threading
import time
from typing import TYPE_CHECKING

import pytest

from rmpa.resource import limits
from rmpa.resource.declare.requirements import at_most
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.resource_node import ResourceNode
from rmpa.resource.run.runtime import Preconditions, RuntimePart
from rmpa.ros.core.embedded import RosCore

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


async def until(fits: Callable[[], object]) -> None:
    async with asyncio.timeout(30):
        while not fits():
            await asyncio.sleep(0.01)


def declared(needs: Callable[[], str | bool | None]) -> Resource:
    one = Resource("sonar", role="sensing")
    one.attribute("noise", better="min", unit="m")
    one.profile(offers={"noise": 0.01}, needs=needs, name="fine")(lambda: None)
    one.profile(offers={"noise": 0.1}, cost=1, name="coarse")(lambda: None)
    one.adaptation(window="50 ms", dwell=0)
    return one


async def test_blocking_precondition_delays_nothing(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "PRECONDITION_TIMEOUT", 0.3)
    goes_on, threads = threading.Event(), set()
    calls: list[float] = []

    def needs() -> bool:
        calls.append(time.monotonic())
        threads.add(threading.get_ident())
        return goes_on.wait(40)

    member = ResourceNode(declared(needs), core.uri)
    await member.start()
    loop = member.adapter.loop
    windows: list[None] = []
    watcher = RuntimePart()
    watcher.window_ended = lambda *_: windows.append(None)  # type: ignore[method-assign]
    member.runtime.parts.append(watcher)
    noise = member.resource.attributes["noise"]
    member.adapter.enter_context("lab", {"noise": at_most("5 cm").bound(noise)}, {})
    await until(lambda: loop.profile == "coarse")
    await until(lambda: len(windows) >= 5)
    assert member.adapter.explain()[0].excluded == "its precondition has not answered for 0.3 s"
    assert len(calls) == 1  # it is not asked again as long as it has not answered
    goes_on.set()
    await until(lambda: loop.profile == "fine")
    assert threading.get_ident() not in threads
    await member.close()


async def test_first_decision_waits_for_preconditions(core: RosCore) -> None:
    applied: list[str] = []
    watcher = RuntimePart()
    watcher.changed = lambda: applied.extend(filter(None, [member.adapter.loop.applying]))  # type: ignore[method-assign]
    member = ResourceNode(declared(lambda: "the lid is shut"), core.uri, observers=[watcher])
    await member.start()
    await until(lambda: applied)
    assert applied[0] == "coarse"
    assert member.adapter.explain()[0].excluded == "the lid is shut"
    await member.close()


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (True, None),
        (None, None),
        (False, "its precondition does not hold"),
        ("no lens", "no lens"),
        ("", None),
        (OSError("no bus"), "its precondition failed: OSError: no bus"),
    ],
)
async def test_precondition_results(answer: str | bool | Exception | None, why: str | None) -> None:
    def needs() -> str | bool | None:
        if isinstance(answer, Exception):
            raise answer
        return answer

    one = Preconditions(declared(needs).profiles)
    for _ in range(2):
        assert (await one.check()).get("fine") == why
    await one.close()
