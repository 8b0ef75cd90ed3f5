"""``rmpa diagnostics``: what the nodes of all modules say on ``/diagnostics``."""

from __future__ import annotations

import asyncio
import time
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.graph import Master, find_peer, origin_text, run_stream
from rmpa.cli.options import Options, argument, flag, graph_verb, option, peers, summary
from rmpa.cli.output import Painted, Table, Text, paint, print_json, print_text, printable, warn
from rmpa.core.errors import RmpaError
from rmpa.core.identity import proxied_peer
from rmpa.observe import limits
from rmpa.observe.diagnostics import ERROR, LEVELS, Status, StatusTable
from rmpa.observe.health import TOPIC
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.definitions import ARRAY_TYPE
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.ros.node.node import Node

_COLOURS: Final = {"OK": "green", "WARN": "yellow", "ERROR": "red", "STALE": "magenta"}
# Seconds to listen: at least so that each publisher, which sends once a second, is heard; at most as it is stale.
_LISTEN: Final = 1.2
_TICK: Final = 0.1


@graph_verb(
    argument("modules", peers, nargs=-1, metavar="MODULE..."),
    option(
        "--level",
        help="Only this level and worse ones.",
        type=click.Choice([level.lower() for level in LEVELS], case_sensitive=False),
        default="ok",
    ),
    option("--name", "PATTERN", "Only names like this: '*battery*'.", default="*"),
    flag("-v --values", "With the values."),
    flag("-f --follow", "Go on: print each change of a level, until Ctrl-C."),
)
def diagnostics(modules: tuple[str, ...], level: str, name: str, values: bool, follow: bool, options: Options) -> int:
    """Show what the nodes of all modules, or of each MODULE, say on /diagnostics: the worst first.

    Exits 1 if a status that is shown is at ERROR.

    ---
    It listens for 1.2 s, or until each publisher was heard, for 3 s at most. A status of which nothing came for 3 s
    is STALE. The levels are OK, WARN, STALE, ERROR. Those of rmpa itself begin with "rmpa:".

    Examples:
      rmpa diagnostics                       all statuses of all modules
      rmpa diagnostics base --level warn -v  what is wrong with the module base, with values
      rmpa diagnostics -f --name '*battery*'
      rmpa diagnostics --json | jq -r '.[] | select(.level == "ERROR").name'
    """
    master = options.master()
    watch = _Watch(master, modules, LEVELS.index(level.upper()), name)
    if follow:
        run_stream(lambda: watch.follow(options, values=values))
    else:
        asyncio.run(watch.listen())
        wanted = watch.wanted(watch.table.statuses.values())
        found = sorted(wanted, key=lambda one: (-LEVELS.index(one.level), one.key))
        options.show([watch.json(one) for one in found], watch.text(found, values=values))
    return int(any(one.level == ERROR for one in watch.wanted(watch.table.statuses.values())))


