from __future__ import annotations

import asyncio
import gc
import sys
from typing import TYPE_CHECKING, ClassVar

import pytest

from rmpa.core.counters import Counters
from rmpa.runtime import limits
from rmpa.runtime.event_loop import AgentLoop, yielding_to_data
from rmpa.runtime.free_memory import FreeMemory
from rmpa.runtime.garbage_collector import Collection, GarbageCollector, choose_collection

if TYPE_CHECKING:
    from collections.abc import Iterator


class Knot:
    """Garbage that only a collection finds."""

    alive: ClassVar[int] = 0

    def __init__(self) -> None:
        self.me = self
        self.ballast = bytearray(1000)
        Knot.alive += 1

    def __del__(self) -> None:
        Knot.alive -= 1


@pytest.fixture
def counters() -> Counters:
    return Counters()


@pytest.fixture
def collector(counters: Counters) -> Iterator[GarbageCollector]:
    made = GarbageCollector(lambda: 0, counters)
    Knot.alive = 0
    enabled = gc.isenabled()
    yield made
    made.close()
    assert gc.isenabled() == enabled


async def until_no_more_than(knots: int) -> None:
    async with asyncio.timeout(20):
        while Knot.alive > knots:
            await asyncio.sleep(0.01)


@pytest.mark.parametrize(
    ("young", "grown", "quiet", "collection"),
    [
        (0, 0, True, Collection.NOTHING),
        (limits.COLLECT_YOUNG - 1, 0, True, Collection.NOTHING),
        (limits.COLLECT_YOUNG, 0, True, Collection.YOUNG),
        (limits.COLLECT_YOUNG, 0, False, Collection.YOUNG),
        (limits.COLLECT_YOUNG, -10, True, Collection.YOUNG),
        (0, limits.COLLECT_GROWTH, False, Collection.NOTHING),
        (limits.COLLECT_YOUNG, limits.COLLECT_GROWTH, False, Collection.YOUNG),
        (0, limits.COLLECT_GROWTH - 1, True, Collection.NOTHING),
        (0, limits.COLLECT_GROWTH, True, Collection.FULL),
        (0, limits.COLLECT_GROWTH_MAX, False, Collection.FULL),
    ],
)
def test_what_is_due(young: int, grown: int, quiet: bool, collection: Collection) -> None:
    assert choose_collection(young, grown, quiet=quiet) is collection


@pytest.mark.parametrize(
    ("factor", "rests", "collection"),
    [
        (1.9, True, Collection.FULL),
        (2.0, True, Collection.THOROUGH),
        (2.0, False, Collection.FULL),
        (3.9, False, Collection.FULL),
        (4.0, False, Collection.THOROUGH),
    ],
)
def test_frozen_objects_are_scanned_at_rest_or_when_the_heap_is_four_times_as_large(
    factor: float, rests: bool, collection: Collection
) -> None:
    assert choose_collection(0, limits.COLLECT_GROWTH, quiet=True, factor=factor, rests=rests) is collection


async def test_it_takes_over_and_gives_back(collector: GarbageCollector) -> None:
    gc.enable()
    collector.start()
    assert not gc.isenabled()
    assert gc.get_freeze_count() > 0
    collector.close()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    collector.close()


async def test_it_leaves_off_what_was_off(collector: GarbageCollector) -> None:
    gc.disable()
    try:
        collector.start()
        collector.close()
        assert not gc.isenabled()
    finally:
        gc.enable()


async def test_nothing_is_collected_while_nothing_comes_to_stay(
    collector: GarbageCollector, counters: Counters, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "COLLECT_LOOK", 0.002)
    gc.collect()
    collector.start()
    for _ in range(100):
        for _ in range(1000):
            [[]]  # noqa: B018 - an object that is gone at once, as those of the data path are
        await asyncio.sleep(0.001)
    assert counters.as_dict() == {}


async def test_cycles_of_control_work_are_collected_in_small_portions(
    collector: GarbageCollector, counters: Counters
) -> None:
    pauses = Pauses()
    gc.collect()
    collector.start()
    highest = 0
    with pauses:
        async with asyncio.timeout(60):
            while counters["collector.young"] < 20:
                for _ in range(20):
                    Knot()
                highest = max(highest, Knot.alive)
                await asyncio.sleep(0.002)
    # 2 to 4 tracked objects a knot.
    assert counters["collector.full"] == 0
    assert highest < 5000
    assert set(pauses.generations) == {0}
    assert collector.longest_pause > 0


