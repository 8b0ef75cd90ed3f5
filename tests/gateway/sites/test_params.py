"""Parameters between sites: read and written, as policy and rules let them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.params import rules as transfer
from rmpa.config.peer_rules import Access
from rmpa.core.errors import PeerRefused, RemoteProtocolError, UnreachableError
from rmpa.gateway.rules import CrossingRules
from rmpa.gateway.sites.params import (
    ParamQuestion,
    SiteParams,
    from_json,
    param_key,
    parse_param_key,
    to_json,
)
from rmpa.ros.master.parameters import leaves
from rmpa.ros.wire.xmlrpc import parse_response, serialize_response
from tests.gateway.memory_zenoh import MemoryZenoh
from tests.gateway.sites.site_bed import site_context

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable


class ArmParams:
    """The module arm: what its agent answers over the mesh."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {"/speed": 1.5, "/gains": {"p": 1, "i": 2}, "/big": "x" * 100_000}
        self.there = True

    async def ask(self, module: str, what: str, args: dict[str, Any]) -> object:
        if not self.there or module != "arm":
            raise UnreachableError("linked peer", repr(module))
        if what == transfer.GET:
            return {"text": serialize_response(self._get(args["key"])).decode()}
        if what == transfer.NAMES:
            names = [name for key, value in self.values.items() for name, _ in leaves(key, value)]
            return {"text": serialize_response(names).decode()}
        if what == transfer.SET:
            self.values[args["key"]] = parse_response(args["text"].encode())
            return {"count": 1}
        self._get(args["key"])
        del self.values[args["key"]]
        return {}

    def _get(self, key: str) -> Any:
        if key not in self.values:
            raise PeerRefused("arm", f"there is no parameter {key}")
        return self.values[key]


class KeptHome(CrossingRules):
    """Rules that keep some parameters at home."""

    denied: frozenset[str] = frozenset()

    secured = True

    def denial(
        self, site: str, name: str, access: Access, askers: Iterable[str] = (), told: str | None = None
    ) -> str:
        assert access is Access.PARAM
        return f"{site} may not have {told}" if site == "desk" and name in self.denied else ""

    def refusal(
        self,
        site: str,
        module: str,
        name: str,
        access: Access = Access.SUBSCRIBE,
        askers: Iterable[str] = (),
        told: str | None = None,
    ) -> str:
        assert access is Access.PARAM
        return f"a rule keeps {told} of {module} from {site}" if name in self.denied else ""


class ParamSites:
    """Two sites, of which the second asks."""

    def __init__(self) -> None:
        network = MemoryZenoh()
        self.session, self.arm, self.rules, self.here = network.session(), ArmParams(), KeptHome(), KeptHome()
        self.exports = SiteParams(site_context("warehouse", None, self.session, self.rules), self.arm.ask)
        self.imports = SiteParams(site_context("office", None, self.session, self.here), self.arm.ask)
        self.leading = self.exports.answer()

    async def ask(self, what: str, asker: str = "desk", **args: str) -> Any:
        return await self.imports.ask(asker, "warehouse", "arm", {"what": what, **args})

    async def get(self, key: str) -> Any:
        return parse_response((await self.ask(transfer.GET, key=key))["text"].encode())

    async def names(self) -> Any:
        return parse_response((await self.ask(transfer.NAMES))["text"].encode())

    async def set(self, key: str, value: Any) -> Any:
        return (await self.ask(transfer.SET, key=key, text=serialize_response(value).decode()))["count"]

    async def program(self, name: str, value: bytes = b"") -> tuple[bool, str]:
        """A program of Zenoh reads or sets a parameter; whether it is answered, and the answer."""
        (reply,) = await self.session.get(f"rmpa/1/warehouse/arm/p/{name}", value)
        return reply.ok, reply.text


@pytest.fixture
async def sites() -> AsyncIterator[ParamSites]:
    found = ParamSites()
    yield found
    await found.exports.close()


async def test_parameters_of_another_site_are_read_and_written_also_large_ones(sites: ParamSites) -> None:
    assert await sites.get("/speed") == 1.5
    assert await sites.get("/gains") == {"p": 1, "i": 2}
    assert await sites.get("/big") == "x" * 100_000
    assert await sites.set("/speed", 2.5) == 1
    assert sites.arm.values["/speed"] == 2.5
    large = "y" * (5 * bridge_limits.ASK_EXPRESS_MAX)
    assert await sites.set("/big", large) == 1
    assert sites.arm.values["/big"] == large
    assert await sites.names() == ["/speed", "/gains/p", "/gains/i", "/big"]
    assert await sites.ask(transfer.DELETE, key="/speed") == {}
    assert "/speed" not in sites.arm.values


async def test_what_the_module_refuses_arrives_with_its_text(sites: ParamSites) -> None:
    with pytest.raises(PeerRefused) as caught:
        await sites.get("/none")
    assert caught.value.reason == "there is no parameter /none"
    sites.arm.there = False
    with pytest.raises(PeerRefused, match="no linked peer answers at 'arm'"):
        await sites.get("/speed")


