"""Access: tokens, and what is refused to a client."""

from __future__ import annotations

import asyncio
import json
import os
import stat
import struct
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, Self

import aiohttp
import pytest
from multidict import CIMultiDict

from rmpa.config.peer_rules import Effect, PermissionRule
from rmpa.config.settings import TrustSettings, WebSettings
from rmpa.core.errors import StartError
from rmpa.trust.permissions import Permissions
from rmpa.web import api
from rmpa.web.foxglove import session as foxglove
from rmpa.web.foxglove.protocol import SUBPROTOCOLS
from rmpa.web.hub.node_link import EVERYTHING, NodeRules
from rmpa.web.monitor import session as monitor
from rmpa.web.monitor.questions import QUESTIONS
from rmpa.web.rosbridge import session as rosbridge
from rmpa.web.rosbridge.rosapi import SERVICES
from rmpa.web.server.access import (
    AccessPolicy,
    Problem,
    is_loopback,
    own_names,
    token_from,
)
from rmpa.web.server.process import access_of, url_of
from tests.waiting import DEADLINE
from tests.web.hub.client import node
from tests.web.server.test_upgrades import running

TOKEN = "t" * 43
HOSTS = own_names(("base",))
OPEN = AccessPolicy(8480, HOSTS)
CLOSED = AccessPolicy(8480, HOSTS, TOKEN)
HERE = ("base.local:8480",)


# The headers that the table names otherwise.
NAMES = {"fetch_site": "Sec-Fetch-Site", "fetch_mode": "Sec-Fetch-Mode", "preflight": "Access-Control-Request-Method"}


def asked(
    host: tuple[str, ...] = HERE,
    *,
    token: str | None = None,
    cookie: str | None = None,
    secure: bool = False,
    **more: Any,
) -> Any:
    """A request with these headers; ``None`` is one that is missing."""
    headers = CIMultiDict(("Host", each) for each in host)
    headers.extend({NAMES.get(name, name): value for name, value in more.items() if value is not None})
    return SimpleNamespace(
        method="OPTIONS" if "preflight" in more else "GET",
        headers=headers,
        query={} if token is None else {"token": token},
        cookies={} if cookie is None else {CLOSED.cookie: cookie},
        secure=secure,
    )


def judged(policy: AccessPolicy, place: Any = "", **facts: Any) -> str:
    """The verdict, or why there is none."""
    try:
        return policy.judge(asked(**facts), place)
    except Problem as problem:
        return problem.reason


