"""A server of the monitor that replays recorded snapshots of the demo: for tests, and to work on the pages.

    python -m tests.web.monitor.fake_server [SCENE]

It has the real pages and the real ``MonitorSession``; the agent, the hub and all answers are made up here.
Scenes: ``demo`` (all is well), ``killed`` (the module base was killed), ``sick`` (one of each state, and alarms),
``large`` (16 modules, 300 topics), ``mute`` (the agent does not answer), ``sensors`` (a laser and a camera),
``cut`` (18,000 topics are left out), ``knock`` (modules that are not of this mesh, at its authority), ``ill`` (nodes
report errors on /diagnostics), ``wrapped`` (a camera that is described by a file).
"""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import json
import math
import struct
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import msgspec
from aiohttp import WSMsgType, web

from rmpa.bridge.log_ring import LogQuery, LogRing, ModuleLog
from rmpa.core.contract import ContractRule, Contracts
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.core.facts import LaneInfo, RouteInfo, TopicInfo
from rmpa.core.identity import OWN_NODE
from rmpa.observe.snapshot import ModuleFacts, PeerInfo, Snapshot
from rmpa.observe.snapshot_builder import judge_stranger
from rmpa.observe.why.services import diagnose_module
from rmpa.trust.permissions import TrustReason, TrustStatus
from rmpa.web.hub.frame_writer import Opcode
from rmpa.web.hub.node_link import FULL
from rmpa.web.hub.topics import ReceivedMessage
from rmpa.web.monitor.diagnostics import DiagnosticsFeed
from rmpa.web.monitor.driving import TYPES, Sticks
from rmpa.web.monitor.messages import SUBPROTOCOL, Tree
from rmpa.web.monitor.resources import ResourceFacts
from rmpa.web.monitor.session import MonitorSession
from rmpa.web.monitor.state import StateBuilder, details, node_detail, node_key
from rmpa.web.pictures import png_file
from rmpa.web.server.app import HEADERS
from tests.web.monitor import wrapped
from tests.web.monitor.recorded import Recordings
from tests.web.monitor.test_sticks import Bus
from tests.web.recorder import FakeHub, PageConnection, Recorded

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

FIXTURES = Path(__file__).with_name("fixtures")
STATIC = Path(__file__).parents[3] / "src/rmpa/web/static"
TICK = 0.1
replace = msgspec.structs.replace
_SPEEDS = struct.Struct("<6d")
_SENSORS = {
    "/scan": "sensor_msgs/LaserScan",
    "/camera/image": "sensor_msgs/CompressedImage",
    "/camera/raw": "sensor_msgs/Image",
    "/camera/raw/compressed": "sensor_msgs/CompressedImage",
}


def snapshots() -> list[Snapshot]:
    """Two with all modules, base just killed, base long gone, and two with base back; as the module pc saw them."""
    lines = (FIXTURES / "demo.jsonl").read_text(encoding="utf-8").splitlines()
    return [msgspec.json.decode(line, type=Snapshot) for line in lines]


def resources() -> list[ResourceFacts]:
    """The demo's Smart Resources."""
    return msgspec.convert(json.loads((FIXTURES / "resources.json").read_text())["resources"], list[ResourceFacts])


# What nodes report in the scene ``ill``: node, hardware, name, level, message.
REPORTS = [
    ("/rmpa/base/arm_driver", "SN 4711", "arm_driver: Battery/Cell 1", 2, "too hot"),
    ("/rmpa/base/arm_driver", "SN 4711", "arm_driver: Battery/Cell 2", 0, "fine"),
    ("/rmpa/base/laser", "", "laser: Frequency Status", 0, "Desired frequency met"),
    ("/camera", "cam-7", f"camera: {'a_status_whose_name_has_about_sixty_letters_' * 2}", 1, "<b>late</b>"),
    ("/rmpa", "pc", "rmpa: this module", 2, "the agent's own"),
]