async def test_a_rule_of_the_gateway_keeps_parameters_home_also_within_a_namespace(sites: ParamSites) -> None:
    sites.rules.denied = frozenset(("/speed", "/gains/p"))
    for asked in (
        *(ask for key in ("/speed", "/gains") for ask in (sites.get(key), sites.ask(transfer.DELETE, key=key))),
        sites.set("/gains", {"p": 5}),
    ):
        with pytest.raises(PeerRefused, match="a rule keeps"):
            await asked
    assert sites.arm.values["/gains"] == {"p": 1, "i": 2}
    assert await sites.names() == ["/gains/i", "/big"]


async def test_a_program_reads_and_sets_them_as_json(sites: ParamSites) -> None:
    assert await sites.program("gains") == (True, '{"p":1,"i":2}')
    assert await sites.program("speed", b"[1, true]") == (True, "1")
    assert sites.arm.values["/speed"] == [1, True]
    for name, value, why in (
        *(("speed", each, "") for each in (b"null", b"{", b'{"a": null}')),
        ("**", b"", "names several"),
    ):
        ok, text = await sites.program(name, value)
        assert (ok, why in text) == (False, True)


async def test_a_gateway_that_stands_by_does_not_answer(sites: ParamSites) -> None:
    sites.leading.close()
    with pytest.raises(UnreachableError, match="site warehouse for its module arm"):
        await sites.get("/speed")


async def test_questions_under_way_end_with_the_gateway(sites: ParamSites) -> None:
    begun = asyncio.Event()

    async def hang(module: str, what: str, args: dict[str, Any]) -> object:
        begun.set()
        return await asyncio.Event().wait()

    sites.exports._ask = hang
    question = asyncio.create_task(sites.get("/speed"))
    await begun.wait()
    await sites.exports.close()
    with pytest.raises(PeerRefused, match="the gateway of site warehouse ends"):
        await question


def test_questions_are_checked_and_values_are_the_same_as_json() -> None:
    value: Any = {"p": [1, -(2**31), 2.5, True, "é", []], "deep": {"er": {}}}
    assert from_json(to_json(value)) == value
    for op, key, *askers in (("shout", "/a"), ("get", "a"), ("get", ""), ("set", "/a//b"), ("get", "/a", "a b")):
        with pytest.raises(RemoteProtocolError):
            ParamQuestion.parse(msgspec.json.encode({"op": op, "key": key, "askers": askers}))
    question = ParamQuestion(op="set", key="/a", text="1", askers=("arm",))
    assert ParamQuestion.parse(msgspec.json.encode(question)) == question


def test_keys() -> None:
    assert param_key("home", "arm", "/gains/p") == "rmpa/1/home/arm/p/gains/p"
    assert parse_param_key("rmpa/1/home/arm/p/gains/p") == ("arm", "/gains/p")
    assert parse_param_key("rmpa/1/home/arm/p/-") == ("arm", "-")
    for key in ("rmpa/1/home/arm/p", "rmpa/1/home/arm/t/x", "rmpa/1/home/*/p/x", "rmpa/1/home/arm/p/" + "x" * 3000):
        with pytest.raises(RemoteProtocolError):
            parse_param_key(key)


async def test_a_module_here_gets_what_it_may_have_by_this_gateways_permissions_too(sites: ParamSites) -> None:
    """As ``ParamOwner`` judges: leaves, what would be lost, and the slash at the end."""
    sites.here.denied = frozenset({"/gains/i"})
    for key in ("/gains", "/gains/", "/gains/i/"):
        for asked in (sites.get(key), sites.ask(transfer.DELETE, key=key), sites.set(key, 5)):
            with pytest.raises(PeerRefused, match=rf"desk may not have {key.rstrip('/')}$"):
                await asked
    assert sites.arm.values["/gains"] == {"p": 1, "i": 2}
    assert await sites.names() == ["/speed", "/gains/p", "/big"]
    assert "p" in (await sites.ask(transfer.GET, "", key="/gains"))["text"], "this machine's user"


async def test_questions_carry_the_modules_that_ask_to_the_owner(sites: ParamSites) -> None:
    asked: list[tuple[str, Any, Any]] = []
    arm_asks = sites.arm.ask

    async def ask(module: str, what: str, args: dict[str, Any]) -> object:
        asked.append((what, args["site"], args["askers"]))
        return await arm_asks(module, what, args)

    sites.exports._ask = ask
    await sites.get("/speed")
    await sites.set("/speed", 2)
    await sites.names()
    await sites.ask(transfer.DELETE, key="/speed")
    assert {(site, tuple(askers)) for _, site, askers in asked} == {("office", ("desk",))}
    await sites.program("gains")
    assert asked[-1] == (transfer.GET, "", [])


async def test_the_own_sites_modules_are_asked_by_themselves(sites: ParamSites) -> None:
    for asker in ("desk", ""):
        with pytest.raises(PeerRefused, match="of this very site: ask it itself, by --peer base"):
            await sites.imports.ask(asker, "office", "base", {"what": transfer.GET, "key": "/"})


async def test_a_site_is_not_told_whether_a_parameter_is_there_that_a_rule_keeps_from_it(sites: ParamSites) -> None:
    sites.rules.denied = frozenset(("/speed", "/none"))
    texts = [(await sites.program(name))[1].replace(name, "X") for name in ("speed", "none")]
    assert texts[0] == texts[1]
