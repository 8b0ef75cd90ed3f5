"""Attacks on ``rmpa web`` from another host, and by what others write: all are refused and counted, none disturbs."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from collections import Counter
from collections.abc import AsyncIterator
from typing import Final
from urllib.parse import quote

import aiohttp
import msgspec
import pytest

from lab.bed.chromium import Chromium
from lab.bed.http_client import http_client
from lab.bed.namespaces import Host, Lab
from lab.bed.processes import DEADLINE
from rmpa.ros.types.descriptor import Descriptor, ParameterDescriptor, ProfileDescriptor
from rmpa.web import limits
from rmpa.web.monitor import limits as monitor_limits
from rmpa.web.monitor.messages import SUBPROTOCOL
from tests.interop.conftest import AgentFactory, ModuleFactory, WebFactory
from tests.interop.ros import PYTHON
from tests.interop.web import REFUSED, Monitor, Web, needs_browser

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(150)]

PATHS: Final = ("/", "/static/app.js", "/metrics", "/api/v1/snapshot", "/nothing")
# WebSocket paths, with the subprotocols that their clients offer.
SOCKETS: Final = {"/": (), "/rosbridge": (), "/foxglove": ("foxglove.websocket.v1",), "/monitor": (SUBPROTOCOL,)}


def attacks(web: Web) -> list[tuple[dict[str, str], str, int, str]]:
    """Headers, the query, and the status and the reason of the refusal."""
    evil, wrong = "http://evil.example", "x" * len(web.token)
    return [
        (web.bearer | {"Origin": evil}, "", 403, "origin"),
        (web.bearer | {"Origin": "null"}, "", 403, "origin"),
        (web.bearer | {"Origin": f"http://{web.host}.evil.example"}, "", 403, "origin"),
        (web.bearer | {"Origin": f"http://{web.host.partition(':')[0]}:80"}, "", 403, "origin"),
        (web.bearer | {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "cors"}, "", 403, "origin"),
        (web.bearer | {"Host": "evil.example"}, "", 403, "host"),
        (web.bearer | {"Host": "evil.example:8480", "Origin": "http://evil.example:8480"}, "", 403, "host"),
        ({}, "", 401, "token"),
        ({"Authorization": f"Bearer {wrong}"}, "", 401, "token"),
        ({"Authorization": f"Basic {web.token}"}, "", 401, "token"),
        ({"Cookie": f"rmpa_token_8480={wrong}"}, "", 401, "token"),
        ({}, f"?token={wrong}", 401, "token"),
        ({}, "?token=", 401, "token"),
    ]


async def test_who_is_not_allowed_gets_nothing_at_any_path(lab: Lab, agent: AgentFactory, web: WebFactory) -> None:
    base, mallory = lab.hosts("base", "mallory")
    served = web(agent(base, name="base"), "--control", "--drive")
    expected: Counter[str] = Counter()
    async with http_client(mallory) as http:
        for headers, query, status, reason in attacks(served):
            for path in PATHS:
                async with http.get(f"{served.url}{path}{query}", headers=headers, allow_redirects=False) as response:
                    assert response.status == status, (path, headers, query)
                    assert b"base" not in await response.read()
            for path, protocols in SOCKETS.items():
                with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                    await http.ws_connect(f"ws://{served.host}{path}{query}", protocols=protocols, headers=headers)
                assert refused.value.status == status, (path, headers, query)
            expected[reason] += len(PATHS) + len(SOCKETS)
        # The same requests, allowed: it was the attack that was refused.
        own = served.bearer | {"Origin": served.url, "Sec-Fetch-Site": "same-origin"}
        for path in PATHS:
            async with http.get(f"{served.url}{path}", headers=own) as response:
                assert response.status == (404 if path == "/nothing" else 200)
        for path, protocols in SOCKETS.items():
            async with http.ws_connect(f"ws://{served.host}{path}", protocols=protocols, headers=own) as socket:
                assert socket.protocol == (protocols[0] if protocols else None)
        await served.wait_counts(http, REFUSED, "reason", lambda found: found == expected)


# --- frames ---------------------------------------------------------------------------------------------------------

MASK: Final = bytes(4)
TEXT, BINARY, CLOSE = 1, 2, 8
# Frames that RFC 6455 forbids, with the close code that it wants.
BROKEN: Final = {
    "reserved bits": (b"\xf1\x80" + MASK, 1002),
    "an unknown opcode": (b"\x83\x80" + MASK, 1002),
    "a ping in pieces": (b"\x09\x80" + MASK, 1002),
    "a ping that is too long": (b"\x89\xfe\x00\x7e" + MASK + bytes(126), 1002),
    "the continuation of nothing": (b"\x80\x80" + MASK, 1002),
    "text that is no UTF-8": (b"\x81\x82" + MASK + b"\xff\xfe", 1007),
}
# The header of a frame of 1 TiB.
HUGE: Final = b"\x81\xff" + struct.pack("!Q", 1 << 40) + MASK
# Texts that are no message of a page.
NO_REQUESTS: Final = ("{", "[]", '{"op": "shutdown"}', '{"op": "ask", "id": 1, "what": ["why"]}', "[" * 60_000)


def frame(text: str) -> bytes:
    """A client's text frame."""
    data = text.encode()
    size = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xff" + struct.pack("!Q", len(data))
    return b"\x81" + size + MASK + data


