"""What a running node shows: rates of its topics, dynamic_reconfigure, parameters, diagnostics, and its process.

``describing`` writes a description of it, ``checking`` compares one with it.
"""

from __future__ import annotations

import ast
import asyncio
import contextlib
import math
import re
import struct
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.resource.reconfigure import DESCRIPTION_TYPE, read_config
from rmpa.ros.types.definitions import ARRAY_TYPE
from rmpa.ros.types.descriptor import CONFIG_TYPE

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from rmpa.resource.declare import ParameterValue
    from rmpa.ros.node.endpoints import Received, Subscriber
    from rmpa.ros.node.node import Node
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

DESCRIPTIONS: Final = "/parameter_descriptions"
UPDATES: Final = "/parameter_updates"
DIAGNOSTICS: Final = "/diagnostics"
# Messages from which a rate can be told.
_FEW: Final = 3
# Above it a bound is the largest number of its type.
_BOUNDLESS: Final = 1e300
# The begin of a definition whose first field is a header, behind comments, and of such a message.
_STAMPED: Final = re.compile(r"(\s*(#.*)?\n)*\s*(std_msgs/)?Header\s")
_STAMP: Final = struct.Struct("<III")
# Seconds before the measurement begins.
_WARM_UP: Final = 0.5


@dataclass(slots=True)
class Flow:
    """What came on one topic from one node while it was measured; times in seconds."""

    count: int = 0
    size: int = 0
    first: float = 0.0
    last: float = 0.0

    def add(self, data: memoryview, now: float, *, stamped: bool) -> None:
        """Count a message, by its stamp where it has one: what waited for this process comes all at once."""
        if stamped and len(data) >= _STAMP.size:
            _, seconds, nanoseconds = _STAMP.unpack_from(data)
            now = seconds + nanoseconds / 1e9 or now
        self.first = self.first or now
        self.last = now
        self.count += 1
        self.size += len(data)

    @property
    def rate(self) -> float:
        """Messages a second; 0 where too few came."""
        return (self.count - 1) / (self.last - self.first) if self.count >= _FEW and self.last > self.first else 0.0

    @property
    def bandwidth(self) -> float:
        """Bytes a second; 0 where too few messages came."""
        return self.rate * self.size / self.count if self.count else 0.0


@dataclass(frozen=True, slots=True)
class Knob:
    """A parameter of a node's dynamic_reconfigure.

    Args:
        name: Its name there.
        type: ``bool``, ``int``, ``double`` or ``str``.
        value: The present value, or the default where the node does not say it.
        low: The least value of a number; ``None``: no bound.
        high: The greatest value of a number; ``None``: no bound.
        choices: The values of an enumeration by their names.
        description: A text for people.
    """

    name: str
    type: str
    value: ParameterValue
    low: float | None = None
    high: float | None = None
    choices: Mapping[str, ParameterValue] = field(default_factory=dict)
    description: str = ""


@dataclass(frozen=True, slots=True)
class LiveGraph:
    """What was seen of a graph while it was looked at.

    Args:
        flows: By topic, then by node.
        knobs: By the name of the dynamic_reconfigure server, then by parameter.
        private: The values below each node on the parameter server.
        diagnostics: The values by key of each status on /diagnostics, by its name.
        status_of: The node that published each status.
    """

    flows: Mapping[str, Mapping[str, Flow]]
    knobs: Mapping[str, Mapping[str, Knob]]
    private: Mapping[str, Mapping[str, XmlRpcValue]]
    diagnostics: Mapping[str, Mapping[str, str]]
    status_of: Mapping[str, str]

    def rate(self, topic: str, node: str = "") -> float:
        """Messages a second on a topic, of one node or of all together."""
        return sum(flow.rate for caller, flow in self.flows.get(topic, {}).items() if node in ("", caller))