LISTED = AccessPolicy(8480, HOSTS, TOKEN, frozenset({"https://app.example", "*"}))
ORIGIN = "http://base.local:8480"
APP: dict[str, Any] = {"origin": "https://app.example", "preflight": "GET"}
# Each: what the request has beside ``Host: base.local:8480``, and what becomes of it.
WITHOUT_TOKEN: list[Any] = [
    # A name that is not ours is a rebound one; an address cannot be rebound.
    *(({"host": (f"{name}:8480",)}, "granted") for name in ("localhost", "localhost.", "127.0.0.1", "192.168.1.7")),
    *(({"host": (name,)}, "granted") for name in ("LOCALHOST", "base", "base.local:8480", "[::1]:8480")),
    *(({"host": (f"{name}:8480",)}, "host") for name in ("evil.example", "127.0.0.1.evil.example", "0x7f.1")),
    *(({"host": (name,)}, "host") for name in ("localhost.evil.example", "localhost:8480@evil.example", "")),
    *(({"host": names}, "host") for names in (("localhost, evil.example",), (), ("localhost", "evil.example"))),
    # Only our own pages may read.
    *(({"origin": each}, "granted") for each in (ORIGIN, "https://BASE.local:8480")),
    *(({"origin": f"http://{each}"}, "origin") for each in ("base.local:8481", "base.local", "evil.example")),
    *(({"origin": each}, "origin") for each in ("http://evil.example/base.local:8480", "null", "")),
    *(({"origin": each}, "origin") for each in ("ftp://base.local:8480", "chrome-extension://abc")),
    # A server of HTTPS takes no page of plain HTTP for its own: what is on the way can forge that page.
    *(({"origin": f"https://{each}:8480", "secure": True}, "granted") for each in ("base.local", "BASE.local")),
    *(({"origin": each, "secure": True}, "origin") for each in (ORIGIN, "HTTP://base.local:8480", "null")),
    # What other sites load is refused without an origin, too; a link on another page may lead here.
    ({"fetch_site": "same-origin", "fetch_mode": "cors"}, "granted"),
    ({"fetch_site": "none", "fetch_mode": "navigate", "place": "page"}, "granted"),
    ({"fetch_site": "cross-site", "fetch_mode": "navigate", "place": "page"}, "granted"),
    *(({"fetch_site": "cross-site", "fetch_mode": each}, "origin") for each in ("navigate", "no-cors", "websocket")),
    ({"fetch_site": "same-site", "fetch_mode": "no-cors", "place": "page"}, "origin"),  # another port of this host
]
WITH_TOKEN: list[Any] = [
    # It comes as bearer, cookie or query.
    *(({"authorization": each}, "granted") for each in (f"Bearer {TOKEN}", f"bearer  {TOKEN} ")),
    *(({"authorization": f"Bearer {each}"}, "token") for each in (f"{TOKEN}x", TOKEN[:-1], "", "\udcff\u00e4")),
    *(({"cookie": each}, "token") for each in ("old", "", None)),
    ({"authorization": f"Basic {TOKEN}"}, "token"),
    ({"cookie": TOKEN}, "granted"),
    ({"token": TOKEN}, "granted"),
    ({"token": TOKEN, "place": "page"}, "move token"),
    ({"token": TOKEN, "place": "page", "cookie": "old"}, "move token"),
    ({"token": "wrong", "place": "page"}, "token"),
    ({"token": "wrong", "cookie": TOKEN}, "granted"),
    ({"place": "open"}, "granted"),
    # Only listed sites are told what their pages may send.
    (APP, "preflight"),
    (APP | {"origin": "https://APP.example"}, "preflight"),
    ({"origin": "https://app.example"}, "token"),
    *((APP | {"origin": each}, "origin") for each in ("http://app.example", "https://app.example:8443", "*", "null")),
    (APP | {"origin": "https://app.example.evil.example"}, "origin"),
    *((APP | {"origin": each}, "token") for each in (ORIGIN, None)),  # our own pages ask nothing before
    (APP | {"host": ("evil.example",)}, "host"),
]


@pytest.mark.parametrize(("given", "expected"), WITHOUT_TOKEN)
def test_who_may_ask_where_there_is_no_token(given: dict[str, Any], expected: str) -> None:
    assert judged(OPEN, **given) == expected
    # The right token does not help: a rebound page would have the browser send the cookie.
    for token in ({"authorization": f"Bearer {TOKEN}"}, {"cookie": TOKEN}):
        assert judged(CLOSED, **token | given) == expected


@pytest.mark.parametrize(("given", "expected"), WITH_TOKEN)
def test_who_may_ask_where_there_is_a_token(given: dict[str, Any], expected: str) -> None:
    assert judged(LISTED, **given) == expected


def test_a_refusal_says_what_to_do() -> None:
    for request, remedy in (
        (asked(("base.lan",)), "--host"),
        (asked(origin="http://evil.example"), "open its own pages"),
        (asked(), "Authorization: Bearer TOKEN"),
        (asked(cookie="old"), "the token is wrong"),
    ):
        with pytest.raises(Problem) as refused:
            CLOSED.judge(request)
        assert remedy in refused.value.detail


def test_only_loopback_needs_no_token() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.3.4.5", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "192.168.1.7", "base", "")))


def test_two_servers_of_one_host_have_cookies_of_their_own() -> None:
    assert AccessPolicy(8480, HOSTS).cookie != AccessPolicy(8481, HOSTS).cookie


def test_a_token_is_made_once_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "base" / "web-token"
    token, is_new = token_from(file)
    assert (is_new, stat.S_IMODE(file.stat().st_mode)) == (True, 0o600)
    assert len(token) >= 43  # 256 bits
    assert token_from(file) == (token, False)
    file.chmod(0o644)
    with pytest.raises(StartError, match=r"other users may use .*644.*chmod 600"):
        token_from(file)
    file.chmod(0o600)
    for text in ("", "short", "with spaces in the middle of it", "n" * 20 + "\x00", "\N{SNOWMAN}" * 20):
        file.write_text(text)
        with pytest.raises(StartError, match="holds no token"):
            token_from(file)


def test_loopback_needs_none_unless_a_file_is_given(tmp_path: Path) -> None:
    environ = {"RMPA_STATE_DIR": str(tmp_path)}
    assert access_of(WebSettings(), "base", environ).token == ""
    given = access_of(WebSettings(token_file=str(tmp_path / "mine")), "base", environ)
    assert given.token == (tmp_path / "mine").read_text().strip()


