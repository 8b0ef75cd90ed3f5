"""Clients that others wrote, unmodified, against ``rmpa web`` over two linked agents.

They connect beside the agent ``base``; what they read, call and command is in the module of the agent ``arm``.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.metadata
import importlib.util
import io
import itertools
import json
import os
import random
import re
import shutil
import socket
import subprocess
import sys
import tarfile
from typing import TYPE_CHECKING, Any, Final

import aiohttp.web
import pytest

from lab.bed import ros
from lab.bed.agents import Agent
from lab.bed.chromium import Chromium
from lab.bed.http_client import http_client
from lab.bed.namespaces import MACHINE, Host, Lab
from lab.bed.processes import DEADLINE, Process
from lab.bed.ros import free_port
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import known_specifications, known_types
from tests.interop import npm
from tests.interop.web import PORT, Web, needs_browser
from tests.ros.types.filled import filled, filled_message
from tests.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from tests.interop.conftest import AgentFactory, WebFactory

RUN: Final = 120.0
pytestmark = pytest.mark.timeout(2 * RUN)


@pytest.fixture(scope="module")
def agents(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Agent, Agent]]:
    """Two linked agents on this machine."""
    home = tmp_path_factory.mktemp("agents")
    with Agent(MACHINE, home, name="base") as base, Agent(MACHINE, home, name="arm") as arm:
        for each in (base, arm):
            each.start()
        for each in (base, arm):
            each.wait_ready()
            each._close_notify()  # a test that is the first to need them would count it as a socket left open
        base.wait_peer("arm")
        yield base, arm


@pytest.fixture(scope="module")
def served(agents: tuple[Agent, Agent]) -> Iterator[Web]:
    """``rmpa web --control`` beside ``base``."""
    with Web(agents[0], "--control", port=free_port()) as web:
        yield web


@pytest.fixture
async def arm(agents: tuple[Agent, Agent]) -> AsyncIterator[Node]:
    """A node of the other module."""
    async with node_of(agents[1]) as node:
        yield node


def node_of(agent: Agent) -> Node:
    """A node of an agent's module."""
    return Node("worker", master_uri=f"http://127.0.0.1:{agent.core_port}", environment=RosEnvironment())


def url(web: Web) -> str:
    """For clients that know only a URL."""
    return f"ws://{web.host}/?token={web.token}"


# --- JavaScript -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", ["roslib1", "roslib2", "@foxglove/roslibjs"])
def test_roslibjs_works_unmodified(package: str, served: Web) -> None:
    home = npm.packages() / package
    with Process(["node", npm.CLIENTS / "roslib.mjs", home, url(served)], name=package) as client:
        assert client.wait(RUN) == 0, client.output
        assert client.lines[-1] == "ok"


@pytest.mark.parametrize("package", ["roslib1", "roslib2"])
async def test_roslibs_tf_clients_follow_a_robot_of_another_module(package: str, served: Web, arm: Node) -> None:
    tf = await arm.advertise("/tf", "tf2_msgs/TFMessage")
    fixed = await arm.advertise("/tf_static", "tf2_msgs/TFMessage", latch=True)
    fixed.publish(fixed.make({"transforms": [placed("base", "laser", 0.5)]}))
    with Process(["node", npm.CLIENTS / "tf.mjs", npm.packages() / package, url(served)], name=package) as client:
        for number in itertools.count():
            if client.returncode is not None or "ok" in client.output:
                break
            tf.publish(tf.make({"transforms": [placed("odom", "base", number * 0.1)]}))
            await asyncio.sleep(0.05)
        assert await client.ended() == 0, client.output
        assert client.lines[-1] == "ok"


