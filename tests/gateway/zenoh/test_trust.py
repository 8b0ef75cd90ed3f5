"""mTLS and Zenoh's table of access, by real routers and sessions with certificates of a mesh made for the test."""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.config.peer_rules import Effect, PermissionRule
from rmpa.config.rules import GatewaySettings
from rmpa.config.settings import Settings
from rmpa.core.errors import StartError
from rmpa.gateway.zenoh import config as trust
from rmpa.gateway.zenoh.config import revoked_modules, zenohd_config
from rmpa.gateway.zenoh.threads import ZenohQos
from rmpa.trust.certificates import DenyList
from tests.gateway.zenoh_bed import until
from tests.gateway.zenoh_fleet import Fleet
from tests.trust.io.member_files import SecuredMesh

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from rmpa.gateway.zenoh.queries import ArrivedQuery

zenoh = pytest.importorskip("zenoh")

SCAN = "rmpa/1/home/arm/t/sensor_msgs%LaserScan/scan"


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[Fleet]:
    made = Fleet(tmp_path)
    try:
        yield made
    finally:
        await made.close()


@pytest.mark.parametrize("default", ["deny", "allow"])
async def test_a_member_may_use_the_keys_of_sites_whatever_the_rules_of_names_say(fleet: Fleet, default: str) -> None:
    """Gateways judge names; a router with rules for modules only lets members in."""
    rule = PermissionRule(("a",), effect=Effect.DENY, names={"publish": ("/**",)})
    await fleet.router(rule, default=default)
    a, b = await fleet.gateway("a"), await fleet.gateway("b")
    tokens: list[str] = []
    got: list[bytes] = []
    late: list[bytes] = []
    b.watch_tokens("rmpa/1/**", lambda key, _: tokens.append(key))
    a.token("rmpa/1/home/arm/up/00")
    await until(lambda: tokens)
    b.subscribe(SCAN, lambda sample: got.append(sample.payload))
    other: list[bool] = []
    b.subscribe("plant/valve", lambda sample: other.append(True))
    matching: list[bool] = []
    scan = a.publisher(SCAN, ZenohQos(cache=1), matching.append)
    valve = a.publisher("plant/valve", ZenohQos(), lambda _: None)
    await until(lambda: matching and matching[-1])
    valve.put(b"open")
    await until(lambda: valve.sent)
    scan.put(b"scan")
    await until(lambda: got)
    b.subscribe(SCAN, lambda sample: late.append(sample.payload), history=True)
    await until(lambda: late)
    assert (got, late) == ([b"scan"], [b"scan"])

    def stop(query: ArrivedQuery) -> None:
        query.reply(query.key, b"stopped")
        query.finish()

    a.queryable("rmpa/1/home/arm/s/*/stop", stop)
    async with asyncio.timeout(20):
        while not (replies := await b.get("rmpa/1/home/arm/s/std_srvs%Trigger/stop", timeout=1.0)):
            await asyncio.sleep(0.02)
    assert [reply.payload for reply in replies] == [b"stopped"]
    assert bool(other) == (default == "allow"), "with deny, other programs' keys do not pass"


async def test_a_renewed_certificate_makes_a_listening_session_stale_and_a_connecting_one_not(fleet: Fleet) -> None:
    router, a = await fleet.router(default="allow"), await fleet.gateway("a")
    before = (router.stale, a.stale)
    fleet.mesh.save("fleet", time.time())
    fleet.mesh.save("a", time.time())
    assert (before, (router.stale, a.stale)) == ((False, False), (True, False))


async def test_the_file_for_zenohd_opens_a_router_that_enforces_the_same(fleet: Fleet, tmp_path: Path) -> None:
    gateway = GatewaySettings(listen=(fleet.endpoint,))
    text = zenohd_config(fleet.settings("fleet", gateway))
    file = tmp_path / "zenohd.json5"
    file.write_text(text)
    router = await asyncio.to_thread(lambda: zenoh.open(zenoh.Config.from_file(str(file))))
    try:
        a, b = await fleet.gateway("a"), await fleet.gateway("b")
        got: list[str] = []
        matching: list[bool] = []
        b.subscribe("rmpa/1/**", lambda sample: got.append(sample.key))
        b.subscribe("plant/**", lambda sample: got.append(sample.key))
        valve = a.publisher("plant/valve", ZenohQos(), lambda _: None)
        scan = a.publisher(SCAN, ZenohQos(), matching.append)
        await until(lambda: matching and matching[-1])
        valve.put(b"x")
        await until(lambda: valve.sent)
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


def test_a_revoked_name_stays_out_of_the_table_while_its_certificates_may_be_valid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = SecuredMesh(tmp_path)
    settings = Settings(name="fleet", state_dir=str(tmp_path), gateway=GatewaySettings(listen=("tls/0.0.0.0:7447",)))
    mesh.deny = DenyList().with_name("old", time.time() - 8 * 86_400).with_name("stolen", time.time() - 6 * 86_400)
    mesh.save("fleet", time.time())
    assert revoked_modules(settings) == ("stolen",)
    table, note = trust.access_table(settings)
    assert table["subjects"] == [{"id": "members"}]
    assert "stolen: revoked, and let in until the certificate ends" in note, "only the authority knows the others"
    assert f"// Note: {note}" in zenohd_config(settings)
    monkeypatch.setattr(trust, "known_modules", lambda _: ("arm", "fleet", "old", "stolen"))
    table, note = trust.access_table(settings)
    assert table["subjects"] == [{"id": "members", "cert_common_names": ["arm", "fleet", "old"]}]
    assert note == ""