def reported(source: str, voltage: float) -> list[dict[str, Any]]:
    """The statuses of one message of a node, with a number, a text and NaN."""
    figures = {"Voltage": f"{voltage:.2f} V", "Address": "10.0.0.1", "Current": "nan", "__proto__": "1"}
    values = [{"key": key, "value": value} for key, value in figures.items()]
    return [
        {"name": name, "hardware_id": hardware, "level": level, "message": message, "values": values}
        for node, hardware, name, level, message in REPORTS
        if node == source
    ]


class Reports:
    """The hub and the values of the diagnostics: each node reports when it is asked to."""

    def __init__(self) -> None:
        self.take: Callable[[Any], None] = lambda _: None
        self.topics = self
        self.graph = SimpleNamespace(
            topics={"/diagnostics": SimpleNamespace(publishers=[node for node, *_ in REPORTS])}
        )
        self.silent = False

    def subscribe(self, _topic: str, _type: str, take: Callable[[Any], None], _failed: object) -> Any:
        self.take = take
        return SimpleNamespace(close=lambda: None)

    def values(self, message: Any) -> Any:
        return message.values

    def report(self) -> None:
        for source in () if self.silent else dict.fromkeys(node for node, *_ in REPORTS):
            status = reported(source, 24 + math.sin(time.time()))
            self.take(SimpleNamespace(source=source, payload=b"", values={"status": status}))


def outside(name: str, trust: TrustStatus) -> PeerInfo:
    """A module without keys that knocks."""
    shown = judge_stranger(name, TrustReason.UNSECURED, "", trust=trust, members={"pc", "base"})
    assert shown is not None
    state, text, invite = shown
    guid = f"10.0.0.9:4000{len(name)}#7"
    return PeerInfo(name=name, guid=guid, instance="", state=state, since_ago=9.0, last_error=text, invite=invite)