# A robot's odometry and map as rospy publishes them; it needs Debian's ROS.
ROBOT: Final = """
import rospy, nav_msgs.msg, geometry_msgs.msg, tf2_msgs.msg
rospy.init_node("robot", disable_signals=True)
grid = rospy.Publisher("/map", nav_msgs.msg.OccupancyGrid, latch=True, queue_size=1)
world = nav_msgs.msg.OccupancyGrid()
world.header.frame_id, world.info.resolution, world.info.width, world.info.height = "odom", 0.1, 40, 30
world.info.origin.orientation.w, world.data = 1.0, [100 if n % 40 in (0, 39) else 0 for n in range(1200)]
grid.publish(world)
tf = rospy.Publisher("/tf", tf2_msgs.msg.TFMessage, queue_size=10)
place = geometry_msgs.msg.TransformStamped(child_frame_id="base")
place.header.frame_id, place.transform.rotation.w = "odom", 1.0
while not rospy.is_shutdown():
    place.header.stamp = rospy.get_rostime()
    place.transform.translation.x += 0.01
    tf.publish([place])
    rospy.sleep(0.02)
"""
# ros3djs and ros2djs as their users write them.
VIEWER: Final = """<!doctype html><title>viewer</title><link rel="icon" href="data:,">
<div id="map"></div><div id="world"></div>
<script src="/easeljs/lib/easeljs.min.js"></script><script src="/roslib1/build/roslib.js"></script>
<script src="/eventemitter2/lib/eventemitter2.js"></script><script src="/ros2d/build/ros2d.js"></script>
<script src="/ros3d/build/ros3d.js"></script>
<script>
const ros = new ROSLIB.Ros({ url: URL_OF_ROSBRIDGE });
const tfClient = new ROSLIB.TFClient({ ros, fixedFrame: "odom", angularThres: 0.01, transThres: 0.01, rate: 20 });
window.axes = new ROS3D.Axes();
window.robot = new ROS3D.SceneNode({ tfClient, frameID: "base", object: window.axes });
try {
  const view = new ROS3D.Viewer({ divID: "world", width: 500, height: 400, antialias: true });
  view.addObject(new ROS3D.Grid());
  view.addObject(window.robot);
  window.drawn = true;
} catch (error) { window.drawn = String(error); } // without WebGL
const flat = new ROS2D.Viewer({ divID: "map", width: 400, height: 300 });
window.grid = new ROS2D.OccupancyGridClient({ ros, rootObject: flat.scene });
window.grid.on("change", () => flat.scaleToDimensions(window.grid.currentGrid.width, window.grid.currentGrid.height));
</script>"""


@needs_browser
async def test_ros3d_and_ros2d_draw_the_robot_of_another_module(agents: tuple[Agent, Agent]) -> None:
    if reason := ros.why_not():
        pytest.skip(reason)
    packages, port, place = npm.packages(), free_port(), free_port()
    origin = f"http://127.0.0.1:{place}"
    with (
        Web(agents[0], port=port, environ={"RMPA_WEB_ORIGINS": origin}) as web,
        Process([ros.PYTHON, "-c", ROBOT], env=ros.environment(agents[1].home, agents[1].core_port), name="robot"),
    ):
        text = VIEWER.replace("URL_OF_ROSBRIDGE", json.dumps(url(web)))
        async with site_of(packages, text, place), Chromium() as page:
            await page.goto(origin)
            await page.wait("window.robot?.position.x > 0.2")
            first = await page.run("window.robot.position.x")
            await page.wait(f"window.robot.position.x > {first + 0.2}")
            await page.wait("window.grid.currentGrid?.width > 3.9")
            assert not page.errors


@contextlib.asynccontextmanager
async def site_of(packages: Path, page: str, port: int) -> AsyncIterator[None]:
    """A web site with one page, and npm's packages beside it."""

    async def first(_request: aiohttp.web.Request) -> aiohttp.web.Response:
        return aiohttp.web.Response(text=page, content_type="text/html")

    application = aiohttp.web.Application()
    application.router.add_get("/", first)
    application.router.add_static("/", packages)
    runner = aiohttp.web.AppRunner(application, shutdown_timeout=1.0)
    await runner.setup()
    try:
        await aiohttp.web.TCPSite(runner, "127.0.0.1", port).start()
        yield
    finally:
        await runner.cleanup()


def placed(parent: str, child: str, x: float) -> dict[str, Any]:
    """A geometry_msgs/TransformStamped."""
    rotation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    place = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": rotation}
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": place}


def test_foxglove_ws_protocols_client_works_unmodified(served: Web) -> None:
    with Process(["node", npm.CLIENTS / "foxglove.mjs", npm.packages(), url(served)]) as client:
        assert client.wait(RUN) == 0, client.output
        assert client.lines[-1] == "ok"


def example(*words: str | Path) -> Process:
    """A program of @foxglove/ws-protocol-examples."""
    home = npm.packages() / "@foxglove" / "ws-protocol-examples"
    main = json.loads((home / "package.json").read_text())["main"]
    return Process(["node", home / main, *words], name=str(words[0]))


# Each type has a topic of its own below this.
KINDS: Final = "/kinds"
# Of the shipped types a third, which has all kinds of fields.
TYPES: Final = known_types()[::3]


@contextlib.asynccontextmanager
async def all_kinds(node: Node) -> AsyncIterator[dict[str, bytes]]:
    """Publish latched messages with a value in each field; yield them by type."""
    messages = {name: filled_message(name) for name in TYPES}
    for name, payload in messages.items():
        publisher = await node.advertise(f"{KINDS}/{name}", name, latch=True)
        publisher.publish_raw(payload)
    yield messages