async def look(
    node: Node,
    *,
    topics: Collection[str],
    servers: Collection[str],
    owners: Collection[str],
    diagnostics: bool,
    seconds: float,
) -> LiveGraph:
    """Listen for a while.

    Args:
        node: A node at the core.
        topics: The topics that are measured.
        servers: The names of nodes, or of namespaces in them, that have dynamic_reconfigure.
        owners: The nodes whose private parameters are read.
        diagnostics: Whether /diagnostics is read.
        seconds: How long.

    Raises:
        UnreachableError: The master does not answer.
    """
    flows: dict[str, dict[str, Flow]] = {topic: {} for topic in topics}
    told: dict[str, Any] = {}
    statuses: dict[str, dict[str, str]] = {}
    status_of: dict[str, str] = {}

    def count(topic: str, data: memoryview, header: Mapping[str, str]) -> None:
        now = time.monotonic()
        if now >= begin:
            stamped = _STAMPED.match(header.get("message_definition", "")) is not None
            flows[topic].setdefault(header.get("callerid", ""), Flow()).add(data, now, stamped=stamped)

    def tell(topic: str, received: Received) -> None:
        told[topic] = received.message

    def diagnose(received: Received) -> None:
        for status in received.message.status:
            statuses.setdefault(str(status.name), {}).update((str(p.key), str(p.value)) for p in status.values)
            status_of[str(status.name)] = received.caller_id

    subscribers: list[Subscriber] = []
    begin = math.inf
    for topic in topics:
        counted = await node.subscribe(topic, None, on_bytes=lambda data, header, t=topic: count(t, data, header))  # type: ignore[misc]
        subscribers.append(counted)
    for topic, kind in ((f"{s}{end}", kind) for s in servers for end, kind in _LATCHED):
        subscribers.append(await node.subscribe(topic, kind, lambda received, t=topic: tell(t, received)))  # type: ignore[misc]
    if diagnostics:
        subscribers.append(await node.subscribe(DIAGNOSTICS, ARRAY_TYPE, diagnose))
    # What comes first may have waited: in the publisher's queue, or for the imports of this process.
    begin = time.monotonic() + _WARM_UP
    try:
        await asyncio.sleep(seconds + _WARM_UP)
    finally:
        for subscriber in subscribers:
            await subscriber.close()
    knobs = {
        server: {one.name: one for one in _knobs(told[f"{server}{DESCRIPTIONS}"], told.get(f"{server}{UPDATES}"))}
        for server in servers
        if f"{server}{DESCRIPTIONS}" in told
    }
    private = {}
    for owner in owners:
        found = await node.get_param(owner, default={})
        private[owner] = found if isinstance(found, dict) else {}
    return LiveGraph(flows, knobs, private, statuses, status_of)


_LATCHED: Final = ((DESCRIPTIONS, DESCRIPTION_TYPE), (UPDATES, CONFIG_TYPE))


def _knobs(description: Any, updates: Any) -> Iterable[Knob]:
    low, high, values = (read_config(config) for config in (description.min, description.max, description.dflt))
    if updates is not None:
        values |= read_config(updates)
    for one in (each for group in description.groups for each in group.parameters):
        name, kind = str(one.name), str(one.type)
        choices = _choices(str(one.edit_method))
        least, most = _bound(low.get(name)), _bound(high.get(name))
        if kind not in ("int", "double") or choices:
            least = most = None
        if name in values:
            yield Knob(name, kind, values[name], least, most, choices, str(one.description).strip())


def _bound(value: ParameterValue | None) -> float | None:
    """A declared bound; ``None`` for those that servers have where their author gave none."""
    if value is None or isinstance(value, str) or not math.isfinite(value):
        return None
    return None if value in (INT32_MIN, INT32_MAX) or abs(value) > _BOUNDLESS else value


def _choices(edit_method: str) -> dict[str, ParameterValue]:
    """The enumeration in an ``edit_method``, which is written as a Python expression."""
    with contextlib.suppress(ValueError, SyntaxError, MemoryError, RecursionError, TypeError, KeyError):
        found = ast.literal_eval(edit_method or "{}")
        return {str(one["name"]): one["value"] for one in found.get("enum", ())}
    return {}


def started_by(pid: int) -> dict[str, str | tuple[str, ...]]:
    """How a process of this machine seems to have been started: ``run``, ``launch`` or ``command``, and ``args``.

    Args:
        pid: Its process id; empty is returned where it cannot be read.
    """
    words = _command(pid)
    if not words:
        return {}
    parent = _command(_parent(pid))
    at = next((n for n, word in enumerate(parent) if Path(word).name == "roslaunch"), -1)
    if at >= 0 and (launched := [word for word in parent[at + 1 :] if not word.startswith("-")]):
        files = [word for word in launched if ":=" not in word]
        return {"launch": " ".join(files), "args": tuple(word for word in launched if ":=" in word)}
    begin = 0
    if re.match(r"python[\d.]*$", Path(words[0]).name):
        begin = next((n for n, word in enumerate(words) if n and not word.startswith("-")), 0)
    program = Path(words[begin])
    args = tuple(word for word in words[begin + 1 :] if not re.match(r"__(name|log|ns):=", word))
    package = next((folder.name for folder in program.parents[:3] if (folder / "package.xml").exists()), "")
    if not package and program.parent.parent.name in ("lib", "libexec"):
        package = program.parent.name
    started: dict[str, str | tuple[str, ...]] = {"command": tuple(words[: begin + 1])}
    if package:
        started = {"run": f"{package} {program.name}"}
    return started | ({"args": args} if args else {})


def _command(pid: int) -> list[str]:
    try:
        data = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return []
    return [word.decode(errors="replace") for word in data.rstrip(b"\0").split(b"\0") if word]


def _parent(pid: int) -> int:
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1])
    return 0