def test_beyond_loopback_the_token_is_made_and_its_url_told_once(tmp_path: Path) -> None:
    environ, web = {"RMPA_STATE_DIR": str(tmp_path)}, WebSettings(listen="192.168.1.7")
    first = access_of(web, "base", environ)
    assert first.file == tmp_path / "base" / "web-token"
    assert url_of(web, first, 8480) == f"http://192.168.1.7:8480/?token={first.token}"
    again = access_of(web, "base", environ)
    assert again.token == first.token
    assert first.token not in url_of(web, again, 8480)


def test_without_a_place_for_the_token_the_remedy_is_told() -> None:
    with pytest.raises(StartError, match="--token-file"):
        access_of(WebSettings(listen="192.168.1.7"), "base", {})


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files to another user")
def test_a_token_that_another_user_has_made_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "token"
    token_from(path)
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    assert token_from(path)[0], "root's"
    os.chown(path, 999, -1)
    with pytest.raises(StartError, match="belongs to user 999, who knows the token"):
        token_from(path)


SECRET: Final = "secret-" * 6
# Denies the names of the table: what is refused without a right is refused by a rule as well.
DENIED: Final = NodeRules(
    Permissions(
        TrustSettings(
            default="allow",
            rules=(
                PermissionRule(
                    ("web",),
                    effect=Effect.DENY,
                    names=dict.fromkeys(
                        ("subscribe", "publish", "call", "serve", "param"), ("/t", "/s", "/p", "/new", "/tf")
                    ),
                ),
            ),
        )
    )
)
STRING: Final = {"type": "std_msgs/String"}
EMPTY: Final = {"type": "std_srvs/Empty"}
# What each op may do without a right, or the right that it needs; a message; whether a rule can deny its name.
ROSBRIDGE: Final[dict[str, tuple[str, dict[str, Any], bool]]] = {
    "subscribe": ("", {"topic": "/t", **STRING}, True),
    "unsubscribe": ("", {"topic": "/t"}, False),
    "advertise": ("control", {"topic": "/t", **STRING}, True),
    "unadvertise": ("", {"topic": "/t"}, False),  # of its own
    "publish": ("control", {"topic": "/t", "msg": {}}, True),
    "call_service": ("control", {"service": "/s", "args": {}, **EMPTY}, True),
    "advertise_service": ("control", {"service": "/s", **EMPTY}, True),
    "unadvertise_service": ("", {"service": "/s"}, False),  # of its own
    "service_response": ("", {"service": "/s", "result": True}, False),  # of its own
    "send_action_goal": ("", {"action": "/tf2_web_republisher", "id": "g"}, True),  # it subscribes to /tf
    "cancel_action_goal": ("", {"action": "/tf2_web_republisher", "id": "g"}, False),
    "set_level": ("", {"level": "error"}, False),
    "status": ("", {}, False),
    "fragment": ("", {"id": 1, "data": "{", "num": 0, "total": 2}, False),  # each op in it is judged
    "png": ("", {"data": "{", "id": 1, "num": 0, "total": 2}, False),
}
NOTHING: Final[dict[str, Any]] = {}
ROSAPI: Final[dict[str, tuple[str, dict[str, Any], bool]]] = {
    "get_param": ("view", {"name": "/p"}, True),
    "has_param": ("view", {"name": "/p"}, True),
    "search_param": ("view", {"name": "/p"}, True),
    "get_param_names": ("view", NOTHING, False),  # lists what is not denied
    "set_param": ("control", {"name": "/p", "value": "1"}, True),
    "delete_param": ("control", {"name": "/p"}, True),
    # Names of the graph, types and the time are shown to all.
    **dict.fromkeys(("topics", "topics_and_raw_types", "services", "nodes", "action_servers"), ("", NOTHING, False)),
    **dict.fromkeys(("topics_for_type", "services_for_type", "message_details"), ("", STRING, False)),
    **dict.fromkeys(("service_request_details", "service_response_details"), ("", EMPTY, False)),
    **dict.fromkeys(("topic_type", "publishers", "subscribers"), ("", {"topic": "/t"}, False)),
    **dict.fromkeys(
        ("service_type", "service_node", "service_host", "service_providers"), ("", {"service": "/s"}, False)
    ),
    "node_details": ("", {"node": "/n"}, False),
    "get_time": ("", NOTHING, False),
}
PARAMETER: Final = {"name": "/p", "value": 1}
CHANNEL: Final = {"id": 1, "topic": "/t", "encoding": "ros1", "schemaName": "std_msgs/String"}
FOXGLOVE: Final[dict[str, tuple[str, dict[str, Any], bool]]] = {
    "subscribe": ("", {"subscriptions": [{"id": 1, "channelId": 1}]}, True),
    "unsubscribe": ("", {"subscriptionIds": []}, False),
    "advertise": ("control", {"channels": [CHANNEL]}, True),
    "unadvertise": ("", {"channelIds": []}, False),  # of its own
    "getParameters": ("view", {"parameterNames": ["/p"], "id": "g"}, True),
    "setParameters": ("control", {"parameters": [PARAMETER], "id": "s"}, True),
    "subscribeParameterUpdates": ("view", {"parameterNames": ["/p"]}, True),
    "unsubscribeParameterUpdates": ("", {"parameterNames": ["/p"]}, False),
    "fetchAsset": ("view", {"uri": "package://x/y", "requestId": 1}, False),
    "subscribeConnectionGraph": ("", NOTHING, False),
    "unsubscribeConnectionGraph": ("", NOTHING, False),
}
# The ops of the pages; what "ask" asks says itself what it needs, and every page may stop what "stick" drives.
MONITOR: Final = {
    "ack": "", "look": "", "watch": "subscribe", "unwatch": "", "seen": "", "ask": "",
    "drive": "drive", "release": "", "stick": "drive", "publish": "control", "publishing": "", "unpublish": "",
}  # fmt: skip