def as_sent(values: Any) -> Any:
    """Values of @foxglove/rosmsg-serialization as rosbags was given them: they differ in how a time is written."""
    if isinstance(values, dict):
        if values.keys() == {"sec", "nsec"}:
            return {"secs": values["sec"], "nsecs": values["nsec"]}
        return {name: as_sent(each) for name, each in values.items()}
    return [as_sent(each) for each in values] if isinstance(values, list) else values


@contextlib.asynccontextmanager
async def recorder_of(file: Path, served: Web, topics: set[str]) -> AsyncIterator[Process]:
    """``mcap-record``, once it has subscribed to all of these topics.

    It attaches its handlers a moment after its connection is open, and so misses channels that the server advertises
    in the same packet as its answer to the handshake. Then it is started again.
    """
    for _ in range(10):
        with example("mcap-record", "--output", file, url(served)) as recorder:

            def missing(recorder: Process = recorder) -> set[str]:
                return topics - {*re.findall(r"subscribing to (\S+) ", recorder.output)}

            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(5.0):
                    while missing():
                        await asyncio.sleep(0.05)
            if not missing():
                yield recorder
                return
    raise AssertionError(f"mcap-record never subscribed to all of {len(topics)} topics")


async def test_messages_of_all_kinds_are_decoded_and_recorded_byte_by_byte(
    served: Web, arm: Node, tmp_path: Path
) -> None:
    mcap_reader = pytest.importorskip("mcap.reader", reason="mcap is not installed (extra web-peers)")
    mcap_ros1 = pytest.importorskip("mcap_ros1.decoder", reason="mcap-ros1-support is not installed (web-peers)")
    decode: list[str | Path] = ["node", npm.CLIENTS / "decode.mjs", npm.packages(), url(served), f"{KINDS}/"]
    filler = await arm.advertise("/filler", "std_msgs/String")
    async with all_kinds(arm) as sent:
        with Process(decode, name="decode.mjs") as decoder:
            await until(lambda: len(decoder.events("message")) >= len(sent) or decoder.returncode, "each type")
            assert decoder.returncode is None, decoder.output
            for event in decoder.events("message"):
                name = str(event["type"])
                assert event["topic"] == f"{KINDS}/{name}"
                assert event["received"] == event["again"] == sent[name].hex(), name
                assert as_sent(event["values"]) == filled(known_specifications(name), name, 1), name

            # The recorder of the examples keeps 5 MB until it writes: more follows behind what is looked for.
            file = tmp_path / "all.mcap"
            async with recorder_of(file, served, {"/filler", *(f"{KINDS}/{name}" for name in sent)}) as recorder:
                await filler.wait_for_subscriber()
                text = filler.make({"data": random.randbytes(500_000).hex()})
                while not file.exists() or file.stat().st_size < 1_000_000:
                    filler.publish(text)
                    await asyncio.sleep(0.05)
                assert await asyncio.to_thread(recorder.interrupt) == 0, recorder.output
    recorded: dict[str, list[bytes]] = {}
    with file.open("rb") as stream:
        reader = mcap_reader.make_reader(stream, decoder_factories=[mcap_ros1.DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if channel.topic.startswith(f"{KINDS}/"):
                assert channel.topic == f"{KINDS}/{schema.name}"
                recorded.setdefault(schema.name, []).append(message.data)
        decoded = [f"{KINDS}/{name}" for name in sorted(sent)[::4]]  # it compiles each type, which takes its time
        for schema, _, message, values in reader.iter_decoded_messages(topics=[*decoded]):
            again = io.BytesIO()
            values.serialize(again)
            assert again.getvalue() == message.data, schema.name
            decoded.remove(f"{KINDS}/{schema.name}")
        assert decoded == []
    assert recorded == {name: [payload] for name, payload in sent.items()}


# --- the examples of @foxglove/ws-protocol --------------------------------------------------------------------------


async def test_the_publish_example_reaches_another_module(served: Web, arm: Node) -> None:
    heard: list[str] = []
    await arm.subscribe("/chatter", "std_msgs/String", lambda message: heard.append(message.message.data))
    with example("publish-client", "--encoding", "ros1", url(served)) as client:
        await until(lambda: len(heard) > 1, "two messages")
        assert all(text.startswith("hello world ") for text in heard)
        assert await asyncio.to_thread(client.interrupt) == 0, client.output


async def test_the_service_example_calls_another_module(served: Web, arm: Node) -> None:
    def switch(request: Any) -> dict[str, object]:
        return {"success": request.data, "message": "on"}

    await arm.advertise_service("/switch", "std_srvs/SetBool", switch)
    with example("service-client", url(served)) as client:
        assert await client.ended() == 0, client.output
        assert "callId: 123" in client.output
        assert "encoding: 'ros1'" in client.output


async def test_the_parameter_example_follows_and_sets_parameters(
    agents: tuple[Agent, Agent], served: Web, arm: Node
) -> None:
    async with node_of(agents[0]) as base:
        await base.set_param("/lamp", False)
        with example("param-client", url(served)) as client:
            await client.expect("name: '/lamp', value: false")
            await client.expect("Received 1 parameter updates")  # a second after, it switches what is a boolean
            await client.expect("name: '/lamp', value: true")
            await base.set_param("/lamp", "broken")
            await client.expect("name: '/lamp', value: 'broken'")
            assert "Assertion failed" not in client.output


# --- roslibpy -------------------------------------------------------------------------------------------------------

# Where roslibpy's tests connect, without a token.
ROSBRIDGE_PORT: Final = 9090


@contextlib.asynccontextmanager
async def proxy(host: Host, web: Web) -> AsyncIterator[None]:
    """A reverse proxy of a host that adds the token, as nginx does by ``proxy_set_header``."""
    bearer = "".join(f"{name}: {value}\r\n" for name, value in web.bearer.items()).encode()

    async def copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
        writer.close()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = await reader.readuntil(b"\r\n")
        upstream = host.open_socket()
        upstream.setblocking(False)
        await asyncio.get_running_loop().sock_connect(upstream, ("127.0.0.1", PORT))
        behind, before = await asyncio.open_connection(sock=upstream)
        before.write(request + bearer)
        await asyncio.gather(copy(reader, before), copy(behind, writer))

    listening = host.open_socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listening.bind(("127.0.0.1", ROSBRIDGE_PORT))
    serving: set[asyncio.Task[None]] = set()

    def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        serving.add(asyncio.create_task(serve(reader, writer)))

    server = await asyncio.start_server(accept, sock=listening)
    try:
        yield
    finally:
        server.close()
        await asyncio.wait(serving)


@pytest.mark.long
@pytest.mark.netns
async def test_roslibpys_own_tests_pass(lab: Lab, agent: AgentFactory, web: WebFactory, tmp_path: Path) -> None:
    if importlib.util.find_spec("roslibpy") is None:
        pytest.skip("roslibpy is not installed (extra web-peers)")
    source = await asyncio.to_thread(roslibpy_source, tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", "/dev/null"]
    command += ["--rootdir", str(source), str(source / "tests" / "ros1")]

    async def run(number: int, transport: str) -> None:
        host = lab.host(transport, number)
        served = web(agent(host), "--control")
        environ = {**os.environ, "ROSLIBPY_TRANSPORT": transport}
        async with proxy(host, served):
            with Process(host.command(command), env=environ, name=f"roslibpy {transport}") as tests:
                assert await tests.ended(RUN) == 0, tests.output
                assert "25 passed" in tests.output

    await asyncio.gather(*(run(number, transport) for number, transport in enumerate(("twisted", "asyncio"))))


def roslibpy_source(folder: Path) -> Path:
    """The source distribution of the version that is installed: it has the tests."""
    version = importlib.metadata.version("roslibpy")
    command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", ":all:", "-d", str(folder)]
    command += [f"roslibpy=={version}"]
    done = subprocess.run(command, capture_output=True, timeout=RUN, text=True, check=False)
    if done.returncode and "Failed to establish a new connection" in done.stderr:
        pytest.skip("pip reaches no registry")
    assert done.returncode == 0, done.stderr
    with tarfile.open(next(folder.glob("roslibpy-*.tar.gz"))) as archive:
        archive.extractall(folder, filter="data")
    return folder / f"roslibpy-{version}"


# --- HTTP -----------------------------------------------------------------------------------------------------------


async def test_promtool_finds_nothing_wrong_with_the_metrics(
    agents: tuple[Agent, Agent], served: Web, arm: Node
) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("no promtool here (apt install prometheus)")
    numbers = await arm.advertise("/numbers", "std_msgs/Int32", latch=True)
    numbers.publish(numbers.make({"data": 1}))
    async with node_of(agents[0]) as base, http_client() as http:
        heard = asyncio.Event()
        await base.subscribe("/numbers", "std_msgs/Int32", lambda _: heard.set())
        async with asyncio.timeout(DEADLINE):
            await heard.wait()
        await served.wait_counts(http, "rmpa_route_messages_total", "topic", lambda found: "/numbers" in found)
        async with http.get(f"{served.url}/metrics", headers=served.bearer) as response:
            body = await response.read()
    done = await asyncio.to_thread(subprocess.run, [promtool, "check", "metrics"], input=body, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b""), done.stderr.decode()