class FakeAgent:
    """Snapshots that look alive: counters grow, rates wobble within a percent."""

    def __init__(self, scene: str = "demo") -> None:
        self.scene = scene
        self._recorded = snapshots()
        self._resources = resources()
        self.started = time.time() - 93.0
        self._since: dict[str, float] = {}

    def snapshot(self) -> Snapshot:
        """The newest snapshot of the scene."""
        now = time.time()
        base = self._recorded[0]
        if self.scene == "killed":
            base = self._recorded[2 if now - self._since.setdefault("killed", now) < 1 else 3]
        else:
            self._since.clear()
            base = getattr(self, f"_{self.scene}", lambda same: same)(base)
        age, wobble = now - self.started, 1 + 0.004 * math.sin(now * 3)

        def alive(route: RouteInfo) -> RouteInfo:
            rate = route.rate or 0
            age_now = route.age and abs(math.sin(now * 7)) / (route.rate or 1)
            return replace(route, rate=rate * wobble or None, messages=int(route.messages + rate * age), age=age_now)

        peers = tuple(self._peer(peer, age, now) for peer in base.peers)
        topics = tuple(replace(topic, routes=tuple(map(alive, topic.routes))) for topic in base.topics)
        agent = replace(base.agent, started=self.started, uptime=age, cpu=11 + 2 * math.sin(now / 3))
        return replace(base, agent=agent, taken=now, peers=peers, topics=topics)

    def _peer(self, peer: PeerInfo, age: float, now: float) -> PeerInfo:
        if (link := peer.link) is None:
            return peer
        sick = self.scene == "sick"
        lanes = (
            LaneInfo(name="express", connected=True, bytes_in=int(400 * age), bytes_out=int(300 * age)),
            LaneInfo(name="bulk", connected=not sick, queued=9000 * sick),
        )
        came, went = (int(count / 90 * age) for count in (link.bytes_in, link.bytes_out))
        rtt = (link.rtt or 3e-4) * (1 + 0.1 * math.sin(now * 5))
        link = replace(link, bytes_in=came, bytes_out=went, rtt=rtt, up_ago=age, lanes=lanes)
        return replace(peer, link=link, since_ago=age)

    def facts(self) -> list[ResourceFacts]:
        """The resources of the scene."""
        ill = {
            "velocity": {"level": "WARN", "message": "adapting: acceleration 3.2 m/s² instead of at most 1 m/s²"},
            "joystick": {"level": "ERROR", "message": "non-adaptable: rate 3 Hz is below 10 Hz in every profile"},
        }
        if self.scene == "sick":
            return [replace(one, health=(one.health or {}) | ill.get(str(one.peer), {})) for one in self._resources]
        if self.scene == "wrapped":
            return [*self._resources, wrapped.camera(self.started, time.time())]
        return [one for one in self._resources if (one.peer, self.scene) != ("base", "killed")]

    def alarms(self) -> list[Tree]:
        """The alarms that stand."""
        about: Tree = {"at": round(self.started + 40, 1)}
        return [
            {"id": one.key, "module": str(one.peer), "resource": one.key, "level": one.level, **about}
            | {"text": str((one.health or {})["message"])}
            for one in self.facts()
            if self.scene == "sick" and one.level in ("WARN", "ERROR")
        ]

    def _sick(self, base: Snapshot) -> Snapshot:
        linked = {peer.name: peer for peer in base.peers}
        some, link = linked["base"], linked["velocity"].link
        assert link is not None
        lost: dict[str, dict[str, Any]] = {
            "arm": {"state": "linking", "beacon_ago": 2.0, "last_error": "10.0.0.7:40001: timed out"},
            "camera": {"state": "refused", "last_error": "is of version 0.0.9, this one of 0.1.0"},
            "gripper": {"state": "linking", "beacon_ago": 60.0, "last_error": "No route to host"},
        }
        gone = (replace(some, name=name, link=None, **about) for name, about in lost.items())
        silent = replace(linked["velocity"], link=replace(link, heard_ago=1.8))
        differ = ("/pc expects geometry_msgs/TwistStamped, /velocity publishes geometry_msgs/Twist",)
        topics = tuple(
            replace(topic, mismatches=differ) if topic.name == "/velocity_order" else topic for topic in base.topics
        )
        notes = ("multicast does not leave eth0: is there a firewall?",)
        return replace(base, peers=(*gone, linked["joystick"], silent, some), topics=topics, notes=notes)

    def _sensors(self, base: Snapshot) -> Snapshot:
        odom = next(topic for topic in base.topics if topic.name == "/odom")
        more = (replace(odom, name=name, type=kind) for name, kind in _SENSORS.items())
        return replace(base, topics=(*base.topics, *more))

    def _cut(self, base: Snapshot) -> Snapshot:
        return replace(base, topics=tuple(each for each in base.topics if each.name != "/odom"), topics_left=18_000)

    def _knock(self, base: Snapshot) -> Snapshot:
        trust = TrustStatus(on=True, module="pc", is_authority=True, authority="pc", revoked=("old",))
        strangers = tuple(outside(name, trust) for name in ("arm", "base", "old"))
        return replace(base, trust=trust, strangers=strangers)

    def _large(self, base: Snapshot) -> Snapshot:
        some = next(peer for peer in base.peers if peer.name == "base")
        odom, idle = (next(each for each in base.topics if each.name == name) for name in ("/odom", "/base/context"))

        def topic(name: str, at: int, number: int) -> TopicInfo:
            like, rate = (odom, 1.0 + (at * 7 + number * 13) % 60) if number < 6 else (idle, None)
            routes = tuple(replace(route, peer=name, rate=route.rate and rate) for route in like.routes)
            return replace(like, name=f"/{name}/topic_{number:02d}", routes=routes)

        names = [f"module_{number:02d}" for number in range(1, 16)]
        topics = tuple(topic(name, at, number) for at, name in enumerate(names) for number in range(20))
        return replace(base, peers=tuple(replace(some, name=name) for name in names), topics=topics)