# By binary frames: opcode, channel and message; opcode, service, call, encoding and request.
FOXGLOVE_BINARY: Final = {
    "publish": struct.pack("<BI", 1, 1),
    "call": struct.pack("<BIII", 2, 1, 1, 4) + b"ros1",
}


def test_each_verb_has_a_row() -> None:
    assert ROSBRIDGE.keys() == rosbridge.OPS.keys()
    assert {f"/rosapi/{name}" for name in ROSAPI} == SERVICES.keys()
    assert FOXGLOVE.keys() == foxglove.OPS.keys()
    assert MONITOR.keys() == monitor.OPS.keys()
    # What the pages ask names its right where it is written.
    assert {*QUESTIONS.values()} == {"", "view", "control"}


class Server:
    """A server, and what its clients send and get.

    Args:
        refuses: ``right``: clients have no token, so none; ``rule``: they have all, and the rules deny the names of
            the table; empty: they may do everything.
    """

    def __init__(self, refuses: str) -> None:
        self.refuses = refuses
        self.token = "" if refuses == "right" else SECRET
        self.rules = DENIED if refuses == "rule" else EVERYTHING

    async def __aenter__(self) -> Self:
        self._stack = AsyncExitStack()
        server, core = await self._stack.enter_async_context(running(self.token, self.rules))
        talker = await self._stack.enter_async_context(node(core, "talker"))
        await talker.set_param("/p", 7)
        await talker.advertise("/t", STRING["type"])
        await talker.advertise_service("/s", EMPTY["type"], lambda _: {})
        self.url = f"http://127.0.0.1:{server.port}"
        self.session = await self._stack.enter_async_context(aiohttp.ClientSession())
        async with asyncio.timeout(DEADLINE):  # the graph and the parameters are known
            while not {"/t", "/p"} <= await self._known():
                await asyncio.sleep(0.01)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def _known(self) -> set[str]:
        answers = await self.rosbridge("call_service", {"service": "/rosapi/topics"}, "end")
        found = {*answers[0]["values"]["topics"]}
        if self.refuses:
            return found | {"/p"}
        answers = await self.rosbridge("call_service", {"service": "/rosapi/get_param_names"}, "end")
        return found | {*answers[0]["values"]["names"]}

    def connect(self, *protocols: str) -> Any:
        return self.session.ws_connect(f"{self.url}/?token={self.token}", protocols=protocols)

    async def rosbridge(self, op: str, values: dict[str, Any], last: str = "") -> list[dict[str, Any]]:
        """All that an op is answered with; ``last`` is the id of the last answer, if that is its own."""
        async with self.connect() as socket:
            await socket.send_json({"id": last or 5, **values, "op": op})
            if not last:
                await socket.send_json({"op": "call_service", "id": "end", "service": "/rosapi/get_time"})
            return await _until(socket, lambda got: got.get("id") == "end")

    async def foxglove(self, sent: dict[str, Any] | bytes, last: Callable[[dict[str, Any]], bool]) -> str:
        """All that a message is answered with behind the channels."""
        async with self.connect(*SUBPROTOCOLS) as socket:
            found = await _until(socket, lambda got: any(each["topic"] == "/t" for each in got.get("channels", ())))
            channel = next(each["id"] for each in found[-1]["channels"] if each["topic"] == "/t")
            if isinstance(sent, bytes):
                await socket.send_bytes(sent)
            else:
                text = json.dumps(sent).replace('"channelId": 1', f'"channelId": {channel}')
                await socket.send_str(text)
            await socket.send_json({"op": "unsubscribe", "subscriptionIds": [99]})
            return json.dumps(await _until(socket, last))


