"""A module's name is said once: each command finds the same module, and none is less secure than it."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import socket
import ssl
import threading
from unittest import mock
from urllib.parse import urlsplit

import pytest

pytest.importorskip("cryptography")

from collections.abc import Callable
from pathlib import Path

from rmpa.discovery.network import list_interfaces
from rmpa.trust.permissions import host_names, page_hosts
from tests.cli.conftest import DEADLINE, Machine, free_port, until

RULES = """
[[permission]]
modules = ["*"]
effect = "deny"
subscribe = ["/secret"]
publish = ["/forged"]
"""


@pytest.fixture
def machine(machines: Callable[[str], Machine]) -> Machine:
    """A machine without any setting but where its files are: nothing but a command says a name."""
    return machines("")


def url_of(machine: Machine) -> str:
    """Where ``rmpa web`` said last that it is; empty: it has not yet."""
    lines = [line for line in machine.log("web").splitlines() if line.startswith('{"url"')]
    return str(json.loads(lines[-1])["url"]) if lines else ""


def serve_web(machine: Machine, *arguments: str) -> str:
    """Start ``rmpa web``, and wait until it says where it is."""
    machine.serve("web", "--json", *arguments)
    until(lambda: url_of(machine))
    return url_of(machine)


def end_agent(machine: Machine) -> None:
    machine.down()
    until(lambda: not machine.agents())


def test_the_first_start_names_the_machine(machine: Machine) -> None:
    machine.up("--name", "arm")
    end_agent(machine)
    machine.up("--name", "base", RMPA_NAME="other")  # not kept: there is one
    assert machine.agents() == {"base"}
    end_agent(machine)
    machine.up()
    assert machine.agents() == {"arm"}
    assert f"the module is arm, as at its first start ({machine.state / 'module-name'})" in machine.log()
    assert machine.status()["module"] == "arm"
    machine.up("--name", "second")
    assert machine.agents() == {"arm", "second"}
    assert machine.status()["module"] == "arm"  # of several the kept one
    (machine.state / "module-name").unlink()
    assert "several agents run on this machine: arm, second" in machine.says("trust", "status", code=1)


def test_a_second_module_does_not_name_the_machine(machine: Machine) -> None:
    machine.up(RMPA_NAME="base")
    machine.up("--name", "second")
    assert not (machine.state / "module-name").exists()


def test_what_has_joined_is_what_starts_next(machine: Machine) -> None:
    machine.up("--name", "trial")
    end_agent(machine)
    said = machine.says("trust", "init", "--name", "sec")
    assert "Next: rmpa up here" in said
    refused = machine.says("up", "--name", "trial", code=1)
    assert f"beside keys of sec here in {machine.state}; start as sec: --name sec" in refused
    assert "--insecure" in refused
    refused = machine.says("up", code=1, RMPA_STATE_DIR=str(machine.path / "other"))
    assert f"start with RMPA_STATE_DIR={machine.state} --name sec" in refused
    machine.up("--name", "trial", "--insecure")
    machine.up()
    assert machine.agents() == {"sec", "trial"}
    assert machine.status()["agent"] == "secured"
    assert machine.status("--name", "trial")["agent"] == "plain"


def test_an_authority_in_a_state_directory_of_its_own_is_not_forgotten(machine: Machine) -> None:
    data = str(machine.path / "data")
    machine.says("trust", "init", "--name", "sec", RMPA_STATE_DIR=data)
    assert f"start with RMPA_STATE_DIR={data} --name sec;" in machine.says("up", "--name", "sec", code=1)


@pytest.mark.parametrize(
    ("variable", "joined_with_it"),
    [("RMPA_STATE_DIR", True), ("RMPA_STATE_DIR", False), ("XDG_STATE_HOME", True), ("HOME", False)],
)
def test_no_variable_makes_a_start_miss_the_keys_of_this_user(
    machine: Machine, variable: str, joined_with_it: bool
) -> None:
    pytest.importorskip("aiohttp")
    pytest.importorskip("zenoh")
    machine.environ["TEST_HOME"] = str(machine.path)  # the user's home, wherever HOME leads
    elsewhere = {variable: str(machine.path / "elsewhere")}
    with mock.patch.dict(machine.environ, elsewhere if joined_with_it else {}):
        machine.says("trust", "init", "--name", "six")
        machine.says("trust", "init", "--name", "six_gateway")
    router = ("gateway", "--router", "--listen", f"tcp/127.0.0.1:{free_port()}")
    starts = ("up", "--name", "six"), ("up", "--name", "other"), (*router, "--name", "six_gateway"), ("web",)
    with mock.patch.dict(machine.environ, {} if joined_with_it else elsewhere):
        status = machine.says("trust", "status", "--name", "six")
        assert "trust is off: six" in status
        assert "six, six_gateway; RMPA_STATE_DIR=" in status
        for words in starts:
            assert "would start without trust, beside keys of six, six_gateway in" in machine.says(*words, code=1)


def test_a_join_says_where_no_note_of_it_can_be_kept(machine: Machine) -> None:
    (machine.path / "file").write_text("")
    machine.environ["TEST_HOME"] = str(machine.path / "file")
    said = machine.says("trust", "init", "--name", "six")
    assert f"a start without RMPA_STATE_DIR={machine.state} will miss these keys: {machine.path}/file/" in said
    assert "write require = true into [trust]" in said


def test_a_gateway_is_no_less_secure_than_the_agent_beside_it(machine: Machine) -> None:
    pytest.importorskip("zenoh")
    machine.says("trust", "init", "--name", "sec")
    machine.up(RMPA_STATE_DIR=str(machine.state))
    gateway = ("gateway", "--router", "--listen", f"tcp/127.0.0.1:{free_port()}")
    refused = machine.says(*gateway, code=1)
    assert "the gateway sec_gateway: has no keys, beside the agent sec in a secured mesh" in refused
    assert "rmpa trust join TOKEN --name sec_gateway; or say --insecure" in refused
    # Also where nothing of the agent's files is seen.
    other = {"HOME": "/nonexistent", "RMPA_STATE_DIR": str(machine.path / "gw")}
    assert "beside the agent sec" in machine.says(*gateway, code=1, **other)


def test_a_gateway_without_keys_ends_when_a_secured_agent_starts_beside_it(machine: Machine) -> None:
    pytest.importorskip("zenoh")
    other = {"HOME": "/nonexistent", "RMPA_STATE_DIR": str(machine.path / "gw")}
    net = ("--interface", "lo", "--multicast", f"239.255.117.118:{free_port()}")
    gateway = machine.serve("gateway", "--router", "--listen", f"tcp/127.0.0.1:{free_port()}", *net, **other)
    until(machine.agents)
    machine.says("trust", "init", "--name", "sec")
    machine.up()
    assert gateway.wait(DEADLINE) == 1
    assert "has no keys, beside the agent sec in a secured mesh; let it join" in machine.log("gateway")


def test_a_gateway_does_not_start_beside_an_agent_that_does_not_say_whether_it_is_secured(machine: Machine) -> None:
    pytest.importorskip("zenoh")
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(str(machine.path / "mute.sock"))
        mute.listen()

        def hang_up() -> None:
            with contextlib.suppress(OSError):
                while True:
                    mute.accept()[0].close()

        thread = threading.Thread(target=hang_up)
        thread.start()
        try:
            said = machine.says("gateway", "--router", "--listen", f"tcp/127.0.0.1:{free_port()}", code=1)
        finally:
            mute.shutdown(socket.SHUT_RDWR)
            thread.join()
    assert "mute.sock" in said


def test_the_web_server_is_as_secure_as_the_agent_whatever_their_names(machine: Machine) -> None:
    pytest.importorskip("aiohttp")
    (machine.path / "agents.toml").write_text(RULES)
    machine.up("--name", "sec", "--config", "agents.toml")
    url = serve_web(machine, "--control", "--listen", "127.0.0.1", "--port", str(free_port()))
    assert url.startswith("http://")
    # The agent comes back secured: the server is made anew, with its certificate and its permissions.
    machine.says("trust", "init")
    end_agent(machine)
    machine.up("--config", "agents.toml")
    until(lambda: url_of(machine).startswith("https://"))
    ca = machine.state / "sec/trust/ca.crt"
    token = (machine.state / "sec/web-token").read_text().strip()
    statuses = asyncio.run(_statuses(ca, urlsplit(url_of(machine)).port or 0, token))
    assert [("web may not" in text) for text in statuses] == [True, True], statuses
    assert "no [[permission]] lets web do anything: its clients see names alone" in machine.log("web")
    # A browser that knows the CA opens the page by each name and address of this machine.
    addresses = [str(address) for interface in list_interfaces() for address in interface.addresses]
    hosts = page_hosts((*host_names(socket.gethostname()), *sorted(addresses)))
    port = urlsplit(url_of(machine)).port or 0
    for host in ("sec", "sec.local", "localhost", "127.0.0.1", *hosts):
        until(functools.partial(_accepts, ca, port, host))
    assert not _accepts(ca, port, "other.local")


def test_the_web_server_of_one_agent_does_not_show_a_secured_one_that_takes_over_its_core(machine: Machine) -> None:
    pytest.importorskip("aiohttp")
    core = ("--core-port", str(free_port()))
    machine.up("--name", "open", *core)
    port = str(free_port())
    server = machine.serve("web", "--json", "--agent", "open", "--port", port)
    until(lambda: _asked(port) and "the agent open answers" in machine.log("web"))
    end_agent(machine)
    machine.says("trust", "init", "--name", "sec")
    machine.up(*core)
    assert server.wait(DEADLINE) == 1
    assert "the module open: has no keys, and would start without trust, beside keys of sec" in machine.log("web")


def _asked(port: str) -> bool:
    """Whether the server was asked for the agent's state: it looks for it then."""
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", int(port)), DEADLINE) as client:
        client.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        return bool(client.recv(64))
    return False


