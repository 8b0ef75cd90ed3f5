"""Which last values a site keeps, and how other sites ask for them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import MeshSource, SourceKind
from rmpa.gateway.sites.attachment import SiteAttachment
from rmpa.gateway.sites.io.last_value_store import LastValueStore
from rmpa.gateway.sites.io.last_values_part import SiteLastValues
from rmpa.gateway.sites.keys import SiteModule, SiteSource
from rmpa.gateway.sites.last_values import ValueHeader, fits, parse_value_key, value_key
from rmpa.gateway.sites.part import SiteExport
from rmpa.ros.wire.tcpros import TopicDescription
from tests.gateway.sites.loopback_session import LoopbackSession
from tests.gateway.sites.loopback_session import fits as intersect

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

RUN = "0" * 32
TEXT = "std_msgs/String"
MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


def topic(name: str, type_name: str = TEXT, node: str = "/node") -> SiteExport:
    source = MeshSource(SourceKind.TOPIC, "arm", RUN, node, name, type_name, name, f"/rmpa/arm{node}")
    return SiteExport(source, SiteSource(SiteModule("here", "arm", RUN), SourceKind.TOPIC, type_name, node, name))


class _Tap:
    def __init__(self, graph: TapGraph, key: tuple[str, str]) -> None:
        self.graph, self.key = graph, key

    def close(self) -> None:
        self.graph.taps.pop(self.key)
        self.graph.changed.set()


class TapGraph:
    """The topics of a gateway's graph; what listens is kept."""

    def __init__(self) -> None:
        self.taps: dict[tuple[str, str], tuple[Callable[[memoryview], None], Callable[[TopicDescription], None]]] = {}
        self.asked: set[str] = set()
        self.changed = asyncio.Event()

    def tap(
        self, source: MeshSource, on_message: Any, on_described: Any, on_lost: Any, *, listener: str = ""
    ) -> _Tap:
        del on_lost
        key = source.name, source.node
        assert key not in self.taps
        self.taps[key] = on_message, on_described
        self.asked.add(source.name)
        self.changed.set()
        return _Tap(self, key)

    async def until(self, name: str, there: bool, node: str = "/node") -> None:
        async with asyncio.timeout(30):
            while ((name, node) in self.taps) != there:
                self.changed.clear()
                await self.changed.wait()

    def send(self, name: str, body: bytes, *, latching: bool, node: str = "/node") -> None:
        on_message, on_described = self.taps[name, node]
        on_described(TopicDescription(TEXT, MD5, "string data\n", latching))
        if (name, node) in self.taps:
            on_message(memoryview(body))


class Kept:
    """A site's last values."""

    def __init__(self, path: Path | None) -> None:
        self.session, self.graph = LoopbackSession(), TapGraph()
        self.refusal = ""
        self.now = 100
        self.part = SiteLastValues(
            "here",
            cast("Any", self.session),
            cast("Any", self.graph),
            LastValueStore(path),
            lambda _module, name: name == "/wanted",
            lambda site, _module, _name: f"{site}: {self.refusal}" if self.refusal else "",
            lambda: self.now,
        )

    async def ask(self, selector: str, attachment: bytes = b"") -> list[Any]:
        return cast("list[Any]", await self.session.get(f"rmpa/1/here/{selector}", b"", attachment))


@pytest.fixture
async def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Kept]:
    monkeypatch.setattr(limits, "LATCH_LOOK_AFTER", 0.0)
    found = Kept(tmp_path / "values.sqlite")
    yield found
    await found.part.close()


async def test_a_latched_topic_is_kept_and_answered_when_its_module_is_off(kept: Kept) -> None:
    export = topic("/map")
    kept.part.export(export)
    await kept.graph.until("/map", there=True)
    kept.graph.send("/map", b"first", latching=True)
    kept.now = 200
    kept.graph.send("/map", b"second", latching=True)
    kept.part.withdraw(export)
    assert kept.graph.taps == {}
    (reply,) = await kept.ask("arm/v/map")
    assert (reply.ok, reply.key, reply.payload) == (True, "rmpa/1/here/arm/v/map", b"second")
    assert SiteAttachment.parse(reply.attachment) == SiteAttachment(1, 200, MD5, "/node", ("here",), True)
    (header,) = await kept.ask("arm/v/map?header")
    found = ValueHeader.parse(header.payload)
    assert (found.type, found.md5sum, found.definition, found.size) == (TEXT, MD5, "string data\n", 6)


async def test_a_topic_that_is_not_latched_is_left_alone_after_its_header(kept: Kept) -> None:
    kept.part.export(topic("/chatter"))
    await kept.graph.until("/chatter", there=True)
    kept.graph.send("/chatter", b"hello", latching=False)
    await kept.graph.until("/chatter", there=False)
    assert await kept.ask("arm/v/chatter") == []