async def _until(socket: Any, last: Callable[[dict[str, Any]], bool]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    async with asyncio.timeout(DEADLINE):
        while not found or not last(found[-1]):
            got = await socket.receive()
            binary = got.type is aiohttp.WSMsgType.BINARY
            found.append({"binary": got.data.decode(errors="replace")} if binary else json.loads(got.data))
    return found


REFUSED: Final = "may not"
REFUSALS: Final = pytest.mark.parametrize("refuses", ["right", "rule", ""])


def expected(row: tuple[str, dict[str, Any], bool], refuses: str) -> bool:
    return bool(row[0]) if refuses == "right" else row[2] and refuses == "rule"


@REFUSALS
async def test_rosbridge(refuses: str) -> None:
    async with Server(refuses) as server:
        for op, row in ROSBRIDGE.items():
            said = json.dumps(await server.rosbridge(op, row[1], "end" if op == "call_service" else ""))
            assert (REFUSED in said) == expected(row, refuses), (op, said)


@REFUSALS
async def test_rosapi(refuses: str) -> None:
    async with Server(refuses) as server:
        for name, row in ROSAPI.items():
            if refuses == "" and name == "delete_param":  # behind those that read it
                continue
            call = {"service": f"/rosapi/{name}", "args": row[1]}
            (answer,) = await server.rosbridge("call_service", call, "end")
            refused = answer["result"] is False and REFUSED in str(answer["values"])
            assert refused == expected(row, refuses), answer
            assert refused or answer["result"] or name in ("message_details", "service_type"), answer


@REFUSALS
async def test_foxglove(refuses: str) -> None:
    async with Server(refuses) as server:
        for op, row in FOXGLOVE.items():
            answered = row[1].get("id") if (op, refuses) != ("setParameters", "right") else None

            def last(got: dict[str, Any], op: str = op, answered: str | None = answered) -> bool:
                if op == "fetchAsset":
                    return "binary" in got
                if answered:
                    return got.get("op") == "parameterValues" and got.get("id") == answered
                return "no subscription 99" in got.get("message", "")

            said = await server.foxglove({"op": op, **row[1]}, last)
            assert (REFUSED in said) == expected(row, refuses), (op, said)
        for verb, frame in FOXGLOVE_BINARY.items():
            said = await server.foxglove(frame, lambda got: "no subscription 99" in got.get("message", ""))
            assert (REFUSED in said) == (refuses == "right"), (verb, said)


async def test_rest_asks_for_the_token_in_every_path_and_changes_nothing() -> None:
    async with Server("") as server:
        for path in ("/metrics", *(f"{api.PREFIX}{each}" for each in api._PATHS)):
            async with server.session.get(f"{server.url}{path}") as response:
                assert (response.status, response.content_type) == (401, "application/problem+json"), path
            for method in ("POST", "PUT", "PATCH", "DELETE"):
                async with server.session.request(method, f"{server.url}{path}?token={SECRET}") as response:
                    assert response.status == 405, (method, path)


@pytest.mark.parametrize("offered", [("mqtt",), ("mqtt", "mqttv3.1"), ("rosbridge",)])
async def test_another_protocol_is_refused_by_name(offered: tuple[str, ...]) -> None:
    async with Server("") as server:
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            async with server.connect(*offered):
                pass
        assert refused.value.status == 400
        headers = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Protocol": ", ".join(offered)}
        async with server.session.get(f"{server.url}/?token={SECRET}", headers=headers) as response:
            assert f"'{', '.join(offered)}' is not spoken here" in await response.text()
        async with server.connect("x", SUBPROTOCOLS[-1]) as socket:
            assert socket.protocol == SUBPROTOCOLS[-1]
