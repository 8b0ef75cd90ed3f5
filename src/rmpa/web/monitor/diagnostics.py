"""What nodes of all modules say on ``/diagnostics``, for the pages: followed while a page is open.

What the agent says of itself there costs it the more the more topics there are, and all pages show it in other ways.
So it is followed only while a page shows the diagnostics themselves, or while other nodes say something, too.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter, deque
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE
from rmpa.observe.diagnostics import ERROR, OK, STALE, WARN, Status, StatusKey, StatusTable, history
from rmpa.observe.health import TOPIC
from rmpa.ros.types.definitions import ARRAY_TYPE
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.topics import ClientSubscription, ReceivedMessage
    from rmpa.web.monitor.messages import Tree, Value

# Between the parts of a status' key; a name that has it is mistaken only for another one of its own module.
_BETWEEN: Final = "\x1f"
# Seconds between two looks for what is stale, and between two changes that pages are told.
_LOOK: Final = 0.5


class DiagnosticsFeed:
    """Subscribes to ``/diagnostics`` while a page is open, and keeps what was said.

    Args:
        hub: Subscribes.
        changed: Called when pages are to be shown something new.
    """

    def __init__(self, hub: Hub, changed: Callable[[], None]) -> None:
        self._hub = hub
        self._changed = changed
        self._table = StatusTable(limits.DIAGNOSTIC_HISTORY)
        self._subscription: ClientSubscription | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._looked = -math.inf
        self._refused = ""
        self._dirty = True
        self._worst: deque[tuple[float, str]] = deque(maxlen=limits.DIAGNOSTIC_WORST)
        self._entries: dict[str, Tree] = {}
        # What each page is shown: statuses counted by level, and those that are wrong, without the agent's own.
        self.summary: Tree = {}

    def follow(self) -> None:
        """A page is open."""
        if self._timer is None:
            self._look()

    def close(self) -> None:
        """End; what was said is kept for the next page."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._unsubscribe()
        self._refused = ""

    def _subscribe(self, now: float) -> None:
        self._table.resume(now)
        try:
            self._subscription = self._hub.topics.subscribe(TOPIC, ARRAY_TYPE, self._take, self._fail)
        except RmpaError as error:
            self._fail(error)

    def _unsubscribe(self) -> None:
        if self._subscription is not None:
            self._subscription.close()
            self._subscription = None

    def _is_shown(self, now: float) -> bool:
        """Whether a page shows the diagnostics themselves."""
        return now - self._looked < limits.LOOK_KEPT

    def all(self) -> Tree:
        """All statuses by key; those that did not change are the same objects as before."""
        self._looked = time.time()
        return {"statuses": dict(self._entries), "worst": [[at, level] for at, level in self._worst]}

    def one(self, key: str) -> Tree | None:
        """One status with its values."""
        status = self._find(key)
        if status is None:
            return None
        return {"heard": round(status.heard, 1), "source": status.source, "values": dict(status.values)}

    def past(self, key: str) -> dict[str, Any]:
        """The numbers of a status as far back as they are kept: by value, and their moments under an empty name."""
        status = self._find(key)
        return dict(history(status)) if status is not None else {}

    def _find(self, key: str) -> Status | None:
        parts = key.split(_BETWEEN, 2)
        return self._table.statuses.get(StatusKey(*parts)) if len(parts) == 3 else None

    def _fail(self, error: RmpaError) -> None:
        self._refused = str(error)
        self._subscription = None
        self._dirty = True

    def _take(self, message: ReceivedMessage) -> None:
        now = time.time()
        if message.source == OWN_NODE and not self._is_shown(now):
            self._table.touch(OWN_NODE, now)
            return
        if not self._table.admits(message.source, len(message.payload), now):
            return
        try:
            statuses = self._hub.values(message)["status"]
        except RmpaError:
            return  # not an array of statuses; its subscriber says so in the log
        self._table.take(message.source, statuses, now)
        self._dirty = True

    def _look(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(_LOOK, self._look)
        now = time.time()
        topic = self._hub.graph.topics.get(TOPIC)
        if not self._is_shown(now) and (topic is None or {*topic.publishers} <= {OWN_NODE}):
            self._unsubscribe()
            self._table.resume(now)
        elif self._subscription is None and not self._refused:
            self._subscribe(now)
        if self._table.judge(now):
            self._dirty = True
        if not self._dirty:
            return
        self._dirty = False
        before, self._entries = self._entries, {}
        for key, status in self._table.statuses.items():
            text = _BETWEEN.join(key)
            entry, known = _entry(status), before.get(text)
            self._entries[text] = known if known == entry else entry
        worst = self._table.worst()
        if not self._worst or self._worst[-1][1] != worst:
            self._worst.append((round(now, 1), worst))
        self.summary = self._count()
        self._changed()

    def _count(self) -> Tree:
        mine = [(key, entry) for key, entry in self._entries.items() if "agent" not in entry]
        wrong = [(key, entry) for key, entry in mine if entry["level"] == ERROR or entry.get("last") == ERROR]
        shown, of_node = [], Counter[object]()
        for key, entry in wrong:  # one node hides no other
            of_node[entry.get("module"), entry["node"]] += 1
            if of_node[entry.get("module"), entry["node"]] <= limits.DIAGNOSTIC_ERRORS_NODE:
                shown.append((key, entry))
        shown = shown[: limits.DIAGNOSTIC_ERRORS]
        found: Tree = {
            "levels": dict(Counter(str(entry["level"]) for entry in self._entries.values())),
            "errors": dict(shown),
            "more": len(wrong) - len(shown),
        }
        for name, level in (("warnings", WARN), ("stale", STALE)):
            those = (entry for _, entry in mine if entry["level"] == level and entry.get("last") != ERROR)
            found[name] = [[e.get("module", ""), e["name"]] for e in islice(those, 100)]
        problems: list[Value] = [f"{source}: {text}" for source, text in islice(self._table.problems.items(), 10)]
        return {**found, "problems": problems} | ({"refused": self._refused} if self._refused else {})


def _entry(status: Status) -> Tree:
    """A status without its values, as a page lists it."""
    entry: Tree = {
        "name": status.key.name,
        "level": status.level,
        "message": status.message,
        "since": round(status.since, 1),
        "levels": [[round(at, 1), level] for at, level in status.levels],
    }
    more = {"module": status.key.module, "hardware": status.key.hardware, "node": status.node}
    entry |= {name: value for name, value in more.items() if value}
    if status.last not in {status.level, OK}:
        entry["last"] = status.last
    return entry | ({"agent": True} if status.is_agents else {})
