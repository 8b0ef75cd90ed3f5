"""The server of ``rmpa web``: its routes, and what holds for all of them: access, read-only, headers, counts.

A protocol or a page is added as one more route (``WebServer.start``): the middleware judges its requests, WebSocket
upgrades included, before its handler runs.
"""

from __future__ import annotations

import asyncio
import html
import itertools
import logging
import time
from importlib.resources import files
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Final

from aiohttp import web
from aiohttp.abc import AbstractAccessLogger

from rmpa.core.errors import StartError
from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.web import api, limits
from rmpa.web.clients import MONITOR_PATH, WebSocketClients, is_upgrade
from rmpa.web.server.access import (
    TOKEN_PARAMETER,
    AccessPolicy,
    ConnectionPhase,
    ConnectionTable,
    Problem,
    guard_of,
    host_name,
    is_loopback,
)
from rmpa.web.server.recordings import ROUTE, RecordingFiles
from rmpa.web.server.video import PICTURES, VIEWER, VideoStreams

if TYPE_CHECKING:
    import ssl
    from collections.abc import Iterator, Sequence
    from importlib.abc import Traversable

    from aiohttp.typedefs import Handler

    from rmpa.web.server.access import Place
    from rmpa.web.server.agent_watch import AgentWatch

_log = logging.getLogger(__name__)
_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
# Is served at ``/``, all others below ``/static/``; files of other kinds, as licences, are not served.
_FIRST: Final = "index.html"


def _pages(folder: Traversable, path: str) -> Iterator[tuple[str, tuple[bytes, str]]]:
    """The files of the pages, each with its path, body and content type; all are in the wheel."""
    for each in folder.iterdir():
        content_type = _TYPES.get(PurePosixPath(each.name).suffix)
        if each.is_dir():
            yield from _pages(each, f"{path}{each.name}/")
        elif content_type is not None:
            yield "/" if each.name == _FIRST else f"{path}{each.name}", (each.read_bytes(), content_type)


