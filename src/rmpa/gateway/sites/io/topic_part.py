"""The part of the neighbour "other sites" for topics."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.bridge.policy import Needs
from rmpa.config.peer_rules import Access
from rmpa.core.counters import Counters
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.attachment import AttachmentReader
from rmpa.gateway.sites.io.exported_topic import ExportedTopic
from rmpa.gateway.sites.io.imported_topic import ImportedTopic, InterruptedTopic
from rmpa.gateway.sites.keys import ROOT
from rmpa.gateway.sites.part import SitePart
from rmpa.gateway.sites.report import site_counts
from rmpa.gateway.sites.topic_header import REFUSED

if TYPE_CHECKING:
    from rmpa.core.contract import Contracts
    from rmpa.core.counters import Clock
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.sites.attachment import MessageSource
    from rmpa.gateway.sites.keys import SiteModule
    from rmpa.gateway.sites.part import SiteExport, SiteImport
    from rmpa.gateway.sites.rules import CrossingRules
    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.gateway.zenoh_api import ZenohSample


@dataclass(slots=True)
class _Subscription:
    """The subscription to one topic of one module at another site, which its publishers share."""

    declared: Declaration
    topics: dict[str, ImportedTopic] = field(default_factory=dict)
    """By node."""
    latched: dict[str, tuple[bytes, int, MessageSource]] = field(default_factory=dict)
    """The last latched message of nodes that are not wanted: they were told once, and would not be again."""


class SiteTopics(SitePart):
    """Topics between sites: a ``SitePart``.

    Args:
        site: This site's name.
        graph: The gateway's graph.
        session: The Zenoh session.
        rules: Tell which site may have which topic.
        contracts: The contracts of topics, which become Zenoh's QoS.
        clock: Both clocks.
        counters: ``site.message.malformed``, ``site.message.looped``, ``site.message.unwanted_node``, and
            ``site.message.unkept``: a latched message of a node that no node here wants, and that found no room.
    """

    name = "topics"

    def __init__(
        self,
        site: str,
        graph: AgentGraph,
        session: OpenSession,
        rules: CrossingRules,
        contracts: Contracts,
        clock: Clock,
        counters: Counters | None = None,
    ) -> None:
        self._site = site
        self._graph = graph
        self._session = session
        self._rules = rules
        self._contracts = contracts
        self._clock = clock
        self._exported: dict[tuple[str, str], dict[tuple[str, str], ExportedTopic]] = {}
        """By module and topic, then by node and the site that it is for (empty: for all)."""
        self._imported: dict[tuple[str, str, str, str], ImportedTopic] = {}
        """By site, module, node and name there."""
        self._interrupted: dict[tuple[str, str, str, str], InterruptedTopic] = {}
        """Likewise: those that went while nodes subscribed."""
        self._subscriptions: dict[str, _Subscription] = {}
        self._questions: dict[SiteModule, tuple[Declaration, Declaration]] = {}
        self._reader = AttachmentReader()
        self._check_timer: asyncio.TimerHandle | None = None
        self.counters = counters if counters is not None else Counters()

    # --- SitePart -------------------------------------------------------------------------------------------------

    def export(self, entry: SiteExport) -> None:
        """Declare a publisher of this site, for other sites."""
        if entry.source.kind is not SourceKind.TOPIC:
            return
        self.withdraw(entry)
        contract = self._contracts.of(entry.source.here, entry.announced.type)
        topics = self._exported.setdefault((entry.source.module, entry.source.name), {})
        topics[entry.source.node, entry.announced.to] = ExportedTopic(
            entry, self._graph, self._session, contract, self._clock
        )

    def withdraw(self, entry: SiteExport) -> None:
        """Undeclare it."""
        if entry.source.kind is not SourceKind.TOPIC:
            return  # a service of a node may have the name of its topic
        key = (entry.source.module, entry.source.name)
        topic = self._exported.get(key, {}).pop((entry.source.node, entry.announced.to), None)
        if topic is not None:
            topic.close()
            if not self._exported[key]:
                del self._exported[key]

    def show(self, entry: SiteImport) -> None:
        """Show a publisher of another site."""
        if entry.source.kind is SourceKind.TOPIC:
            self.hide(entry)
            ident = _ident(entry)
            interrupted = self._interrupted.pop(ident, None)
            self._imported[ident] = ImportedTopic(
                entry,
                self._site,
                self._graph,
                self._session,
                self._clock,
                self._on_demand,
                interrupted,
            )

    def renew(self, old: SiteImport, new: SiteImport) -> None:
        """It is of another run of its module, or comes by another gateway."""
        del old
        topic = self._imported.get(_ident(new))
        if topic is not None and new.source.kind is SourceKind.TOPIC:
            topic.renew(new)

    def hide(self, entry: SiteImport) -> None:
        """Take it out of the graph."""
        if entry.source.kind is SourceKind.TOPIC:
            topic = self._imported.pop(_ident(entry), None)
            interrupted = topic.close() if topic is not None else None
            if interrupted is not None:
                self._interrupted[_ident(entry)] = interrupted
                if len(self._interrupted) > limits.INTERRUPTED_TOPICS_MAX:
                    del self._interrupted[next(iter(self._interrupted))]

    def module_changed(self, module: SiteModule, there: bool) -> None:
        """Answer questions for headers and definitions of a module of this site."""
        if module.site != self._site:
            return
        if there and module not in self._questions:
            prefix = f"{ROOT}/{module.site}/{module.name}/d"
            self._questions[module] = (
                self._session.queryable(
                    f"{prefix}/t/**",
                    lambda query: self._on_header_query(module, query),
                    Needs((Access.SUBSCRIBE,), "the topic, of the site", key="rmpa/1/<site>/<module>/d/t/**"),
                ),
                self._session.queryable(
                    f"{prefix}/m/*",
                    lambda query: self._on_definition_query(module, query),
                    Needs((), "the definition of a type whose md5 sum is known", key="rmpa/1/<site>/<module>/d/m/*"),
                ),
            )
        elif not there:
            for declared in self._questions.pop(module, ()):
                declared.close()

    def report(self) -> dict[str, object]:
        """The topics that go out and come in, as far as they are or were used."""
        out = [topic for nodes in self._exported.values() for topic in nodes.values()]
        return {
            "out": [topic.report() for topic in out if topic.used],
            "in": [topic.report() for topic in self._imported.values() if topic.used],
            "counters": site_counts(self.counters),
        }

    async def close(self) -> None:
        """End it: everything was withdrawn and hidden before."""
        if self._check_timer is not None:
            self._check_timer.cancel()
            self._check_timer = None
        for declared in (each for pair in self._questions.values() for each in pair):
            declared.close()
        self._questions.clear()

    # --- what comes in --------------------------------------------------------------------------------------------

    def _on_demand(self, topic: ImportedTopic, wanted: bool) -> None:
        announced = topic.entry.announced
        key = announced.key()
        subscription = self._subscriptions.get(key)
        if wanted:
            if subscription is None:
                declared = self._session.subscribe(key, lambda sample: self._on_sample(key, sample), history=True)
                subscription = self._subscriptions[key] = _Subscription(declared)
            subscription.topics[announced.node] = topic
            self._check_later()
            known = subscription.latched.pop(announced.node, None)
            if known is not None:
                topic.take(*known)
        elif subscription is not None:
            subscription.topics.pop(announced.node)
            if not subscription.topics:
                del self._subscriptions[key]
                subscription.declared.close()

    def _on_sample(self, key: str, sample: ZenohSample) -> None:
        try:
            sequence, _, source = self._reader.read(sample.attachment)
        except RemoteProtocolError:
            self.counters.add("site.message.malformed")
            return
        if self._site in source.path:
            self.counters.add("site.message.looped")
            return
        subscription = self._subscriptions.get(key)
        if subscription is None:
            return
        topic = subscription.topics.get(source.node)
        if topic is not None:
            topic.take(sample.payload, sequence, source)
            return
        self.counters.add("site.message.unwanted_node")
        known = subscription.latched
        if source.latched and (source.node in known or len(known) < limits.LATCHED_NODES_MAX):
            others = sum(len(each[0]) for node, each in known.items() if node != source.node)
            if others + len(sample.payload) > limits.HELD_BYTES:
                self.counters.add("site.message.unkept")
            else:
                known[source.node] = sample.payload, sequence, source

    def _check_later(self) -> None:
        if self._check_timer is None and self._subscriptions:
            self._check_timer = asyncio.get_running_loop().call_later(limits.IDLE_CHECK, self._check)

    def _check(self) -> None:
        self._check_timer = None
        now = self._clock.now()
        for subscription in self._subscriptions.values():
            for topic in subscription.topics.values():
                topic.check(now)
        self._check_later()

    # --- questions of other sites -----------------------------------------------------------------------------------

    def _on_header_query(self, module: SiteModule, query: ArrivedQuery) -> None:
        name = query.key.removeprefix(f"{ROOT}/{module.site}/{module.name}/d/t")
        asked = dict(pair.partition("=")[::2] for pair in query.parameters.split(";"))
        node, site = asked.get("node", ""), asked.get("site", "")
        if refusal := self._rules.refusal(site, module.name, name):
            query.reply_error(f"{REFUSED}{refusal}")
            return
        topics = self._exported.get((module.name, name), {})
        fitting = (each for (its, to), each in topics.items() if node in ("", its) and to in ("", site))
        topic = next(fitting, None)
        if topic is None:
            query.reply_error(f"no such publisher of {name[:200]} at {module.name}")
            return
        topic.ask(query)

    def _on_definition_query(self, module: SiteModule, query: ArrivedQuery) -> None:
        md5 = query.key.rpartition("/")[2]
        for (name, _), nodes in self._exported.items():
            for topic in nodes.values() if name == module.name else ():
                if topic.description is not None and topic.description.md5sum == md5:
                    query.reply(query.key, topic.description.definition.encode(errors="surrogateescape"))
                    query.finish()
                    return
        query.reply_error(f"no publisher with the md5 sum {md5[:40]} was connected yet")


def _ident(entry: SiteImport) -> tuple[str, str, str, str]:
    return entry.source.site, entry.source.module, entry.source.node, entry.announced.name
