"""The feed of ``/diagnostics``: when it listens, what pages are shown, and that one node hides no other."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

from rmpa.core.errors import PeerRefused
from rmpa.web.monitor import limits
from rmpa.web.monitor.diagnostics import DiagnosticsFeed
from tests.waiting import until
from tests.web.monitor.fake_server import Reports


class Hub(Reports):
    """Counts subscriptions; its graph has the publishers that a test gives."""

    def __init__(self, *publishers: str) -> None:
        super().__init__()
        self.graph = SimpleNamespace(topics={"/diagnostics": SimpleNamespace(publishers=list(publishers))})
        self.open = 0
        self.refuses = False

    def subscribe(self, _topic: str, _type: str, take: Any, _failed: object) -> Any:
        if self.refuses:
            raise PeerRefused("the web server", "the rules deny it", "")
        self.take = take
        self.open += 1
        return SimpleNamespace(close=self._close)

    def _close(self) -> None:
        self.open -= 1

    def say(self, source: str, *levels: int) -> None:
        """A message of a node with a status of each level."""
        statuses = [
            {"name": f"{source} {number}", "hardware_id": "", "level": level, "message": "", "values": []}
            for number, level in enumerate(levels)
        ]
        self.take(SimpleNamespace(source=source, payload=b"", values={"status": statuses}))


async def shown(hub: Hub) -> tuple[DiagnosticsFeed, asyncio.Event]:
    """A feed that pages follow, and what is set when they are to be shown something."""
    news = asyncio.Event()
    feed = DiagnosticsFeed(hub, news.set)  # type: ignore[arg-type]
    feed.follow()
    return feed, news


async def test_it_listens_while_a_page_is_open_and_there_is_something_to_hear() -> None:
    alone = Hub("/rmpa")
    feed, _ = await shown(alone)
    assert alone.open == 0  # the agent says it to pages in other ways
    feed.all()
    await until(lambda: alone.open == 1)
    feed.close()
    assert alone.open == 0
    hub = Hub("/rmpa", "/rmpa/base/arm")
    feed, _ = await shown(hub)
    assert hub.open == 1
    feed.close()
    assert hub.open == 0


async def test_one_node_with_many_errors_hides_no_other() -> None:
    hub = Hub("/rmpa/base/arm", "/rmpa/evil/flood")
    feed, news = await shown(hub)
    hub.say("/rmpa/evil/flood", *[2] * 500)
    hub.say("/rmpa/base/arm", 2, 1, 0)
    news.clear()
    await news.wait()
    told: Any = feed.summary
    modules = [one["module"] for one in told["errors"].values()]
    assert modules == ["evil"] * limits.DIAGNOSTIC_ERRORS_NODE + ["base"]
    assert (told["more"], told["warnings"]) == (501 - len(modules), [["base", "/rmpa/base/arm 1"]])
    assert told["levels"] == {"ERROR": 501, "WARN": 1, "OK": 1}
    assert feed.one("base\x1f\x1f/rmpa/base/arm 0") is not None
    assert feed.one("nonsense") is None
    feed.close()


async def test_what_the_rules_deny_is_said() -> None:
    hub = Hub("/arm")
    hub.refuses = True
    feed, news = await shown(hub)
    await news.wait()
    assert "the rules deny it" in str(feed.summary["refused"])
    assert feed.summary["problems"] == []  # which the page of the mesh shows as wrong
    feed.close()