class _Watch:
    """Listens to ``/diagnostics``, and knows which statuses are wanted.

    Args:
        master: Its graph has the publishers.
        modules: Names of modules; none: all.
        least: The index of the least level that is wanted.
        name: A pattern for the names that are.

    Raises:
        RmpaError: A module is not known.
    """

    def __init__(self, master: Master, modules: tuple[str, ...], least: int, name: str) -> None:
        self.table = StatusTable()
        self._master = master
        snapshot = master.snapshot(topics=())
        self._own = snapshot.agent.name if snapshot is not None else ""
        if modules and snapshot is None:
            raise master.no_agent()
        self._modules = {
            "" if each == self._own or snapshot is None else find_peer(snapshot, each).name for each in modules
        }
        self._least = least
        self._name = name
        self._heard: set[str] = set()

    def wanted(self, statuses: Iterable[Status]) -> Iterator[Status]:
        """Those of some statuses that are shown."""
        for one in statuses:
            bad = LEVELS.index(one.level) >= self._least
            if bad and self._is_of(one.key.module) and fnmatchcase(one.key.name, self._name):
                yield one

    def _is_of(self, module: str) -> bool:
        return not self._modules or module in self._modules

    async def listen(self) -> None:
        """Hear each publisher once, if it speaks in time."""
        graph = await self._master.graph()
        publishers = {node for node in graph.publishers.get(TOPIC, ()) if self._is_of(proxied_peer(node) or "")}
        if not publishers:
            where = ", ".join(each or self._own for each in sorted(self._modules)) or "any module"
            warn(f"no node of {where} publishes {TOPIC}", "no-publisher")
            return

        async def hear(node: Node) -> None:
            begin = asyncio.get_running_loop().time()
            subscriber = await self._subscribe(node, lambda _: None)
            while not node.stopped.is_set():
                silent = publishers - self._heard - subscriber.refusals.keys()
                took = asyncio.get_running_loop().time() - begin
                if took > limits.DIAGNOSTIC_STALE or (took > _LISTEN and not silent):
                    break
                await asyncio.sleep(_TICK)
            for refusal in subscriber.refusals.values():
                warn(refusal, "refused")

        await self._master.with_node("rmpa_diagnostics", hear)
        for each in sorted(publishers - self._heard):
            warn(f"{origin_text(each)} has sent nothing for {limits.DIAGNOSTIC_STALE:g} s", "nothing-sent")
        self._tell_problems(set())

    async def follow(self, options: Options, *, values: bool) -> None:
        """Print each change until Ctrl-C."""

        def show(changed: Iterable[Status]) -> None:
            for one in self.wanted(changed):
                if options.as_json:
                    print_json({"at": one.since, **self.json(one)})
                else:
                    print_text(self._line(one), *(self._values(one) if values else ()))

        async def go_on(node: Node) -> None:
            told: set[str] = set()
            await self._subscribe(node, show)
            while not node.stopped.is_set():
                await asyncio.sleep(_TICK)
                show(self.table.judge(time.time()))
                self._tell_problems(told)

        await self._master.with_node("rmpa_diagnostics", go_on)

    async def _subscribe(self, node: Node, changed: Callable[[list[Status]], None]) -> Any:
        kind = MessageType(ARRAY_TYPE)
        codec = codec_for(kind)

        def take(data: memoryview, header: Mapping[str, str]) -> None:
            source, now = header.get("callerid", "?"), time.time()
            self._heard.add(source)
            if self.table.admits(source, len(data), now):
                try:
                    message: Any = codec.plain_values(data)
                except RmpaError as error:
                    warn(f"{source}: {error}", error.code)
                else:
                    changed(self.table.take(source, message["status"], now))

        return await node.subscribe(TOPIC, kind, on_bytes=take)

    def _tell_problems(self, told: set[str]) -> None:
        for source, text in self.table.problems.items():
            if source not in told:
                told.add(source)
                warn(f"{source}: {text}", "limit-reached")

    def json(self, one: Status) -> dict[str, object]:
        """A status for programs."""
        about = {"module": one.key.module or self._own, "hardware": one.key.hardware, "name": one.key.name}
        said = {"level": one.level, "message": one.message, "node": one.node, "values": one.values}
        return {**about, **said}

    def text(self, found: list[Status], *, values: bool) -> Iterator[Text]:
        """Statuses for people."""
        if not found:
            yield "there is no such status"
            return
        yield summary(len(found), "statuses", (one.level for one in found))
        if values:
            for one in found:
                yield self._line(one, dated=False)
                yield from self._values(one)
        else:
            rows = [
                (one.key.name, one.level, one.key.module or self._own or "-", one.key.hardware or "-", one.message)
                for one in found
            ]
            yield Table("NAME, LEVEL, MODULE, HARDWARE, MESSAGE", rows, [_COLOURS[one.level] for one in found])

    def _line(self, one: Status, *, dated: bool = True) -> Painted:
        at = time.strftime("%H:%M:%S ", time.localtime(one.since)) if dated else ""
        whose = " ".join(filter(None, (one.key.module or self._own, one.key.hardware)))
        last = f" (last {one.last})" if one.level != one.last else ""
        text = printable(f"{whose}: {one.key.name}: {one.message}")
        return Painted(f"{at}{paint(one.level, _COLOURS[one.level])}{last} {text}")

    def _values(self, one: Status) -> Iterator[str]:
        yield from (f"    {key}: {value}" for key, value in one.values.items())