class RawSocket:
    """A WebSocket client that writes any bytes."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self.writer = writer

    async def close_code(self) -> int:
        """The code of the server's close frame; all other frames are skipped."""
        async with asyncio.timeout(DEADLINE):
            while True:
                first, size = await self._reader.readexactly(2)
                if size == 126:
                    (size,) = struct.unpack("!H", await self._reader.readexactly(2))
                elif size == 127:
                    (size,) = struct.unpack("!Q", await self._reader.readexactly(8))
                payload = await self._reader.readexactly(size)
                if first & 0xF == CLOSE:
                    return int.from_bytes(payload[:2])

    async def status(self) -> int:
        """The status of an HTTP response, whose headers are read."""
        async with asyncio.timeout(DEADLINE):
            head = await self._reader.readuntil(b"\r\n\r\n")
        return int(head.split()[1])

    async def closed(self, timeout: float = DEADLINE) -> bytes:
        """What the server still sends until it closes the connection."""
        async with asyncio.timeout(timeout):
            with contextlib.suppress(ConnectionError):
                return await self._reader.read()
        return b""


@contextlib.asynccontextmanager
async def connected(host: Host, web: Web) -> AsyncIterator[RawSocket]:
    """A TCP connection from a host."""
    sock = host.open_socket()
    sock.setblocking(False)
    address, _, port = web.host.partition(":")
    try:
        await asyncio.get_running_loop().sock_connect(sock, (address, int(port)))
        reader, writer = await asyncio.open_connection(sock=sock)
    except BaseException:
        sock.close()
        raise
    try:
        yield RawSocket(reader, writer)
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


def handshake(web: Web, path: str, *further: str, key: str = "dGhlIHNhbXBsZSBub25jZQ==") -> bytes:
    """The request for a WebSocket, with the token."""
    lines = [f"GET {path} HTTP/1.1", f"Host: {web.host}", *(f"{name}: {value}" for name, value in web.bearer.items())]
    lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}"]
    lines += [f"Sec-WebSocket-Protocol: {name}" for name in SOCKETS[path]]
    return "\r\n".join([*lines, *further, "", ""]).encode()


async def after(host: Host, web: Web, path: str, data: bytes) -> int:
    """The close code that a client gets who sends these bytes."""
    async with connected(host, web) as socket:
        socket.writer.write(handshake(web, path))
        assert await socket.status() == 101
        socket.writer.write(data)
        return await socket.close_code()