# What aiohttp says of broken requests; they are counted and logged by us, without tracebacks.
_AIOHTTP: Final = logging.getLogger("rmpa.web.server.aiohttp")
_AIOHTTP.setLevel(logging.CRITICAL)
# Needs no token: it tells only whether the agent answers.
_HEALTH: Final = "/healthz"
# Where WebSocket clients connect. The pages have their own path; else the subprotocol chooses the protocol.
WEBSOCKET_PATHS: Final = ("/", "/rosbridge", "/foxglove", MONITOR_PATH)
_METHODS: Final = ("GET", "HEAD")
# Characters of a faulty header that are told.
_SHOWN: Final = 120
# Marks requests that reached the middleware; aiohttp answers malformed ones before.
_JUDGED: Final = web.RequestKey("rmpa.judged", bool)
# Of every response.
HEADERS: Final = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; object-src 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Cache-Control": "no-store",
    "Server": "rmpa",
}
# Of responses to loopback: in plain HTTP browsers ignore it from elsewhere, and report that as an error.
OPENER_POLICY: Final = ("Cross-Origin-Opener-Policy", "same-origin")
# Without a style: the server's files need the token, too.
_REFUSED_PAGE: Final = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta name="color-scheme" content="light dark"><title>RMPA: refused</title>
<h1>RMPA does not show this page</h1><p>{text}.</p>{help}
"""
_SIGN_IN: Final = (
    "<p>Open the address that <code>rmpa web</code> printed when it made the token, once: it ends with "
    "<code>/?token=…</code>, and this browser keeps it from then on. The token is in the file <code>web-token</code> "
    "of the module's state directory; <code>rmpa web</code> says at its start where that is.</p>"
)
# Of the response to a browser's question what a page of a listed site may send (Fetch standard, "CORS protocol").
# Cookies are not allowed: such a page sends the token itself.
PREFLIGHT: Final = {
    "Access-Control-Allow-Methods": ", ".join(_METHODS),
    "Access-Control-Allow-Headers": "Authorization",
    "Access-Control-Max-Age": "600",
}


class WebServer:
    """One server at one address: its routes, and its listening sockets.

    Args:
        watch: Gives the agent's snapshot; closed with the server.
        policy: Which requests are served.
        host: The address to listen at.
        sockets: Serve WebSocket upgrades of ``WEBSOCKET_PATHS``.
        ports: Further ports to listen at.
        tls: Serves HTTPS with its certificate; ``None``: HTTP.
        video: Serves pictures; ``None``: there are none.
        recordings: Serves files of recordings, likewise.
    """

    # More than twelve fields: a route uses most of what holds for all of them.
    def __init__(
        self,
        watch: AgentWatch,
        policy: AccessPolicy,
        host: str,
        sockets: WebSocketClients | None = None,
        ports: Sequence[int] = (),
        tls: ssl.SSLContext | None = None,
        video: VideoStreams | None = None,
        recordings: RecordingFiles | None = None,
    ) -> None:
        self._watch = watch
        self._policy = policy
        self._addresses = [(host, port) for port in dict.fromkeys((policy.port, *ports))]
        self._clients = sockets
        self._tls = tls
        self._video = video
        self._recordings = recordings
        # Refusals, by reason; those of connections too.
        self.counters = Counters()
        self._refusals = RefusalLog(_log, self.counters)
        # By status.
        self._responses = Counters()
        self._pages = dict(_pages(files("rmpa.web") / "static", "/static/"))
        self._encoding = asyncio.Lock()
        # ``/metrics`` by its content type, with the number of the reading.
        self._encoded: dict[str, tuple[int, bytes]] = {}
        self._runner: web.AppRunner | None = None
        self._table: ConnectionTable | None = None
        self._servers: list[asyncio.Server] = []

    async def start(self) -> None:
        """Listen.

        Raises:
            StartError: The address cannot be used.
        """
        app = web.Application(middlewares=[self._middleware])
        app.on_response_prepare.append(self._dress)
        for path in self._pages:
            app.router.add_get(path, self._page)
        app.router.add_get("/metrics", self._metrics)
        app.router.add_get(_HEALTH, self._health)
        app.router.add_get(api.PREFIX + "/{below:.*}", self._api)
        if self._video is not None:
            app.router.add_get(VIEWER, self._video.page)
            for path in PICTURES:
                app.router.add_get(path, self._video.respond)
        if self._recordings is not None:
            app.router.add_get(ROUTE, self._recordings.respond, allow_head=False)
        self._runner = runner = web.AppRunner(
            app,
            access_log_class=self._access_logger(),
            access_log=_AIOHTTP,
            logger=_AIOHTTP,
            shutdown_timeout=2.0,
            keepalive_timeout=limits.WEB_IDLE_TIMEOUT,
            max_line_size=limits.WEB_LINE_MAX,
            max_field_size=limits.WEB_FIELD_MAX,
            max_headers=limits.WEB_HEADERS_MAX,
            lingering_time=1.0,  # for the rest of a refused body, so that the client sees the refusal and no reset
        )
        await runner.setup()
        assert runner.server is not None, "setup() makes it"  # noqa: S101 - for the type checker
        self._table = ConnectionTable(runner.server, self._refusals)
        for host, port in self._addresses:
            try:
                server = await asyncio.get_running_loop().create_server(
                    self._table.make,
                    host,
                    port,
                    backlog=128,
                    reuse_address=True,
                    ssl=self._tls,
                    ssl_handshake_timeout=limits.WEB_REQUEST_TIMEOUT if self._tls is not None else None,
                )
            except OSError as error:
                problem = f"cannot be listened at: {error.strerror or error}"
                remedy = "choose another --port or --listen" if port == self._policy.port else "see ports of [web]"
                raise StartError(f"{host}:{port}", problem, remedy, code="port-in-use") from None
            self._servers.append(server)

    @property
    def port(self) -> int:
        """The port that it listens at."""
        if not self._servers:
            return self._policy.port
        port: int = self._servers[0].sockets[0].getsockname()[1]
        return port

    async def close(self) -> None:
        """End: responses under way have 2 s, then every connection is closed."""
        for server in self._servers:
            server.close()
        if self._clients is not None:
            await self._clients.close()
        if self._video is not None:
            self._video.close()
        if self._recordings is not None:
            await self._recordings.end()
        if self._runner is not None:
            await self._runner.cleanup()
        if self._table is not None:
            self._table.abort_all()
        if self._recordings is not None:
            await self._recordings.close()
        await self._watch.close()

    @web.middleware
    async def _middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        request[_JUDGED] = True
        guard = guard_of(request)
        if guard is not None:
            guard.request_begins()
        try:
            return await self._respond(request, handler)
        except Problem as problem:
            return self._refused(request, problem)
        except web.HTTPException:  # of aiohttp's router: no such path
            return self._refused(request, Problem(404, f"there is no {request.path[:80]!a}; / lists what there is"))
        except Exception:  # noqa: BLE001 - the top of the request: a fault in one path must not end the connection's task
            _log.exception("! %s%s failed", "the WebSocket at " if is_upgrade(request) else "", request.path)
            return self._refused(request, Problem(500, "the server failed; its log says why"))
        finally:
            if guard is not None:
                guard.request_ends()

    async def _dress(self, request: web.Request, response: web.StreamResponse) -> None:
        """Give a response the headers that all have; pictures are shown by other pages, too, which had the token."""
        if isinstance(response, web.WebSocketResponse):
            return
        response.headers.update(HEADERS)
        response.headers.update(self._sharing(request))
        if request.path in PICTURES and TOKEN_PARAMETER in request.query:
            response.headers["Cross-Origin-Resource-Policy"] = "cross-origin"
        if is_loopback(host_name(request.host) or ""):
            response.headers.update((OPENER_POLICY,))

    async def _respond(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        shared = request.path not in self._pages
        verdict = self._policy.judge(request, self._place(request), shared=shared)
        if request.method not in _METHODS and verdict != "preflight":
            text = f"{request.method[:20]} is not supported; this server only shows, and is read with GET"
            raise Problem(405, text, "method")
        if request.body_exists:
            raise Problem(413, "a request with a body; send none with GET", "body")
        if verdict == "preflight":
            return web.Response(status=204, headers=PREFLIGHT)
        if verdict == "move token":
            return self._move_token(request)
        sockets = self._clients
        if sockets is None or not is_upgrade(request) or request.path not in WEBSOCKET_PATHS:
            return await handler(request)
        try:
            return await sockets.handle(request)  # until it has ended
        except web.HTTPBadRequest as error:  # of aiohttp's handshake
            text = (error.text or "").partition("\n")[0][:_SHOWN]
            sockets.refuse(request.remote or "?", "handshake", text)
            raise Problem(400, f"not the handshake of a WebSocket: {text}") from None

    def _place(self, request: web.Request) -> Place:
        path = request.path
        if path == _HEALTH:
            return "open"
        if path in PICTURES:
            return "pictures"
        _, content_type = self._pages.get(path, (b"", ""))
        is_page = content_type.startswith("text/html") and not is_upgrade(request)
        return "page" if is_page or (path == VIEWER and self._video is not None) else ""

    def _sharing(self, request: web.Request) -> dict[str, str]:
        """Headers that let pages of listed sites read a response; those of the pages' own files are not shared."""
        if not self._policy.origins or request.path in self._pages:
            return {}
        origin = request.headers.get("Origin")
        allowed = {"Access-Control-Allow-Origin": origin} if origin is not None and self._policy.lists(origin) else {}
        return {"Vary": "Origin", **allowed}

    def _refused(self, request: web.Request, problem: Problem) -> web.Response:
        """The response that says a problem: a page to people, as programs ask for no HTML; else its details."""
        shown, content_type = problem.body, "application/problem+json"
        if problem.reason:
            address = request.remote or "?"
            self._refusals.refuse(time.monotonic(), problem.reason, address, f"{address}: {problem.detail}")
            if not is_upgrade(request) and "text/html" in request.headers.get("Accept", ""):
                text, help_ = html.escape(problem.detail), _SIGN_IN if problem.status == 401 else ""
                shown = _REFUSED_PAGE.format(text=text[:1].upper() + text[1:], help=help_).encode()
                content_type = "text/html; charset=utf-8"
        response = web.Response(status=problem.status, body=shown, headers={"Content-Type": content_type})
        if problem.status == 401:
            response.headers["WWW-Authenticate"] = 'Bearer realm="rmpa"'
        elif problem.status == 405:
            response.headers["Allow"] = ", ".join(_METHODS)
        guard = guard_of(request)
        if request.body_exists or (guard is not None and guard.phase is ConnectionPhase.UPGRADED):
            response.force_close()  # what comes behind is the body, or is not looked at any more
        return response

    def _move_token(self, request: web.Request) -> web.Response:
        query = {name: value for name, value in request.query.items() if name != TOKEN_PARAMETER}
        response = web.Response(status=303, headers={"Location": str(request.rel_url.with_query(query))})
        token = request.query[TOKEN_PARAMETER]
        # Strict would leave the cookie out of the redirected request where the link stands on a page of another site,
        # and of each reload behind it. Lax sends it with such a navigation alone, which no other site can read.
        response.set_cookie(
            self._policy.cookie, token, httponly=True, secure=request.secure, samesite="Lax", path="/"
        )
        return response

    async def _page(self, request: web.Request) -> web.Response:
        body, content_type = self._pages[request.path]
        return web.Response(body=body, headers={"Content-Type": content_type})

    async def _health(self, _request: web.Request) -> web.Response:
        reading = await self._watch.reading()
        if reading.snapshot is None:
            raise Problem(503, "the agent does not answer")
        return web.Response(text="ok\n")

    async def _api(self, request: web.Request) -> web.Response:
        reading = await self._watch.reading(whole=True)
        body = api.respond(request.rel_url.raw_path, reading.snapshot, reading.problem)
        return web.Response(body=body, headers={"Content-Type": "application/json"})

    async def _metrics(self, request: web.Request) -> web.Response:
        form = api.content_type(request.headers.get("Accept", ""))
        reading = await self._watch.reading()
        async with self._encoding:  # once for all; 2,000 routes take 0.1 s, in a thread
            made = self._encoded.get(form)
            if made is None or made[0] != reading.number:
                metrics = itertools.chain(api.metrics(reading.snapshot), self._own_metrics())
                made = reading.number, await asyncio.to_thread(api.exposition, metrics, form)
                self._encoded[form] = made
        return web.Response(body=made[1], headers={"Content-Type": form})

    def _own_metrics(self) -> Iterator[api.Metric]:
        sockets, table = self._clients, self._table
        connections = (len(table.open), table.accepted) if table is not None else (0, 0)
        refused = self.counters.as_dict() | (sockets.counters.as_dict() if sockets is not None else {})
        reads, clients = (self._watch.reads, self._watch.seconds), sockets.figures() if sockets is not None else {}
        return api.web_metrics(connections, self._responses.as_dict(), refused, reads, clients)

    def _access_logger(self) -> type[AbstractAccessLogger]:
        """The class that is told of every response, also of those to bytes that are no HTTP."""
        count = self._count

        class CountingAccessLogger(AbstractAccessLogger):
            def log(self, request: web.BaseRequest, response: web.StreamResponse, time: float) -> None:  # noqa: ARG002
                count(request, response.status)

        return CountingAccessLogger

    def _count(self, request: web.BaseRequest, status: int) -> None:
        self._responses.add(str(status))
        if _JUDGED not in request:
            address = request.remote or "?"
            text = f"{address}: not HTTP/1.1, or a header beyond a limit (docs/reference/limits.md)"
            self._refusals.refuse(time.monotonic(), "malformed", address, text)