class FakeServer:
    """The pages, and one ``MonitorSession`` for each WebSocket; ``agent.scene`` changes the scene."""

    def __init__(self, scene: str = "demo") -> None:
        self.agent = FakeAgent(scene)
        self.rights = dataclasses.replace(FULL, drive=True)
        self.hears = asyncio.Event()
        self.hears.set()
        # Whether nodes publish; else nothing live comes any more.
        self.publishes = True
        self.speeds: list[SimpleNamespace] = []
        self.reports: list[str] = []
        self.asked: list[SimpleNamespace] = []
        self.pages = itertools.count(7)
        bus: Any = Bus()
        self.sticks = Sticks(bus, lambda: "pc")
        self.params: dict[str, Any] = {
            "/rosdistro": "noetic",
            "/use_sim_time": False,
            "/base": {"rate": 50.0, "wheel": {"radius": 0.035, "track": 0.23}, "topics": ["odom", "imu"]},
        }
        self.driven = {"/cmd_vel": {"type": "geometry_msgs/Twist", "nodes": ["base:/base", "base:/safety_stop"]}}
        # Of each module the log that its agent keeps: its lines, and what is wrong with it.
        self.logs = {name: LogRing(time.time_ns()) for name in ("pc", "base", "velocity")}
        self.log_problems = {"joystick": "its agent is of an earlier release, which has no log for others"}
        self.levels = {"rosout": "info", "rospy.core": "warn"}
        self.raw = bytes(1280 * 3 * 360) + bytes((0, 0, 255)) * (1280 * 360)
        self._params_told: dict[str, Any] = {}
        self._param_changes = 0
        self._builder = StateBuilder("pc")
        self._snapshot = self.agent.snapshot()
        self._state: Tree = {}
        self._odometry = json.loads((FIXTURES / "odometry.json").read_text())
        self._answers = json.loads((FIXTURES / "answers.json").read_text())
        self._mute_since = 0.0
        self.reports_of_nodes = Reports()
        reports: Any = self.reports_of_nodes
        self._diagnostics = DiagnosticsFeed(reports, lambda: None)
        self._reported = 0.0
        self.recordings = Recordings()
        # Where the files of resources are, while it is served.
        self.folder = Path()

    def app(self) -> web.Application:
        """The application."""
        app = web.Application()
        app.router.add_get("/monitor", self._socket)
        app.router.add_get("/", self._index)
        app.router.add_post("/csp", self._report)
        app.router.add_static("/static", STATIC)
        self.recordings.add_to(app)
        app.on_response_prepare.append(self._headers)
        app.cleanup_ctx.append(self._files)
        return app

    async def _files(self, _app: web.Application) -> AsyncIterator[None]:
        with tempfile.TemporaryDirectory() as folder:
            self.folder = Path(folder)
            self._descriptions = wrapped.CheckedHere(self.folder)
            yield

    async def _headers(self, _request: web.Request, response: web.StreamResponse) -> None:
        response.headers.update(HEADERS)
        response.headers["Content-Security-Policy"] += "; report-uri /csp"

    async def _index(self, _request: web.Request) -> web.FileResponse:
        return web.FileResponse(STATIC / "index.html")

    async def _report(self, request: web.Request) -> web.Response:
        self.reports.append(await request.text())
        return web.Response()

    def _next_state(self) -> Tree:
        if self.agent.scene == "mute":
            self._mute_since = self._mute_since or time.time()
            return self._builder.unreachable(
                self._mute_since, "no agent at /run/rmpa/pc.sock", "Start one with `rmpa up`."
            )
        self._mute_since = 0.0
        self._snapshot = self.agent.snapshot()
        if self.params != self._params_told:
            self._params_told = dict(self.params)
            self._param_changes += 1
        self._diagnostics.follow()
        if self.agent.scene == "ill" and time.time() - self._reported > 0.5:
            self._reported = time.time()
            self.reports_of_nodes.report()
        state = self._builder.build(
            self._snapshot, self.agent.facts(), self.agent.alarms(), parameters=self._param_changes
        )
        return state | {"diagnostics": self._diagnostics.summary}

    def _details(self, kind: str, name: str) -> Tree | None:
        if kind.startswith("diagnostic"):
            return self._diagnostics.all() if kind == "diagnostics" else self._diagnostics.one(name)
        if kind == "rates":
            measured: Tree = {
                topic.name: {"rate": float(number % 7), "bandwidth": 8.0 * number, "how": "counted"}
                for number, topic in enumerate(self._snapshot.topics)
            }
            return measured | {"/odom": {"how": "no subscriber"}}
        return details(self._snapshot, {one.key: one for one in self.agent.facts()}, kind, name)

    async def _socket(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(protocols=(SUBPROTOCOL,), max_msg_size=2**20)
        await self.hears.wait()
        await socket.prepare(request)
        client = _Client(self, socket)
        beat = asyncio.ensure_future(client.run())
        try:
            async for message in socket:
                if message.type is WSMsgType.TEXT:
                    client.session.received_frame(message.data, time.monotonic())
                    await client.flush()
        finally:
            beat.cancel()
            client.session.closing()
            await client.flush()
        return socket

    def odometry(self) -> dict[str, Any]:
        """A nav_msgs/Odometry of the recorded drive."""
        at = time.time() * 10 % len(self._odometry)
        _, x, y, z, w, forward, turn = self._odometry[int(at)]
        pose = {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": z, "w": w}}
        twist = {"linear": {"x": forward, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": turn}}
        header = {"seq": int(at), "stamp": {"secs": int(time.time()), "nsecs": 0}, "frame_id": "odom"}
        return {
            "header": header,
            "child_frame_id": "base_link",
            "pose": {"pose": pose, "covariance": [0.0] * 36},
            "twist": {"twist": twist},
        }

    async def answer(self, what: str, args: dict[str, Any]) -> Any:
        """The answer to a question of a page.

        Raises:
            RmpaError: There is none.
        """
        self.asked.append(SimpleNamespace(what=what, args=args))
        try:
            if what.endswith(("recording", "recordings")):
                return self.recordings.answer(what, args)
            return self._answers[what] if what in self._answers else getattr(self, f"_answer_{what}")(args)
        except (AttributeError, LookupError):
            raise RmpaError(f"this server cannot answer {what}") from None

    def _answer_why(self, args: dict[str, Any]) -> Any:
        if args["kind"] == "module":
            told = msgspec.convert(self._answer_agent({"peer": args["name"]}), ModuleFacts)
            return msgspec.to_builtins((diagnose_module(self._snapshot, args["name"], told),))
        flows = self._answers["flows"]
        if self.agent.scene == "demo":
            return [flows]
        text = "no linked peer publishes it"
        failed = {"name": "publisher", "verdict": "fail", "text": text, "remedy": "start the module base"}
        return [{**flows, "flows": False, "stages": [*flows["stages"][:2], failed]}]

    def _answer_driven(self, _args: dict[str, Any]) -> Any:
        cars = {"/car/drive": {"type": "ackermann_msgs/AckermannDrive", "nodes": []}}
        return {"topics": {**self.driven, **cars}, "types": [*TYPES]}

    def _answer_params(self, args: dict[str, Any]) -> Any:
        digest = str(hash(json.dumps(self.params)))
        return {"digest": digest} if args.get("has") == digest else {"values": self.params, "digest": digest}

    def _answer_set_param(self, args: dict[str, Any]) -> Any:
        self.params[str(args["name"])] = args["value"]
        return self._answer_params({})

    def _answer_delete_param(self, args: dict[str, Any]) -> Any:
        self.params.pop(str(args["name"]), None)
        return self._answer_params({})

    def _answer_agent(self, args: dict[str, Any]) -> Any:
        if args["peer"] == "joystick":
            raise LookupError("agent, as one of an earlier release")
        return self._answers["figures"] | {"version": self._snapshot.agent.version}

    def _answer_contract(self, args: dict[str, Any]) -> Any:
        terms = Contracts((ContractRule(("/velocity*",), (), {"max_rate": 20.0}),)).explain(args["topic"], "")
        return {key: {"value": value, "rule": rule} for key, (value, rule) in terms.items()}

    def _answer_node(self, args: dict[str, Any]) -> Any:
        known = node_detail(self._snapshot, node_key(args["peer"], args["name"]))
        if known is None:
            raise LookupError(args["name"])
        types = {topic.name: topic.type for topic in self._snapshot.topics}
        publishes, subscribes, services = (
            cast("list[str]", known[part]) for part in ("publishes", "subscribes", "services")
        )
        other = {"inbound": False, "other": "/rosout", "connected": True}
        return self._answers["process"] | {
            "name": args["name"],
            "publications": {each: types[each] for each in publishes},
            "subscriptions": {each: types[each] for each in subscribes},
            "services": [each.rpartition(":")[2] for each in services],
            "connections": [{"topic": each, **other} for each in publishes],
        }

    def _answer_past(self, args: dict[str, Any]) -> Any:
        if self.agent.scene == "wrapped":
            return wrapped.past(self.agent.started)
        return self._diagnostics.past(args["status"])

    def _answer_types(self, _args: dict[str, Any]) -> Any:
        return {"/base/set_parameters": "dynamic_reconfigure/Reconfigure"}

    def _answer_graph(self, args: dict[str, Any]) -> Any:
        nodes: dict[str, Any] = {}
        for each in self._snapshot.topics:
            publishers = [*each.publishers, *(proxy(one) for one in each.routes if one.direction == "in")]
            nodes[each.name] = [each.type, publishers, each.subscribers]
        digest = str(hash(str(nodes)))
        return {"digest": digest} | ({"topics": nodes, "hidden": 0} if args.get("has") != digest else {})

    def _answer_call(self, args: dict[str, Any]) -> Any:
        return {"response": {"success": True, "message": f"as asked: {args['request']}"}, "seconds": 0.0031}

    def _answer_invite(self, args: dict[str, Any]) -> Any:
        return {"line": f"rmpa trust join rmpa1-for{args['name']}{'x' * 80}", "until": int(time.time()) + 900}

    def _answer_log(self, args: dict[str, Any]) -> Any:
        now = time.time_ns()
        for module, node, level in (("pc", "/pc", 2), ("base", "/base", 4), ("velocity", OWN_NODE, 2)):
            self.logs[module].add(node, level, now, f"turn {next(self.pages)} of {module}".encode())
        told = []
        for module in args.get("modules", [*self.logs, *self.log_problems]):
            query = LogQuery.of({**args, "after": args["after"].get(module, 0)})
            found = self.logs[module].find(query, now) if module in self.logs else None
            error = {"pc": 0.0, "base": 0.0001}.get(module, 0.012)
            told.append(
                msgspec.structs.replace(found, module=module, error=error)
                if found is not None
                else ModuleLog(module=module, problem=self.log_problems.get(module, "it is silent"))
            )
        return msgspec.to_builtins(told)

    def _answer_log_levels(self, _args: dict[str, Any]) -> Any:
        return self.levels

    def _answer_set_log_level(self, args: dict[str, Any]) -> Any:
        return dict.fromkeys((args["logger"],) if args["logger"] else ("rosout", "ros"), args["level"])

    def _answer_launches(self, _args: dict[str, Any]) -> Any:
        return wrapped.launches(self.agent.started, time.time()) if self.agent.scene == "wrapped" else []

    def _answer_top(self, _args: dict[str, Any]) -> Any:
        return wrapped.top(self.agent.started, time.time())

    def _answer_launch(self, args: dict[str, Any]) -> Any:
        if args["do"] == "log":
            lines = [] if args["after"] else ["[INFO] using /dev/video0", "[WARN] unknown control 'focus_auto'"]
            return {"logs": [{"source": "driver", "lines": lines, "next": 2}]}
        if args.get("module"):
            raise PeerRefused(args["module"], "pc may not launch base", "[[permission]] of base: launch")
        return {}

    def _answer_description(self, args: dict[str, Any]) -> Any:
        return self._descriptions.read(args["file"])

    def _answer_check_description(self, args: dict[str, Any]) -> Any:
        return {"problems": self._descriptions.check(args["file"], args["text"])}

    def _answer_save_description(self, args: dict[str, Any]) -> Any:
        return self._descriptions.save(args["file"], args["text"], args["digest"])

    def _answer_configure(self, args: dict[str, Any]) -> Any:
        return {"value": args["value"], "text": f"{args['name']} is {args['value']} now"}


def proxy(route: RouteInfo) -> str:
    """The node that stands for a peer's."""
    return f"/rmpa/{route.peer}{route.node}"


class _Client(Recorded):
    """One page: the real session, with the calls of the hub written down and what it sends."""

    def __init__(self, server: FakeServer, socket: web.WebSocketResponse) -> None:
        self._server = server
        self._socket = socket
        monitor: Any = SimpleNamespace(
            module="pc",
            details=server._details,
            follow=lambda *_: None,
            unfollow=lambda _: None,
            answers=server,
            sticks=server.sticks,
        )
        hub: Any = FakeHub()
        hub.values = self._decode
        address = f"10.0.0.{next(server.pages)}"
        super().__init__(MonitorSession(hub, server.rights, address, monitor, time.monotonic))
        self.page = self.connection = self.session.connection = PageConnection(self)

    def _decode(self, message: ReceivedMessage) -> Any:
        topic = message.topic
        if "scan" in topic:
            ranges = [_room(number * math.pi / 180) for number in range(360)]
            limits = {"angle_min": 0.0, "angle_increment": math.pi / 180, "range_min": 0.1, "range_max": 8.0}
            return {**limits, "ranges": ranges}
        if topic == "/camera/raw":
            return {"width": 1280, "height": 720, "encoding": "bgr8", "step": 3840, "data": self._server.raw}
        if "camera" in topic:
            return {"format": "png", "data": _png(160, 120, time.time())}
        if topic == "/odom":
            return self._server.odometry()
        return {"data": f"<script>alert(1)</script> {int(time.time())}", "values": list(range(200))}

    async def run(self) -> None:
        self.session.opened()
        for tick in itertools.count():
            if tick % 2 == 0:
                self.session._update(self._server._next_state())
            for asked in self.all("subscribe"):
                kind = next((kind for name, kind in _SENSORS.items() if name == asked.topic), "nav_msgs/Odometry")
                if not asked.closed and self._server.publishes:
                    asked.receive(ReceivedMessage(asked.topic, kind, memoryview(b"\0" * 712), time.time_ns()))
            self.session.handle_timer(time.monotonic())
            await self.flush()
            await asyncio.sleep(TICK)

    async def flush(self) -> None:
        """Do what the session has said since the last call."""
        for opcode, (data,) in self.frames():
            if self._socket.closed:
                break
            if opcode is Opcode.TEXT:
                await self._socket.send_str(bytes(data).decode())
            else:
                await self._socket.send_bytes(bytes(data))
        for asked in self.all("advertise"):
            for speed in map(_SPEEDS.unpack, asked.published):
                self._server.speeds.append(SimpleNamespace(linear=speed[0], angular=speed[5]))
            asked.published.clear()
        if self.page.ended:
            await self._socket.close(code=self.page.ended[0], message=self.page.reason.encode())


def _room(angle: float) -> float:
    """Metres to the walls of a room of 6 m by 4 m, with a pillar."""
    walls = min(3 / max(abs(math.cos(angle)), 1e-6), 2 / max(abs(math.sin(angle)), 1e-6))
    return 1.4 if abs(angle - 0.8) < 0.12 else walls


def _png(width: int, height: int, at: float) -> bytes:
    shift = int(at * 20)
    return png_file(width, height, 0, (bytes((x + y + shift) & 255 for x in range(width)) for y in range(height)))


if __name__ == "__main__":
    web.run_app(FakeServer(*sys.argv[1:]).app(), host="127.0.0.1", port=8480)
