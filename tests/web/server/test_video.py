"""web_video_server's URLs over sockets: what is sent to whom, how fast, and how it ends."""

from __future__ import annotations

import asyncio
import io
import json
import socket
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
import pytest
from PIL import Image

from rmpa.ros.node.node import Node, Publisher
from rmpa.ros.types.messages import MessageType
from rmpa.web import limits
from rmpa.web.hub.hub import Hub
from rmpa.web.server.access import AccessPolicy, own_names
from rmpa.web.server.agent_watch import AgentWatch
from rmpa.web.server.app import WebServer
from rmpa.web.server.video import VideoStreams, Wish, encode
from tests.waiting import until
from tests.web.snapshots import FULL

TOKEN = "secret-" * 6
START = b"\xff\xd8\xff"  # of a JPEG
RAW, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"


def image(
    colour: tuple[int, int, int] = (200, 30, 40), width: int = 64, height: int = 48, **more: Any
) -> dict[str, Any]:
    """An rgb8 image of one colour, with two bytes of padding behind each row."""
    row = bytes(colour) * width + b"\xff\xff"
    values = {"width": width, "height": height, "encoding": "rgb8", "step": len(row), "data": row * height}
    return values | more


def jpeg(colour: tuple[int, int, int] = (200, 30, 40), size: tuple[int, int] = (64, 48), kind: str = "JPEG") -> bytes:
    out = io.BytesIO()
    Image.new("RGB", size, colour).save(out, kind)
    return out.getvalue()


def payload(type_: str, values: dict[str, Any]) -> memoryview:
    kind = MessageType(type_)
    return memoryview(kind.serialize(kind.make(values)))


