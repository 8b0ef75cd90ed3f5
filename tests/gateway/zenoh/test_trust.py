"""mTLS and Zenoh's table of access, by real routers and sessions with certificates of a mesh made for the test."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.config.rules import GatewaySettings
from rmpa.config.settings import Settings, TrustSettings
from rmpa.core.errors import StartError
from rmpa.gateway.neighbour import ZenohQos
from rmpa.gateway.zenoh import access as trust
from rmpa.gateway.zenoh.access import open_trusted_session, revoked_modules, zenohd_config
from rmpa.gateway.zenoh.config import ZenohConfig
from rmpa.gateway.zenoh.session import open_session
from rmpa.trust.certificates import DenyList
from tests.gateway.zenoh_bed import until
from tests.gateway.zenoh_fleet import Fleet, allow, deny
from tests.trust.io.member_files import SecuredMesh

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from rmpa.config.peer_rules import PermissionRule
    from rmpa.gateway.zenoh.config import ArrivedQuery
    from rmpa.gateway.zenoh.session import OpenSession

zenoh = pytest.importorskip("zenoh")

SCAN = "rmpa/1/home/arm/t/sensor_msgs%LaserScan/scan"
SECRET = "rmpa/1/home/arm/t/std_msgs%String/secret/key"


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[Fleet]:
    made = Fleet(tmp_path)
    try:
        yield made
    finally:
        await made.close()


async def test_the_rules_of_permission_hold_in_a_router(fleet: Fleet) -> None:
    await fleet.router(
        allow("a", publish="/scan /secret/**", serve="/stop"),
        allow("b", subscribe="/scan /secret/**", call="/stop"),
        deny("b", subscribe="/secret/**"),
    )
    a, b, c = await fleet.gateway("a"), await fleet.gateway("b"), await fleet.gateway("c")
    tokens: list[str] = []
    b.watch_tokens("rmpa/1/**", lambda key, _: tokens.append(key))
    a.token("rmpa/1/home/arm/up/00")
    await until(lambda: tokens)  # presence is for every member
    got: dict[str, list[bytes]] = {"b": [], "b secret": [], "c": []}
    matching: dict[str, list[bool]] = {"a": [], "a secret": [], "c": []}
    b.subscribe(SCAN, lambda sample: got["b"].append(sample.payload))
    b.subscribe(SECRET, lambda sample: got["b secret"].append(sample.payload))
    c.subscribe(SCAN, lambda sample: got["c"].append(sample.payload))
    scan = a.publisher(SCAN, ZenohQos(), matching["a"].append)
    secret = a.publisher(SECRET, ZenohQos(), matching["a secret"].append)
    forged = c.publisher(SCAN, ZenohQos(), matching["c"].append)
    await until(lambda: matching["a"] and matching["a"][-1])
    forged.put(b"forged")
    secret.put(b"secret")
    scan.put(b"scan")
    await until(lambda: got["b"])

    def stop(query: ArrivedQuery) -> None:
        query.reply(query.key, b"stopped")
        query.finish()

    a.queryable("rmpa/1/home/arm/s/*/stop", stop)
    service = "rmpa/1/home/arm/s/std_srvs%Trigger/stop"
    async with asyncio.timeout(20):
        while not (replies := await b.get(service, timeout=1.0)):
            await asyncio.sleep(0.02)
    assert [reply.payload for reply in replies] == [b"stopped"]
    assert await c.get(service, timeout=1.0) == []
    assert got == {"b": [b"scan"], "b secret": [], "c": []}
    assert matching["a secret"] == [False]
    assert matching["c"] == [False]


async def test_headers_and_parameters_are_answered_for_the_names_that_are_permitted(fleet: Fleet) -> None:
    await fleet.router(
        allow("a", publish="/scan /secret/**"), allow("b", subscribe="/scan", param="/arm/**"), allow("c", call="/x")
    )
    a, b, c = await fleet.gateway("a"), await fleet.gateway("b"), await fleet.gateway("c")

    def answer(query: ArrivedQuery) -> None:
        query.reply(query.key, b"told")
        query.finish()

    for what in ("arm/d/t", "arm/d/m", "*/p"):
        a.queryable(f"rmpa/1/home/{what}/**", answer)
    a.queryable("rmpa/1/home/-gateway/why", answer)

    async def told(session: OpenSession, what: str) -> bool:
        return bool(await session.get(f"rmpa/1/home/{what}", b"", timeout=2.0))

    allowed = ("arm/d/t/scan", "arm/d/m/00", "arm/p/arm/speed", "arm/p/-", "-gateway/why")
    async with asyncio.timeout(30):
        for what in allowed:
            while not await told(b, what):
                await asyncio.sleep(0.02)
    assert not any([await told(b, what) for what in ("arm/d/t/secret/key", "arm/p/other")])
    assert [what for what in allowed if await told(c, what)] == ["arm/d/m/00", "-gateway/why"]


async def test_the_cache_of_a_latched_topic_crosses_where_it_is_permitted(fleet: Fleet) -> None:
    await fleet.router(allow("a", publish="/scan"), allow("b", subscribe="/scan"))
    a, b, c = await fleet.gateway("a"), await fleet.gateway("b"), await fleet.gateway("c")
    publisher = a.publisher(SCAN, ZenohQos(cache=1), lambda _: None)
    publisher.put(b"map")
    await until(lambda: publisher.sent == 1)
    got: list[bytes] = []
    stolen: list[bytes] = []
    c.subscribe(SCAN, lambda sample: stolen.append(sample.payload), history=True)
    b.subscribe(SCAN, lambda sample: got.append(sample.payload), history=True)
    await until(lambda: got)
    assert (got, stolen) == ([b"map"], [])


async def test_with_everything_allowed_a_denial_still_holds(fleet: Fleet) -> None:
    await fleet.router(deny("*", publish="/secret/**"), default="allow")
    a, b = await fleet.gateway("a"), await fleet.gateway("b")
    got: list[str] = []
    matching: list[bool] = []
    b.subscribe("rmpa/1/**", lambda sample: got.append(sample.key))
    secret = a.publisher(SECRET, ZenohQos(), lambda _: None)
    scan = a.publisher(SCAN, ZenohQos(), matching.append)
    await until(lambda: matching and matching[-1])
    secret.put(b"x")
    await until(lambda: secret.sent)
    scan.put(b"x")
    await until(lambda: SCAN in got)
    assert got == [SCAN]


@pytest.mark.parametrize("authority", [True, False])
@pytest.mark.parametrize(
    ("default", "rules"),
    [
        ("deny", (allow("a", "b", publish="/**", subscribe="/**"), deny("b", subscribe="/secret/**"))),
        ("deny", (allow("*", publish="/**", subscribe="/**"), deny("b", subscribe="/secret/**"))),
        ("deny", (allow("a", "b", publish="/**", subscribe="/**"), deny("*", subscribe="/secret/**"))),
        ("allow", (deny("a", "b", publish="/other"), deny("b", subscribe="/secret/**"))),
        ("allow", (deny("*", publish="/other"), deny("b", subscribe="/secret/**"))),
        ("allow", (allow("*", subscribe="/**"), deny("b", subscribe="/secret/**"))),
    ],
)
async def test_a_denial_wins_whichever_rules_allow_it(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, default: str, rules: tuple[PermissionRule, ...], authority: bool
) -> None:
    """Zenoh allows a certificate what it allows to everybody, so the table must not have both."""
    monkeypatch.setattr(trust, "known_modules", lambda _: ("a", "b", "fleet") if authority else ())
    await fleet.router(*rules, default=default)
    a, b = await fleet.gateway("a"), await fleet.gateway("b")
    got: list[str] = []
    matching: list[bool] = []
    for key in ("rmpa/1/home/arm/t/**", SCAN, SECRET):
        b.subscribe(key, lambda sample: got.append(sample.key))
    secret = a.publisher(SECRET, ZenohQos(), lambda _: None)
    scan = a.publisher(SCAN, ZenohQos(), matching.append)
    await until(lambda: matching and matching[-1])
    for _ in range(3):
        secret.put(b"x")
        await until(lambda: secret.sent)
        got.clear()
        scan.put(b"x")
        await until(lambda: SCAN in got)
        assert SECRET not in got


async def test_a_program_without_a_certificate_of_the_mesh_is_not_let_in(fleet: Fleet, tmp_path: Path) -> None:
    await fleet.router(default="allow")
    settings = Settings(
        name="eve", state_dir=str(tmp_path / "none"), gateway=GatewaySettings(connect=(fleet.endpoint,))
    )
    with pytest.raises(StartError, match=r"joined no secured mesh.*rmpa trust join"):
        await open_trusted_session(settings)
    with pytest.raises(StartError, match="zenoh tls/"):
        await open_session(ZenohConfig(connect=(fleet.endpoint,)))
    foreign = SecuredMesh(tmp_path / "foreign")
    foreign.save("a", time.time())
    settings = Settings(name="a", state_dir=str(foreign.folder), gateway=GatewaySettings(connect=(fleet.endpoint,)))
    opened = None
    with contextlib.suppress(StartError):
        opened = await open_trusted_session(settings)
    if opened is not None:  # TLS 1.3: the client learns only later that its certificate was refused
        await until(lambda: not opened.endpoints)
        await opened.close()


async def test_a_renewed_certificate_makes_a_listening_session_stale_and_a_connecting_one_not(fleet: Fleet) -> None:
    router, a = await fleet.router(default="allow"), await fleet.gateway("a")
    before = (router.stale, a.stale)
    fleet.mesh.save("fleet", time.time())
    fleet.mesh.save("a", time.time())
    assert (before, (router.stale, a.stale)) == ((False, False), (True, False))


async def test_the_file_for_zenohd_opens_a_router_that_enforces_the_same(fleet: Fleet, tmp_path: Path) -> None:
    gateway = GatewaySettings(listen=(fleet.endpoint,))
    rules = TrustSettings(rules=(allow("a", publish="/scan"), allow("b", subscribe="/**")))
    text = zenohd_config(fleet.settings("fleet", gateway, rules))
    file = tmp_path / "zenohd.json5"
    file.write_text(text)
    router = await asyncio.to_thread(lambda: zenoh.open(zenoh.Config.from_file(str(file))))
    try:
        a, b = await fleet.gateway("a"), await fleet.gateway("b")
        got: list[str] = []
        matching: list[bool] = []
        b.subscribe(SECRET, lambda sample: got.append(sample.key))
        b.subscribe(SCAN, lambda sample: got.append(sample.key))
        secret = a.publisher(SECRET, ZenohQos(), lambda _: None)
        scan = a.publisher(SCAN, ZenohQos(), matching.append)
        await until(lambda: matching and matching[-1])
        secret.put(b"x")
        await until(lambda: secret.sent)
        scan.put(b"x")
        await until(lambda: SCAN in got)
        assert got == [SCAN]
    finally:
        await asyncio.to_thread(router.close)


def test_the_file_for_zenohd_needs_certificates_or_says_that_it_is_insecure(tmp_path: Path) -> None:
    settings = Settings(name="fleet", state_dir=str(tmp_path))
    with pytest.raises(StartError, match=r"tls/0\.0\.0\.0:7447"):
        zenohd_config(settings)
    text = zenohd_config(replace(settings, gateway=GatewaySettings(insecure=True, listen=("tcp/0.0.0.0:7447",))))
    assert "// INSECURE" in text
    assert json.loads(text[text.index("{") :])["listen"]["endpoints"] == ["tcp/0.0.0.0:7447"]


async def test_a_revoked_module_may_do_nothing_at_the_router_and_others_go_on(fleet: Fleet) -> None:
    """Zenoh itself checks no deny list: the table of access keeps it out, also where everything is allowed."""
    fleet.mesh.deny = DenyList().with_name("a", time.time())
    await fleet.router(allow("a", "b", "c", publish="/**", subscribe="/**"), default="allow")
    a, b, c = await fleet.gateway("a"), await fleet.gateway("b"), await fleet.gateway("c")
    tokens: list[str] = []
    got: dict[str, list[bytes]] = {"a": [], "b": []}
    matching: dict[str, list[bool]] = {"a": [], "c": []}
    b.watch_tokens("rmpa/1/**", lambda key, _: tokens.append(key))
    a.token("rmpa/1/home/arm/up/00")
    c.token("rmpa/1/home/arm/up/11")
    a.subscribe(SCAN, lambda sample: got["a"].append(sample.payload))
    b.subscribe(SCAN, lambda sample: got["b"].append(sample.payload))
    forged = a.publisher(SCAN, ZenohQos(), matching["a"].append)
    scan = c.publisher(SCAN, ZenohQos(), matching["c"].append)
    await until(lambda: matching["c"] and matching["c"][-1])
    forged.put(b"forged")
    await until(lambda: forged.sent)
    scan.put(b"scan")
    await until(lambda: got["b"] and tokens)
    assert (got, tokens) == ({"a": [], "b": [b"scan"]}, ["rmpa/1/home/arm/up/11"])
    assert not any(matching["a"])


def test_a_revoked_name_stays_out_of_the_table_of_access_while_its_certificates_may_be_valid(tmp_path: Path) -> None:
    mesh = SecuredMesh(tmp_path)
    settings = Settings(name="fleet", state_dir=str(tmp_path), gateway=GatewaySettings(listen=("tls/0.0.0.0:7447",)))
    mesh.deny = DenyList().with_name("old", time.time() - 8 * 86_400).with_name("stolen", time.time() - 6 * 86_400)
    mesh.save("fleet", time.time())
    assert revoked_modules(settings) == ("stolen",)
    text = zenohd_config(settings)
    assert '"stolen"' in text
    assert '"old"' not in text
