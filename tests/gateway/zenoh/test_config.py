"""The configuration of a session: endpoints, sockets, certificates."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rmpa.config.peer_rules import Effect, PermissionRule
from rmpa.config.rules import GatewaySettings
from rmpa.config.settings import Settings
from rmpa.core.errors import StartError
from rmpa.gateway.zenoh.config import bound_unsent, gateway_config, session_config, zenohd_config
from rmpa.gateway.zenoh.session import ArrivedQuery
from rmpa.gateway.zenoh.threads import ZenohQos
from rmpa.trust.certificates import DenyList
from rmpa.trust.store import CA
from tests.gateway.memory_zenoh import eventually
from tests.gateway.zenoh_bed import put
from tests.gateway.zenoh_fleet import Fleet
from tests.trust.io.member_files import SecuredMesh

FILES = Path("trust")


@pytest.mark.parametrize(
    ("settings", "mode"),
    [
        (GatewaySettings(connect=("tls/fleet.example:7447",)), "client"),
        (GatewaySettings(connect=("tls/fleet.example:7447",), listen=("tls/0.0.0.0:7447",)), "peer"),
        (GatewaySettings(listen=("tls/0.0.0.0:7447",), router=True), "router"),
    ],
)
def test_what_only_connects_is_a_client_so_that_it_works_behind_nat(settings: GatewaySettings, mode: str) -> None:
    config = gateway_config(settings, FILES)
    assert config.mode is mode
    tls = config.entries()["transport/link/tls"]
    assert isinstance(tls, dict)
    assert (tls["enable_mtls"], tls["root_ca_certificate"]) == (True, str(FILES / CA))


@pytest.mark.parametrize(
    ("endpoint", "certificates", "why", "remedy"),
    [
        ("tcp/10.0.0.1:7447", None, "tcp is not encrypted", "tls/10.0.0.1:7447, or say --insecure"),
        ("tcp/10.0.0.1:7447", FILES, "tcp is not encrypted", "write tls/10.0.0.1:7447"),
        ("tls/10.0.0.1:7447", None, "joined no secured mesh", "rmpa trust join"),
        ("tcp/0.0.0.0:7447", None, "tcp is not encrypted", "--insecure"),
    ],
)
def test_an_endpoint_that_is_not_secure_is_refused_and_named(
    endpoint: str, certificates: Path | None, why: str, remedy: str
) -> None:
    for settings in (GatewaySettings(connect=(endpoint,)), GatewaySettings(listen=(endpoint,))):
        with pytest.raises(StartError) as refused:
            gateway_config(settings, certificates)
        assert endpoint in str(refused.value)
        assert why in refused.value.problem
        assert remedy in refused.value.remedy
        assert refused.value.code == ("invalid-value" if certificates else "not-a-member")


@pytest.mark.parametrize("endpoint", ["tcp/localhost:7447", "tcp/127.0.0.1:7447", "tcp/[::1]:7447#iface=lo"])
def test_loopback_needs_no_certificate(endpoint: str) -> None:
    assert gateway_config(GatewaySettings(connect=(endpoint,)), None).certificates is None


@pytest.mark.parametrize(
    ("uplink", "buffer", "batch"), [(125_000, 15_625, 7812), (1000, 4096, 2048), (100_000_000, 12_500_000, 65_535)]
)
def test_a_thin_line_gets_small_buffers_below_the_priorities(uplink: int, buffer: int, batch: int) -> None:
    config = gateway_config(GatewaySettings(connect=("tls/10.0.0.1:7447",), uplink=uplink), FILES)
    entries = config.entries()
    assert entries["transport/link/tcp/so_sndbuf"] == entries["transport/link/tls/so_sndbuf"] == buffer
    assert entries["transport/link/tx/batch_size"] == batch
    tls = entries["transport/link/tls"]
    assert isinstance(tls, dict)
    assert tls["enable_mtls"] is True
    assert list(entries).index("transport/link/tls") < list(entries).index("transport/link/tls/so_sndbuf")


def test_insecure_lets_everything_connect() -> None:
    settings = GatewaySettings(connect=("tcp/10.0.0.1:7447",), insecure=True)
    assert "transport/link/tls" not in gateway_config(settings, None).entries()


UNSENT = 20_000


def unsent(sock: socket.socket) -> int:
    return sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT)


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket, str]]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as ours, server.accept()[0] as theirs:
            yield ours, theirs, f"tcp/127.0.0.1:{port}"


def test_the_connection_to_an_endpoint_is_bounded(ends: tuple[socket.socket, socket.socket, str]) -> None:
    ours, theirs, endpoint = ends
    before = unsent(theirs)
    assert bound_unsent([endpoint], UNSENT) == 1
    assert (unsent(ours), unsent(theirs)) == (UNSENT, before)


@pytest.mark.parametrize("odd", ["udp/127.0.0.1:{}", "tcp/127.0.0.1", "", "tcp/[::1]:{}", "tcp/127.0.0.2:{}"])
def test_other_endpoints_leave_it_alone(ends: tuple[socket.socket, socket.socket, str], odd: str) -> None:
    ours, _, endpoint = ends
    before = unsent(ours)
    assert bound_unsent([odd.format(endpoint.rpartition(":")[2])], UNSENT) == 0
    assert unsent(ours) == before


zenoh = pytest.importorskip("zenoh")


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[Fleet]:
    made = Fleet(tmp_path)
    yield made
    await made.close()


@pytest.fixture
async def fleet_router(fleet: Fleet, tmp_path: Path, request: pytest.FixtureRequest) -> AsyncIterator[bool]:
    """A router, by its rules or as zenohd by the file for it; whether it passes on the keys of other programs too."""
    if request.param != "zenohd":
        rule = PermissionRule(("a",), effect=Effect.DENY, names={"publish": ("/**",)})
        await fleet.router(rule, default=request.param)
        yield request.param == "allow"
        return
    file = tmp_path / "zenohd.json5"
    file.write_text(zenohd_config(fleet.settings("fleet", GatewaySettings(listen=(fleet.endpoint,)))))
    router = await asyncio.to_thread(lambda: zenoh.open(zenoh.Config.from_file(str(file))))
    yield False
    await asyncio.to_thread(router.close)


@pytest.mark.parametrize(
    ("fleet_router", "key"),
    [("deny", "to/hall/t/a%B/scan"), ("allow", "t/a%B/scan"), ("zenohd", "t/a%B/scan")],
    indirect=["fleet_router"],
)
async def test_a_member_may_use_the_keys_of_sites_whatever_the_rules_of_names_say(
    fleet: Fleet, fleet_router: bool, key: str
) -> None:
    """Gateways judge names; a router with rules for modules only lets members in."""
    a, b, key = await fleet.gateway("a"), await fleet.gateway("b"), f"rmpa/1/home/arm/{key}"
    heard: dict[str, list[object]] = {what: [] for what in ("token", "scan", "late", "valve", "matching")}
    b.watch_tokens("rmpa/1/**", lambda key, _: heard["token"].append(key))
    a.token("rmpa/1/home/arm/up/00")
    await eventually(lambda: heard["token"])
    b.subscribe(key, lambda sample: heard["scan"].append(sample.payload))
    b.subscribe("plant/valve", lambda sample: heard["valve"].append(sample.payload))
    scan = a.publisher(key, ZenohQos(cache=1), heard["matching"].append)
    valve = a.publisher("plant/valve", ZenohQos(), lambda _: None)
    await eventually(lambda: True in heard["matching"])
    put(valve, b"open")
    await eventually(lambda: valve.sent)
    put(scan, b"scan")
    await eventually(lambda: heard["scan"])
    b.subscribe(key, lambda sample: heard["late"].append(sample.payload), history=True)
    await eventually(lambda: heard["late"])
    assert (heard["scan"], heard["late"]) == ([b"scan"], [b"scan"])
    assert bool(heard["valve"]) == fleet_router, "with deny, other programs' keys do not pass"

    def stop(query: ArrivedQuery) -> None:
        query.reply(b"stopped")

    a.queryable("rmpa/1/home/arm/s/*/stop", stop)
    async with asyncio.timeout(20):
        while not (replies := await b.get("rmpa/1/home/arm/s/std_srvs%Trigger/stop", timeout=1.0)):
            await asyncio.sleep(0.02)
    assert [reply.payload for reply in replies] == [b"stopped"]


async def test_a_renewed_certificate_makes_a_listening_session_stale_and_a_connecting_one_not(fleet: Fleet) -> None:
    router, a = await fleet.router(default="allow"), await fleet.gateway("a")
    before = (router.stale, a.stale)
    fleet.mesh.save("fleet", time.time())
    fleet.mesh.save("a", time.time())
    assert (before, (router.stale, a.stale)) == ((False, False), (True, False))


def test_the_file_for_zenohd_needs_certificates_or_says_that_it_is_insecure(tmp_path: Path) -> None:
    settings = Settings(name="fleet", state_dir=str(tmp_path))
    with pytest.raises(StartError, match=r"tls/0\.0\.0\.0:7447"):
        zenohd_config(settings)
    text = zenohd_config(replace(settings, gateway=GatewaySettings(insecure=True, listen=("tcp/0.0.0.0:7447",))))
    assert "// INSECURE" in text
    assert json.loads(text[text.index("{") :])["listen"]["endpoints"] == ["tcp/0.0.0.0:7447"]


def test_a_revoked_name_stays_out_of_the_table_while_its_certificates_may_be_valid(tmp_path: Path) -> None:
    mesh = SecuredMesh(tmp_path)
    settings = Settings(name="hall", state_dir=str(tmp_path), gateway=GatewaySettings(listen=("tls/0.0.0.0:7447",)))

    def subjects() -> object:
        mesh.save("hall", time.time())
        table = session_config(settings).access_control
        return None if table is None else table["subjects"]

    assert subjects() == [{"id": "members"}]
    mesh.deny = DenyList(members=("arm", "hall", "old")).with_name("old", time.time() - 8 * 86_400)
    assert subjects() == [{"id": "members"}], "its certificates have ended"
    mesh.deny = mesh.deny.with_name("stolen", time.time() - 6 * 86_400)
    assert subjects() == [{"id": "members", "cert_common_names": ["arm", "hall"]}]
    mesh.deny = DenyList().with_name("stolen", time.time())
    assert subjects() == [{"id": "members", "cert_common_names": ["hall"]}], (
        "a list that names no member lets none in"
    )


async def test_a_listener_that_is_no_authority_refuses_what_was_revoked_and_lets_the_others_in(fleet: Fleet) -> None:
    """A certificate of the CA passes TLS; by the table of access the revoked one hears nothing."""
    names = ("fleet", "a", "b", "later")
    fleet.mesh.deny = DenyList(members=names).with_name("b", time.time())
    await fleet.router()
    a, b, later = [await fleet.gateway(name) for name in names[1:]]
    heard: dict[str, list[object]] = {name: [] for name in names}
    b.subscribe("rmpa/1/**", lambda sample: heard["b"].append(sample.payload), history=True)
    b.watch_tokens("rmpa/1/**", lambda key, _: heard["b"].append(key))
    later.subscribe("rmpa/1/**", lambda sample: heard["later"].append(sample.payload), history=True)
    later.watch_tokens("rmpa/1/**", lambda key, _: heard["later"].append(key))
    matching: list[bool] = []
    scan = a.publisher("rmpa/1/home/arm/t/a%B/scan", ZenohQos(cache=1), matching.append)
    a.token("rmpa/1/home/arm/up/00")
    await eventually(lambda: True in matching)
    put(scan, b"scan")
    await eventually(lambda: {b"scan", "rmpa/1/home/arm/up/00"} <= {*heard["later"]})
    assert heard["b"] == []
    # What it sends goes nowhere either.
    forged: list[object] = []
    a.subscribe("rmpa/1/home/arm/t/a%B/forged", lambda sample: forged.append(sample.payload))
    sent = b.publisher("rmpa/1/home/arm/t/a%B/forged", ZenohQos(), lambda _: None)
    proof = later.publisher("rmpa/1/home/arm/t/a%B/forged", ZenohQos(), lambda _: None)
    put(sent, b"forged")
    await eventually(lambda: sent.sent)

    def arrived() -> bool:
        put(proof, b"proof")
        return b"proof" in forged

    await eventually(arrived)
    assert b"forged" not in forged