async def test_broken_and_oversized_frames_end_their_client_alone(
    lab: Lab, agent: AgentFactory, web: WebFactory
) -> None:
    base, mallory, tablet = lab.hosts("base", "mallory", "tablet")
    served = web(agent(base, name="base"), "--control")
    expected: Counter[str] = Counter()

    async def attack(path: str, data: bytes, code: int, reason: str) -> None:
        assert await after(mallory, served, path, data) == code, (path, data[:40])
        expected[reason] += 1

    async with (
        http_client(tablet) as http,
        served.monitor(http) as monitor,
        served.rosbridge(http) as bridge,
    ):
        for path in SOCKETS:
            tasks = [attack(path, data, code, "message") for data, code in BROKEN.values()]
            await asyncio.gather(*tasks, attack(path, HUGE, 1009, "message_size"))
        pieces = b"\x01\x80" + MASK + b"".join(b"\x00\xfe\x10\x00" + MASK + bytes(4096) for _ in range(17))
        spaces = frame(" " * (monitor_limits.REQUEST_MAX + 1))
        flood = frame('{"op": "ack", "n": 0}') * (int(monitor_limits.REQUEST_BURST) + 100)
        await asyncio.gather(
            *(attack("/monitor", frame(text), 1008, "message") for text in NO_REQUESTS),
            attack("/monitor", pieces, 1009, "message_size"),
            attack("/monitor", spaces, 1009, "message_size"),
            attack("/monitor", flood, 1008, "message_rate"),
        )
        # What the attacker sends behind the message for which it is closed is not done.
        behind = frame("{") + frame('{"op": "ask", "id": 1, "what": "set_param", "args": {"name": "/x", "value": 1}}')
        await attack("/monitor", behind, 1008, "message")

        await served.wait_counts(http, REFUSED, "reason", lambda found: found == expected)
        await still_served(monitor)
        assert "x" not in (await monitor.answered("params", peer=""))["values"]
        await bridge.send("call_service", service="/rosapi/get_time", id="1")
        assert (await bridge.next("service_response"))["result"] is True
        clients = {"monitor": 1, "rosbridge": 1}
        await served.wait_counts(http, "rmpa_web_clients", "protocol", lambda found: found == clients)
    assert "Traceback" not in served.process.output
    assert "more than 50 messages a second" in served.process.output


async def still_served(monitor: Monitor) -> None:
    """Fail unless a page gets the state and answers."""
    await monitor.send("look", at=[["counters", ""]])
    while "counters:" not in monitor.state.get("detail", {}):
        await monitor.next("patch")
    assert (await monitor.answered("why", kind="topic", name="/nothing"))[0]["flows"] is False


# --- slow handshakes -----------------------------------------------------------------------------------------------

SLOW: Final = limits.WEB_CONNECTIONS_MAX + 50


async def test_slow_and_broken_handshakes_keep_no_page_out(lab: Lab, agent: AgentFactory, web: WebFactory) -> None:
    base, mallory, tablet = lab.hosts("base", "mallory", "tablet")
    served = web(agent(base, name="base"))

    async def trickle(socket: RawSocket, data: bytes) -> None:
        """A byte now and then, for longer than a request may take."""
        with contextlib.suppress(ConnectionError):
            for byte in data:
                socket.writer.write(bytes([byte]))
                await asyncio.sleep(0.5)

    async with contextlib.AsyncExitStack() as stack:
        http = await stack.enter_async_context(http_client(tablet))
        before = await stack.enter_async_context(served.monitor(http))
        slow = [await stack.enter_async_context(connected(mallory, served)) for _ in range(SLOW)]
        request = handshake(served, "/monitor")
        # Where a handshake fails, the connection stays, with the limits of every other.
        for faulty in (handshake(served, "/monitor", key="short"), request.replace(SUBPROTOCOL.encode(), b"chat")):
            slow.append(await stack.enter_async_context(connected(mallory, served)))
            slow[-1].writer.write(faulty)
            assert await slow[-1].status() == 400
        endless = request[:-2] + b"A: b\r\n" * 1000
        trickling = [asyncio.create_task(trickle(socket, endless)) for socket in slow]
        try:
            async with served.monitor(http) as newcomer:
                await still_served(newcomer)
            await still_served(before)
            closed = await asyncio.gather(*(socket.closed(limits.WEB_REQUEST_TIMEOUT + DEADLINE) for socket in slow))
        finally:
            for task in trickling:
                task.cancel()
            await asyncio.wait(trickling)
        assert not any(b"101" in data for data in closed)
        await still_served(before)
        found = await served.counts(http, REFUSED, "reason")
        assert found["handshake"] == 2
        assert found["slow_request"] + found["connections"] == len(slow)
        assert found["connections"] >= len(slow) - limits.WEB_CONNECTIONS_MAX


# --- what others write ---------------------------------------------------------------------------------------------