async def test_descriptors_and_what_a_rule_names_are_kept_without_latching(kept: Kept) -> None:
    for name in ("/sonar/descriptor", "/wanted"):
        kept.part.export(topic(name))
        kept.graph.send(name, name.encode(), latching=False)
    assert {reply.payload for reply in await kept.ask("*/v/**")} == {b"/sonar/descriptor", b"/wanted"}


async def test_publishers_of_streams_are_not_asked(kept: Kept) -> None:
    kept.part.export(topic("/camera", "sensor_msgs/Image"))
    kept.part.export(topic("/map"))
    await kept.graph.until("/map", there=True)
    assert kept.graph.asked == {"/map"}


async def test_each_publisher_of_a_topic_has_its_value(kept: Kept) -> None:
    for node in ("/a", "/b"):
        kept.part.export(topic("/wanted", node=node))
        kept.graph.send("/wanted", node.encode(), latching=True, node=node)
    assert {reply.payload for reply in await kept.ask("arm/v/wanted")} == {b"/a", b"/b"}


async def test_a_site_that_may_not_have_a_topic_gets_the_rule_as_an_error(kept: Kept) -> None:
    kept.part.export(topic("/wanted"))
    kept.graph.send("/wanted", b"x", latching=True)
    kept.refusal = "gateway.rule 1 lets it not go out"
    asker = SiteAttachment(1, 1, MD5, "/n", ("office",)).serialize()
    (reply,) = await kept.ask("arm/v/wanted", asker)
    assert (reply.ok, reply.payload) == (False, b"office: gateway.rule 1 lets it not go out")


async def test_a_malformed_query_is_an_error_and_a_large_value_is_not_kept(
    kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    (reply,) = await kept.ask("arm/v/map", b"nonsense")
    assert not reply.ok
    monkeypatch.setattr(limits, "LAST_VALUE_MAX", 3)
    kept.part.export(topic("/wanted"))
    kept.graph.send("/wanted", b"1234", latching=True)
    assert await kept.ask("arm/v/wanted") == []
    assert kept.part.report()["dropped"] == 1


async def test_a_flood_of_questions_is_refused_and_the_next_one_is_answered(
    kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each may read 64 MiB from the disk."""
    monkeypatch.setattr(limits, "LAST_VALUES_ASKED_MAX", 2)
    kept.part.export(topic("/wanted"))
    kept.graph.send("/wanted", b"x", latching=True)
    answers = await asyncio.gather(*(kept.ask("arm/v/wanted") for _ in range(10)))
    good = [reply for replies in answers for reply in replies if reply.ok]
    bad = [reply for replies in answers for reply in replies if not reply.ok]
    assert (len(good), len(bad)) == (2, 8)
    assert all(b"ask again later" in reply.payload for reply in bad)
    assert kept.part.report()["refused"] == 8
    (reply,) = await kept.ask("arm/v/wanted")
    assert reply.ok


def test_keys_and_patterns() -> None:
    key = value_key("here", "arm", "/base/map")
    assert key == "rmpa/1/here/arm/v/base/map"
    assert parse_value_key(key) == ("here", "arm", "/base/map")
    for pattern in (key, "rmpa/1/here/*/v/**", "rmpa/1/here/arm/v/*/map", "rmpa/1/*/arm/v/base/**"):
        assert fits(pattern, key)
    for pattern in ("rmpa/1/here/arm/v/*", "rmpa/1/here/arm/v/base", "rmpa/1/there/**", "**/**/map"):
        assert not fits(pattern, key)
    with pytest.raises(RemoteProtocolError):
        parse_value_key("rmpa/1/here/arm/t/base/map")


chunk = st.sampled_from(["a", "b", "*"])


@given(st.lists(chunk, max_size=5), st.lists(st.sampled_from("ab"), max_size=5), st.integers(0, 5), st.booleans())
def test_patterns_fit_as_zenohs_key_expressions_do(pattern: list[str], key: list[str], at: int, deep: bool) -> None:
    if deep:
        pattern.insert(at, "**")
    assert fits("/".join(pattern), "/".join(key)) == intersect("/".join(pattern), "/".join(key))


@given(st.binary(max_size=300))
def test_what_is_no_header_is_refused(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        ValueHeader.parse(data)


def test_a_header_is_read_back() -> None:
    header = ValueHeader(node="/n", type=TEXT, md5sum=MD5, definition="x", latching=True, stamp=5, size=9)
    assert ValueHeader.parse(header.serialize()) == header
    with pytest.raises(RemoteProtocolError):
        ValueHeader.parse(ValueHeader(node="n", type=TEXT, md5sum=MD5).serialize())