def _accepts(ca: Path, port: int, host: str) -> bool:
    """Whether a client that knows the CA finds the server to be that host, and is served by that name."""
    trust = ssl.create_default_context(cafile=str(ca))
    try:
        with (
            socket.create_connection(("127.0.0.1", port), DEADLINE) as plain,
            trust.wrap_socket(plain, server_hostname=host) as secured,
        ):
            secured.sendall(f"GET /healthz HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
            return secured.recv(64).startswith(b"HTTP/1.1 200")
    except ssl.SSLCertVerificationError:
        return False


async def _statuses(ca: Path, port: int, token: str) -> list[str]:
    """What a rosbridge client is told that reads and forges topics which the agent's rules deny."""
    import aiohttp

    trust = ssl.create_default_context(cafile=str(ca))
    url = f"https://127.0.0.1:{port}/?token={token}"
    async with aiohttp.ClientSession() as session, session.ws_connect(url, ssl=trust) as client:
        await client.send_json({"op": "subscribe", "topic": "/secret", "type": "std_msgs/String"})
        await client.send_json({"op": "advertise", "topic": "/forged", "type": "std_msgs/String"})
        told = [(await client.receive_json(timeout=DEADLINE))["msg"] for _ in range(2)]
    await asyncio.sleep(0.25)  # a TLS connection of aiohttp ends a little after its session, as its manual says
    return told


def test_the_web_server_without_an_agent_is_that_of_the_module_with_keys(machine: Machine) -> None:
    pytest.importorskip("aiohttp")
    assert "has joined no secured mesh" in machine.says("web", code=1, RMPA_TRUST_REQUIRE="1")
    machine.says("trust", "init", "--name", "sec")
    assert serve_web(machine, "--port", str(free_port())).startswith("https://")
    refused = machine.says("web", "--agent", "other", code=1)
    assert "start as sec: --agent sec" in refused
    assert "the module other: has no keys, and would start without trust, beside keys of sec" in refused
