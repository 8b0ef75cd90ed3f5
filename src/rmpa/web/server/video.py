"""web_video_server's URLs: the pictures of a topic as MJPEG in one HTTP response, or one of them, for ``<img>``.

``/stream?topic=/camera/image_raw``, ``/snapshot?topic=…`` and ``/stream_viewer``, with ``type``, ``width``,
``height`` and ``quality`` (wiki.ros.org/web_video_server). What is compressed already crosses as it is. A client gets
the newest picture whenever it has taken the last one: a slow one gets fewer, and nothing waits for it. All clients
that ask for the same share one subscription and one encoded picture.
"""

from __future__ import annotations

import asyncio
import html
import io
import logging
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import quote

from aiohttp import web

from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError
from rmpa.core.identity import is_global_name
from rmpa.ros.types.codec import codec_for
from rmpa.web import limits
from rmpa.web.hub.connection import tune
from rmpa.web.pictures import compressed_picture, pillow, raw_picture
from rmpa.web.server.access import Problem, guard_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.types.messages import MessageType
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.topics import ReceivedMessage

_log = logging.getLogger(__name__)
# Those that pages of other sites may show with the token in the URL.
PICTURES: Final = ("/stream", "/snapshot")
VIEWER: Final = "/stream_viewer"
_RAW, _COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
_TYPES: Final = ("mjpeg", "ros_compressed")
_BOUNDARY: Final = "picture"
_QUALITY: Final = 80  # of a JPEG that is made here: half the bytes of 95
# Pillow's modes of encodings: of the picture, and of the bytes.
_MODES: Final = {
    **dict.fromkeys(("mono8", "8UC1", "bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), ("L", "L", 1)),
    **dict.fromkeys(("bgr8", "8UC3"), ("RGB", "BGR", 3)),
    **dict.fromkeys(("bgra8", "8UC4"), ("RGB", "BGRX", 4)),
    "rgb8": ("RGB", "RGB", 3),
    "rgba8": ("RGB", "RGBX", 4),
}
_PAGE: Final = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta name="color-scheme" content="light dark"><title>{title}</title>
<h1>{title}</h1>{body}
"""


class Wish(NamedTuple):
    """What a client asks for; sizes in pixels, 0: as it is. ``quality`` is that of a JPEG, 1 to 100."""

    topic: str
    type: str = ""
    width: int = 0
    height: int = 0
    quality: int = 0

    @classmethod
    def of(cls, query: Mapping[str, str]) -> Wish:
        """The wish of a URL.

        Raises:
            RemoteProtocolError: It is none.
        """
        topic = f"/{query.get('topic', '').removeprefix('/')}"
        if topic == "/" or not is_global_name(topic):
            raise RemoteProtocolError(
                f"{query.get('topic', '')[:80]!a} is not a topic's name: ?topic=/camera/image_raw"
            )
        kind = query.get("type", "")
        if kind not in ("", *_TYPES):
            raise RemoteProtocolError(f"the type {kind[:40]!a} is not offered; these are: {', '.join(_TYPES)}")
        return cls(
            topic,
            kind,
            _number(query, "width", limits.PICTURE_SIDE_MAX),
            _number(query, "height", limits.PICTURE_SIDE_MAX),
            _number(query, "quality", 100),
        )

    @property
    def is_plain(self) -> bool:
        """Whether pictures are wanted as they are."""
        return not (self.width or self.height or self.quality)


def _number(query: Mapping[str, str], name: str, most: int) -> int:
    text = query.get(name, "0")
    # web_video_server's pages give -1 for a size that is not wanted.
    if text == "-1":
        return 0
    if not (text.isascii() and text.isdecimal() and int(text[:9]) <= most):
        raise RemoteProtocolError(f"{name}={text[:40]!a} is not a number from 0 to {most}")
    return int(text)


class Encoded(NamedTuple):
    """A picture as it is sent; ``number`` counts those of a camera."""

    number: int
    content_type: str
    data: bytes
    stamp_ns: int


def encode(kind: MessageType, payload: memoryview, wish: Wish) -> tuple[str, bytes]:
    """The content type and bytes of a message; it takes some milliseconds for each megapixel.

    Raises:
        RmpaError: It cannot be shown; the text says why.
    """
    if kind.name not in (_RAW, _COMPRESSED):
        raise RemoteProtocolError(f"{kind.name} is not an image")
    values = codec_for(kind).views(payload)
    if kind.name == _COMPRESSED:
        made = compressed_picture(str(values["format"]), values["data"])
        if wish.is_plain:
            return f"image/{made.format}", bytes(made.data)
    image = _opened(values) if kind.name == _COMPRESSED else _image(values)
    if wish.width or wish.height:
        width, height = image.size
        wanted = wish.width or round(wish.height * width / height), wish.height or round(wish.width * height / width)
        size = tuple(min(max(1, each), limits.PICTURE_SIDE_MAX) for each in wanted)
        # Whole pixels are averaged first: a sixth of the time.
        image = image.resize(size, pillow().Resampling.BILINEAR, reducing_gap=1.0)
    out = io.BytesIO()
    image.save(out, "JPEG", quality=wish.quality or _QUALITY)
    return "image/jpeg", out.getvalue()


def _opened(values: Mapping[str, Any]) -> Any:
    try:
        image = pillow().open(io.BytesIO(values["data"]), formats=("JPEG", "PNG"))
        _check_size(*image.size)
        return image.convert("RGB")
    except (OSError, ValueError, SyntaxError) as error:
        raise RemoteProtocolError(f"the picture cannot be read: {error}") from None


def _image(values: Mapping[str, Any]) -> Any:
    """Of a sensor_msgs/Image; depth images become grey."""
    width, height, step, encoding = (values[name] for name in ("width", "height", "step", "encoding"))
    _check_size(width, height)
    mode, raw, size = _MODES.get(encoding, ("", "", 0))
    data = values["data"]
    if not mode:
        made = raw_picture(width, height, encoding, step, data)
        return pillow().frombytes("L", (made.width, made.height), bytes(made.data))
    if width <= 0 or height <= 0 or step < width * size or len(data) < step * height:
        raise RemoteProtocolError(f"{len(data)} bytes are no image of {width} x {height} {encoding}")
    return pillow().frombuffer(mode, (width, height), data, "raw", raw, step, 1)


def _check_size(width: int, height: int) -> None:
    if width * height > limits.PICTURE_PIXELS_MAX:
        raise RemoteProtocolError(f"an image of {width} x {height} is larger than {limits.PICTURE_PIXELS_MAX} pixels")


class _Camera:
    """One topic's pictures in one form, for all clients that want them so.

    Args:
        hub: Subscribes.
        topic: The topic.
        wish: The form.
        encoders: How many pictures are encoded at one time.
    """

    def __init__(self, hub: Hub, topic: str, wish: Wish, encoders: asyncio.Semaphore) -> None:
        self.users = 0
        self._hub = hub
        self._wish = wish
        self._encoders = encoders
        self._newest: ReceivedMessage | None = None
        self._number = 0
        self._changed = asyncio.Event()
        self._encoding = asyncio.Lock()
        self._made: Encoded | None = None
        self._error: RmpaError | None = None
        self._subscription = hub.topics.subscribe(topic, None, self._take, self._fail)

    def close(self) -> None:
        """No client wants them any more."""
        self._subscription.close()

    async def next(self, after: int, transport: asyncio.Transport) -> Encoded:
        """The newest picture, if it is later than ``after``; else the next one.

        Raises:
            ConnectionResetError: The client has gone; ``wake`` has it looked at.
            RmpaError: It cannot be shown.
        """
        while self._number <= after or self._newest is None:
            if self._error is not None:
                raise self._error
            if transport.is_closing():
                raise ConnectionResetError
            await self._changed.wait()
        async with self._encoding:
            if self._made is None or self._made.number < self._number:
                number, message = self._number, self._newest
                kind = self._hub.types.version(message.type, message.md5sum)
                async with self._encoders:
                    made = await asyncio.to_thread(encode, kind, message.payload, self._wish)
                self._made = Encoded(number, *made, message.stamp_ns)
            return self._made

    def _take(self, message: ReceivedMessage) -> None:
        self._newest = message
        self._number += 1
        self.wake()

    def _fail(self, error: RmpaError) -> None:
        self._error = error
        self.wake()

    def wake(self) -> None:
        """Have all that wait look at what has changed."""
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()


class VideoStreams:
    """Serves the pictures of all topics.

    Args:
        hub: Has the topics.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._cameras: dict[tuple[str, Wish], _Camera] = {}
        self._encoders = asyncio.Semaphore(limits.ENCODERS)
        # Of streams under way.
        self._transports: set[asyncio.Transport] = set()

    def close(self) -> None:
        """End all streams."""
        for transport in [*self._transports]:
            transport.abort()

    async def respond(self, request: web.Request) -> web.StreamResponse:
        """A response to a request of one of ``PICTURES``.

        Raises:
            Problem: There are no pictures, or too many streams.
        """
        await self._hub.settled(limits.SETTLE)
        try:
            wish = Wish.of(request.query)
            topic = self._topic(wish)
        except RmpaError as error:
            raise Problem(404 if error.code == "unknown-name" else 400, str(error)) from None
        clients = sum(each.users for each in self._cameras.values())
        if clients >= limits.STREAMS_MAX:
            raise Problem(429, f"{clients} streams are open, which is the limit; close some")
        key = topic, wish._replace(topic="", type="")
        try:
            camera = self._cameras.get(key)
            if camera is None:
                camera = self._cameras[key] = _Camera(self._hub, topic, wish, self._encoders)
            camera.users += 1
            try:
                return await self._serve(request, camera)
            finally:
                camera.users -= 1
                if not camera.users:
                    camera.close()
                    del self._cameras[key]
        except RmpaError as error:
            raise Problem(403 if isinstance(error, PeerRefused) else 415, str(error)) from None
        except ConnectionError:
            raise Problem(504, "the client has gone") from None

    def _topic(self, wish: Wish) -> str:
        """The topic that is shown: the compressed one beside a raw one, where that is wanted or as good."""
        topics, beside = self._hub.graph.topics, f"{wish.topic}/compressed"
        known = topics.get(beside)
        wants = wish.type == "ros_compressed" or (not wish.type and wish.is_plain)
        if wants and known is not None and _COMPRESSED in known.types and known.publishers:
            return beside
        known = topics.get(wish.topic)
        if known is None:
            raise RmpaError(f"there is no topic {wish.topic}; {VIEWER} lists those with images", code="unknown-name")
        if known.types and not {_RAW, _COMPRESSED} & {*known.types}:
            raise RemoteProtocolError(f"{wish.topic} has the type {known.types[0]}, which is not an image")
        return wish.topic

    async def _serve(self, request: web.Request, camera: _Camera) -> web.StreamResponse:
        transport, streams = request.transport, request.path == "/stream"
        if transport is None:
            raise ConnectionResetError
        if streams and (guard := guard_of(request)) is not None:
            guard.stream(camera.wake)
        try:
            async with asyncio.timeout(limits.PICTURE_WAIT):
                first = await camera.next(0, transport)
        except TimeoutError:
            first = None
        if not streams and first is None:
            raise Problem(504, f"no picture came within {limits.PICTURE_WAIT:g} s: does its publisher run?")
        if first is not None and not streams:
            return web.Response(body=first.data, headers=_headers(first))
        response = web.StreamResponse(headers={"Content-Type": f"multipart/x-mixed-replace;boundary={_BOUNDARY}"})
        response.force_close()
        await response.prepare(request)
        if request.method != "HEAD":
            tune(transport, limits.STREAM_UNSENT)
            self._transports.add(transport)
            try:
                await self._write(transport, response, camera, first)
            except (ConnectionError, TimeoutError, RmpaError) as error:
                _log.debug("= a stream of %s has ended: %r", request.remote, error)
            finally:
                self._transports.discard(transport)
                transport.abort()
        return response

    async def _write(
        self, transport: asyncio.Transport, response: web.StreamResponse, camera: _Camera, picture: Encoded | None
    ) -> None:
        """Write one picture after another, until the client has gone or takes none for long.

        A browser shows a picture when the boundary behind it has come.
        """
        await response.write(f"--{_BOUNDARY}\r\n".encode())
        number, pause = 0, 1 / limits.STREAM_RATE_MAX
        while True:
            picture = picture or await camera.next(number, transport)
            began, number = time.monotonic(), picture.number
            head = "".join(f"{name}: {value}\r\n" for name, value in _headers(picture).items())
            tail = f"\r\n--{_BOUNDARY}\r\n".encode()
            async with asyncio.timeout(limits.WEB_RESPONSE_TIMEOUT):
                await response.write(b"".join((head.encode(), b"\r\n", picture.data, tail)))
            picture = None
            await asyncio.sleep(max(0.0, began + pause - time.monotonic()))

    async def page(self, request: web.Request) -> web.Response:
        """``/stream_viewer``: the pictures of a topic, or without one a list of those that have images."""
        await self._hub.settled(limits.SETTLE)
        topic = request.query.get("topic", "")
        if topic:
            shown = html.escape(topic)
            source = html.escape(f"stream?{request.rel_url.raw_query_string}")
            return _html(shown, f'<p><img src="{source}" alt="Pictures of {shown}"></p>')
        names = [name for name, each in self._hub.graph.topics.items() if {_RAW, _COMPRESSED} & {*each.types}]
        rows = (f'<li><a href="stream_viewer?topic={quote(name)}">{html.escape(name)}</a></li>' for name in names)
        return _html("Topics with images", f"<ul>{''.join(rows)}</ul>" if names else "<p>There are none.</p>")


def _headers(picture: Encoded) -> dict[str, str]:
    stamp = f"{picture.stamp_ns / 1e9:.6f}"
    return {"Content-Type": picture.content_type, "Content-Length": str(len(picture.data)), "X-Timestamp": stamp}


def _html(title: str, body: str) -> web.Response:
    text = _PAGE.format(title=title, body=body)
    return web.Response(body=text.encode(), headers={"Content-Type": "text/html; charset=utf-8"})