EVIL: Final = "<img src=x onerror=alert(1)>"
# A name that a master accepts: it has no space and no colon.
EVIL_NAME: Final = "/<img/src=x/onerror=alert(1)>"
LINK: Final = "javascript:alert(1)"
REGISTER: Final = """
import os, sys, xmlrpc.client
evil, name, link, here = sys.argv[1:]
master = xmlrpc.client.ServerProxy(os.environ["ROS_MASTER_URI"])
me = "/<svg/onload=alert(1)>"
for done in (
    master.registerPublisher(me, name, evil + "/x", here),
    master.registerSubscriber(me, name, evil + "/x", here),
    master.registerService(me, name + "/service", "rosrpc://127.0.0.1:9", here),
    master.setParam(me, name, evil),
    master.setParam(me, "/links", {evil: link, "here": [link, {link: evil}]}),
):
    assert done[0] == 1, done
"""
# Elements that none of the pages has by itself.
MARKUP: Final = "img[src=x], svg[onload], [onerror], b#owned, a[href^='javascript:' i], script:not([src])"


def evil_resource() -> str:
    """The descriptor of a Smart Resource whose every text is markup."""
    profile = ProfileDescriptor(name=EVIL, offers={EVIL: EVIL}, description=EVIL)
    parameter = ParameterDescriptor(name=EVIL, type=EVIL, default=LINK, unit=EVIL, description=LINK)
    made = Descriptor(
        name=EVIL,
        node=LINK,
        role=EVIL,
        physical=False,
        description=EVIL,
        profiles=(profile,),
        parameters=(parameter,),
    )
    return msgspec.json.encode(made).decode()


@needs_browser
async def test_names_and_values_of_others_are_shown_as_text(
    lab: Lab, modules: ModuleFactory, web: WebFactory
) -> None:
    base, arm = modules("base", "arm")
    served = web(base.agent, "--control")
    clerk, words, resource = tellers = [
        module.ros.rospy("text_teller", topic=topic, commands=True, latch=True)
        for module, topic in ((base, "/silent"), (arm, "/words"), (arm, "/evil/descriptor"))
    ]
    switch = arm.ros.rospy("switch", name="switch", fail=f"{EVIL} {LINK}")
    await asyncio.gather(*(node.expect_event("up") for node in (*tellers, switch)))
    (up,) = clerk.events("up")
    clerk.tell(json.dumps({"log": f"{EVIL} {LINK}"}))
    words.tell(json.dumps({"data": f"{EVIL} {LINK}"}))
    resource.tell(json.dumps({"data": evil_resource()}))
    await asyncio.to_thread(base.ros.tool, PYTHON, "-c", REGISTER, EVIL, EVIL_NAME, LINK, str(up["uri"]))
    async with Chromium(lab.host("tablet", 0)) as page:
        watch = (
            "document.addEventListener('securitypolicyviolation', (event) => console.error(event.violatedDirective))"
        )
        await page.send("Page.addScriptToEvaluateOnNewDocument", source=watch)
        await served.open(page)

        async def shows(address: str, title: str, *texts: str, click: str = "") -> None:
            await page.run(f"location.hash = {json.dumps('#/' + address)}")
            await page.wait(f"document.querySelector('h1').textContent === {json.dumps(title)}")
            if click:
                await page.click(click)
            for text in texts:
                await page.wait_text(text)
            assert await page.run(f"document.querySelectorAll({json.dumps(MARKUP)}).length") == 0, address

        await shows("topics", "Topics", EVIL_NAME, f"{EVIL}/x")
        await shows(f"topic/{quote(EVIL_NAME, safe='')}", EVIL_NAME, f"{EVIL}/x")
        await shows(f"topic/{quote(EVIL_NAME, safe='')}", EVIL_NAME, "is not a topic's name", click="On")
        await shows("topic/%2Fwords", "/words", f"{EVIL} {LINK}", click="On")
        await shows("services", "Services", f"{EVIL_NAME}/service")
        await shows("service/arm%3A%2Fswitch", "/switch", f"{EVIL} {LINK}", click="Call it")
        await shows("params", "Parameters", EVIL, f'"{LINK}"')
        await shows("resources", "Smart Resources", EVIL)
        await shows("resource/arm%3A%2Fevil", "/evil", EVIL, LINK)
        await shows("log", "Log", f"{EVIL} {LINK}")
        await shows("alarms", "Alarms", "All that is wrong")
        await shows("module/base", "base", EVIL_NAME)
        await shows("", "Mesh", "Modules")
        await page.press("/")
        await page.wait("document.activeElement.type === 'search'")
        await page.send("Input.insertText", text="<img")
        await page.wait("document.querySelector('.found')?.innerText.includes('<img/src=x')")
        assert await page.run(f"document.querySelectorAll({json.dumps(MARKUP)}).length") == 0
        assert page.errors == []