def shown(body: bytes) -> tuple[str | None, tuple[int, int], tuple[int, ...]]:
    """A picture's format, size and the colour in its middle."""
    made = Image.open(io.BytesIO(body))
    middle = made.convert("RGB").getpixel((made.width // 2, made.height // 2))
    assert isinstance(middle, tuple)
    return made.format, made.size, middle


def near(colour: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    return all(abs(a - b) < 12 for a, b in zip(colour, wanted, strict=True))


# --- encoding -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoding", "pixel", "colour"),
    [
        ("rgb8", (200, 30, 40), (200, 30, 40)),
        ("bgr8", (40, 30, 200), (200, 30, 40)),
        ("rgba8", (200, 30, 40, 0), (200, 30, 40)),
        ("bgra8", (40, 30, 200, 0), (200, 30, 40)),
        ("mono8", (90,), (90, 90, 90)),
        ("bayer_rggb8", (90,), (90, 90, 90)),
    ],
)
def test_each_encoding_has_its_colours(encoding: str, pixel: tuple[int, ...], colour: tuple[int, ...]) -> None:
    row = bytes(pixel) * 64
    raw = image(encoding=encoding, step=len(row), data=row * 48)
    content_type, body = encode(MessageType(RAW), payload(RAW, raw), Wish("/a"))
    assert content_type == "image/jpeg"
    assert shown(body)[:2] == ("JPEG", (64, 48))
    assert near(shown(body)[2], colour)


def test_a_depth_image_is_grey_and_shows_what_is_near_darker() -> None:
    depths = b"".join(each.to_bytes(2, "little") for each in [1000] * 32 + [4000] * 32)
    raw = image(encoding="16UC1", step=128, data=depths * 48)
    _, body = encode(MessageType(RAW), payload(RAW, raw), Wish("/a"))
    grey = Image.open(io.BytesIO(body))
    assert (grey.mode, grey.size) == ("L", (64, 48))
    assert grey.getpixel((5, 20)) < 10 < 240 < grey.getpixel((60, 20))  # type: ignore[operator]


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_what_is_compressed_crosses_as_it_is_and_another_size_is_made(kind: str) -> None:
    data = jpeg(kind=kind)
    message = payload(COMPRESSED, {"format": "anything", "data": data})
    assert encode(MessageType(COMPRESSED), message, Wish("/a")) == (f"image/{kind.lower()}", data)
    _, body = encode(MessageType(COMPRESSED), message, Wish("/a", width=32))
    assert shown(body)[:2] == ("JPEG", (32, 24))
    _, small = encode(MessageType(COMPRESSED), message, Wish("/a", width=40, height=10, quality=5))
    assert shown(small)[1] == (40, 10)


@pytest.mark.parametrize(
    ("type_", "values", "says"),
    [
        (RAW, image(encoding="h264"), "encoding 'h264'"),
        (RAW, image(data=b"short"), "5 bytes are no image"),
        (RAW, image(step=3), "no image of 64 x 48"),
        (RAW, image() | {"width": 0}, "no image of 0 x 48"),
        (RAW, image() | {"width": 2**31, "height": 2**31}, "is larger than"),
        (COMPRESSED, {"format": "jpeg", "data": b"\xff\xd8\xff broken"}, "cannot be read"),
        (COMPRESSED, {"format": "16UC1; compressedDepth", "data": bytes(64)}, "neither JPEG nor PNG"),
        ("std_msgs/String", {"data": "hello"}, "std_msgs/String is not an image"),
    ],
)
def test_what_is_no_picture_says_so(type_: str, values: dict[str, Any], says: str) -> None:
    with pytest.raises(Exception, match=says):
        encode(MessageType(type_), payload(type_, values), Wish("/a", width=32))


# --- over sockets ---------------------------------------------------------------------------------------------------


class Camera:
    """A server with a hub, a publisher of pictures, and a browser's requests."""

    def __init__(self, server: WebServer, http: aiohttp.ClientSession, talker: Node) -> None:
        self.server, self.http, self.talker = server, http, talker
        self.kinds: dict[str, MessageType] = {}

    async def publish(self, topic: str, type_: str, values: dict[str, Any], *, latch: bool = True) -> Publisher:
        publisher = await self.talker.advertise(topic, type_, latch=latch)
        if values:
            publisher.publish(publisher.make(values))
        return publisher

    def url(self, path: str) -> str:
        return f"http://127.0.0.1:{self.server.port}{path}"

    async def get(self, path: str, **headers: str) -> tuple[int, Mapping[str, str], bytes]:
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        async with self.http.get(self.url(path), headers=given) as response:
            return response.status, response.headers, await response.read()


@asynccontextmanager
async def cameras(hub: Hub, talker: Node, token: str = "") -> AsyncIterator[Camera]:
    policy = AccessPolicy(0, own_names(("base",)), token)
    server = WebServer(AgentWatch(lambda: FULL), policy, "127.0.0.1", video=VideoStreams(hub))
    await server.start()
    try:
        async with aiohttp.ClientSession() as http:
            yield Camera(server, http, talker)
    finally:
        await server.close()


@pytest.fixture
async def camera(hub: Hub, talker: Node) -> AsyncIterator[Camera]:
    async with cameras(hub, talker) as made:
        yield made


async def part(reader: aiohttp.StreamReader) -> bytes:
    """The next picture of a stream, whose boundary has been read; with the boundary behind it."""
    size = 0
    while (line := await reader.readline()) != b"\r\n":
        name, _, value = line.decode().partition(":")
        size = int(value) if name == "Content-Length" else size
    body = await reader.readexactly(size)
    assert await reader.readexactly(len(b"\r\n--picture\r\n")) == b"\r\n--picture\r\n"
    return body


async def test_a_snapshot_is_one_picture_of_a_raw_or_a_compressed_topic(camera: Camera, hub: Hub) -> None:
    await camera.publish("/raw", RAW, image())
    await camera.publish("/cam/compressed", COMPRESSED, {"format": "jpeg", "data": jpeg()})
    await until(lambda: {"/raw", "/cam/compressed"} <= {*hub.graph.topics})
    status, headers, body = await camera.get("/snapshot?topic=/raw&width=32&quality=50")
    assert (status, headers["Content-Type"], shown(body)[1]) == (200, "image/jpeg", (32, 24))
    assert (await camera.get("/snapshot?topic=cam/compressed"))[2] == jpeg()
    assert (await camera.get("/snapshot?topic=/cam&type=ros_compressed"))[2] == jpeg()
    assert (await camera.get("/snapshot?topic=/cam"))[2] == jpeg()


async def test_a_stream_has_each_picture_as_soon_as_it_is_there(camera: Camera, hub: Hub) -> None:
    publisher = await camera.publish("/raw", RAW, image())
    await until(lambda: "/raw" in hub.graph.topics)
    async with camera.http.get(camera.url("/stream?topic=/raw")) as response:
        assert response.headers["Content-Type"] == "multipart/x-mixed-replace;boundary=picture"
        assert response.headers["X-Content-Type-Options"] == "nosniff"
        assert await response.content.readline() == b"--picture\r\n"
        assert near(shown(await part(response.content))[2], (200, 30, 40))
        for colour in ((10, 200, 30), (20, 30, 200)):
            publisher.publish(publisher.make(image(colour)))
            assert near(shown(await part(response.content))[2], colour)
    await until(lambda: camera.server._video is not None and not camera.server._video._cameras)


async def test_a_slow_client_gets_fewer_pictures_and_then_the_newest(camera: Camera, hub: Hub) -> None:
    noise = bytes(range(256)) * 4096  # a megabyte that JPEG does not make smaller
    publisher = await camera.publish("/fast", COMPRESSED, {}, latch=False)
    await until(lambda: "/fast" in hub.graph.topics)
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.setblocking(False)
    loop = asyncio.get_running_loop()
    await loop.sock_connect(slow, ("127.0.0.1", camera.server.port))
    reader, writer = await asyncio.open_connection(sock=slow, limit=4096)
    writer.write(b"GET /stream?topic=/fast HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    await publisher.wait_for_subscriber()
    video = camera.server._video
    assert video is not None

    def send(number: int) -> None:
        values: dict[str, Any] = {"format": "jpeg", "data": START + bytes([number]) + noise}
        publisher.publish(publisher.make(values))

    for number in range(100):
        send(number)
        await asyncio.sleep(0.01)
    ((transport,), (made,)) = video._transports, [each._made for each in video._cameras.values()]
    assert made is not None
    assert made.number < 20, "no more pictures are made than it takes"
    assert transport.get_write_buffer_size() < 3 * len(noise)
    seen: list[int] = []
    got = b""
    while not seen or seen[-1] != 99:
        got += await reader.read(65536)
        seen = [each[0] for each in got.split(START)[1:] if each]
    assert len(seen) < 20
    writer.close()
    await until(lambda: not video._transports)


async def test_two_clients_share_a_subscription_and_an_encoded_picture(camera: Camera, hub: Hub) -> None:
    await camera.publish("/raw", RAW, image())
    await until(lambda: "/raw" in hub.graph.topics)
    url = camera.url("/stream?topic=/raw&width=20")
    async with camera.http.get(url) as first, camera.http.get(url) as second:
        for each in (first, second):
            await each.content.readline()
            await part(each.content)
        video = camera.server._video
        assert video is not None
        assert [each.users for each in video._cameras.values()] == [2]


NOT_SHOWN = (
    ("/stream", 400, "'' is not a topic's name"),
    ("/stream?topic=/nothing", 404, "there is no topic /nothing"),
    ("/stream?topic=/a%20b", 400, "is not a topic's name"),
    ("/snapshot?topic=/text", 400, "has the type std_msgs/String, which is not an image"),
    ("/stream?topic=/raw&type=h264", 400, "the type 'h264' is not offered"),
    ("/stream?topic=/raw&width=99999", 400, "width='99999' is not a number from 0 to"),
    ("/stream?topic=/raw&quality=x", 400, "quality='x'"),
    ("/stream?topic=/odd", 415, "encoding 'odd'"),
)


async def test_what_cannot_be_shown_is_said(camera: Camera, hub: Hub) -> None:
    await camera.publish("/text", "std_msgs/String", {"data": "x"})
    await camera.publish("/raw", RAW, image())
    await camera.publish("/odd", RAW, image(encoding="odd"))
    await until(lambda: {"/text", "/raw", "/odd"} <= {*hub.graph.topics})
    for path, status, says in NOT_SHOWN:
        got, _, body = await camera.get(path)
        assert (got, says in json.loads(body)["detail"]) == (status, True), body


async def test_a_topic_without_pictures_is_no_snapshot(
    camera: Camera, hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "PICTURE_WAIT", 0.1)
    await camera.publish("/raw", RAW, {})
    await until(lambda: "/raw" in hub.graph.topics)
    assert (await camera.get("/snapshot?topic=/raw"))[0] == 504


async def test_streams_are_bounded_and_end_with_the_server(
    camera: Camera, hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "STREAMS_MAX", 1)
    await camera.publish("/raw", RAW, image())
    await until(lambda: "/raw" in hub.graph.topics)
    async with camera.http.get(camera.url("/stream?topic=/raw")) as first:
        await first.content.readline()
        assert (await camera.get("/snapshot?topic=/raw"))[0] == 429
        await asyncio.wait_for(camera.server.close(), 1.5)  # a handler under way would have 2 s
        with pytest.raises(aiohttp.ClientError):
            await first.read()


async def test_the_viewer_lists_topics_and_shows_one(camera: Camera, hub: Hub) -> None:
    await camera.publish("/raw", RAW, image())
    await until(lambda: "/raw" in hub.graph.topics)
    _, _, body = await camera.get("/stream_viewer")
    assert b'<a href="stream_viewer?topic=/raw">/raw</a>' in body
    _, headers, body = await camera.get("/stream_viewer?topic=/raw&width=%22%3E%3Cscript%3E")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert b"<script>" not in body
    assert b'<img src="stream?topic=/raw&amp;width=%22%3E%3Cscript%3E"' in body


async def test_another_site_shows_pictures_with_the_token_in_the_url_alone(hub: Hub, talker: Node) -> None:
    async with cameras(hub, talker, TOKEN) as camera:
        await camera.publish("/raw", RAW, image())
        await until(lambda: "/raw" in hub.graph.topics)
        path, foreign = "/snapshot?topic=/raw", {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors"}
        status, headers, _ = await camera.get(f"{path}&token={TOKEN}", **foreign)
        assert (status, headers["Cross-Origin-Resource-Policy"]) == (200, "cross-origin")
        assert (await camera.get(f"{path}&token=wrong", **foreign))[0] == 403
        assert (await camera.get(path, **foreign, Cookie=f"rmpa_token_0={TOKEN}"))[0] == 403
        assert (await camera.get(path))[0] == 401
        assert (await camera.get(f"/api/v1/agent?token={TOKEN}", **foreign))[0] == 403
        status, headers, _ = await camera.get(path, Authorization=f"Bearer {TOKEN}")
        assert (status, headers["Cross-Origin-Resource-Policy"]) == (200, "same-origin")


async def test_without_a_token_no_other_site_shows_pictures(camera: Camera) -> None:
    assert (await camera.get("/snapshot?topic=/raw&token=", Sec_Fetch_Site="cross-site"))[0] == 403