async def test_garbage_that_grew_old_is_collected_when_no_data_flows(
    counters: Counters, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "COLLECT_LOOK", 0.02)
    monkeypatch.setattr(limits, "COLLECT_GROWTH", 20_000)
    carried, step = 0, 1_000_000

    def carry() -> int:
        nonlocal carried
        carried += step
        return carried

    Knot.alive = 0
    collector = GarbageCollector(carry, counters)
    collector.start()
    try:
        old = [Knot() for _ in range(10_000)]  # 3 blocks each
        gc.collect(0)
        old.clear()
        await asyncio.sleep(0.2)
        assert Knot.alive == 10_000
        assert counters["collector.full"] == 0
        step = 0
        await until_no_more_than(0)
        assert counters["collector.full"] == 1
        await asyncio.sleep(0.1)
        assert counters["collector.full"] == 1
    finally:
        collector.close()


async def test_garbage_that_grew_old_waits_no_longer_when_it_is_much(
    counters: Counters, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "COLLECT_LOOK", 0.02)
    monkeypatch.setattr(limits, "COLLECT_GROWTH_MAX", 20_000)
    carried = iter(range(0, 10**9, 10**6))
    Knot.alive = 0
    collector = GarbageCollector(lambda: next(carried), counters)
    collector.start()
    try:
        old = [Knot() for _ in range(10_000)]
        gc.collect(0)
        old.clear()
        with caplog.at_level("INFO"):
            await until_no_more_than(0)
        assert counters["collector.full"] == 1
        assert "objects of all ages in" in caplog.text
    finally:
        collector.close()


async def test_frozen_garbage_is_collected_at_rest_and_not_before(
    counters: Counters, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "COLLECT_LOOK", 0.02)
    monkeypatch.setattr(limits, "COLLECT_REST", 0.1)
    monkeypatch.setattr(limits, "COLLECT_GROWTH", 20_000)
    carried, step = 0, 1_000_000

    def carry() -> int:
        nonlocal carried
        carried += step
        return carried

    Knot.alive = 0
    collector = GarbageCollector(carry, counters)
    collector.start()
    try:
        blocks = sys.getallocatedblocks()
        knots = [Knot() for _ in range(10_000)]
        gc.freeze()  # as a full collection does with what survives it
        graph = [object() for _ in range(int(1.5 * blocks))]
        knots.clear()
        with caplog.at_level("INFO"):
            await asyncio.sleep(0.3)
            assert Knot.alive == 10_000, "data flows"
            step = 0
            await until_no_more_than(0)
        assert "the frozen ones included" in caplog.text
        assert gc.get_freeze_count() > 0
        assert len(graph) > blocks
    finally:
        collector.close()


async def test_free_memory_is_returned_at_rest_and_not_before(
    counters: Counters, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "COLLECT_LOOK", 0.02)
    monkeypatch.setattr(limits, "COLLECT_REST", 0.1)
    carried, step = 0, 1_000_000

    def carry() -> int:
        nonlocal carried
        carried += step
        return carried

    resident = 50_000_000
    collector = GarbageCollector(carry, counters, FreeMemory(lambda: resident, lambda: True))
    collector.start()
    try:
        resident += limits.TRIM_GROWTH
        await asyncio.sleep(0.3)
        assert counters["collector.trim"] == 0, "data flows"
        step = 0
        with caplog.at_level("INFO"):
            async with asyncio.timeout(20):
                while counters["collector.trim"] == 0:
                    await asyncio.sleep(0.01)
        assert "of free memory to the kernel" in caplog.text
        await asyncio.sleep(0.3)
        assert counters["collector.trim"] == 1, "nothing has grown since"
    finally:
        collector.close()


class Pauses:
    """The generations that were collected meanwhile."""

    def __init__(self) -> None:
        self.generations: list[int] = []

    def __enter__(self) -> None:
        gc.callbacks.append(self._note)

    def __exit__(self, *_: object) -> None:
        gc.callbacks.remove(self._note)

    def _note(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self.generations.append(info["generation"])


def test_work_that_does_not_end_is_collected_in_its_midst(counters: Counters) -> None:
    async def main() -> None:
        collector = GarbageCollector(lambda: 0, counters)
        collector.start()
        most = 0
        for _ in yielding_to_data(range(100_000)):
            Knot()
            most = max(most, gc.get_count()[0])
        assert counters["collector.young"] > 20
        assert most < 10 * limits.COLLECT_BURST
        collector.close()

    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        runner.run(main())
