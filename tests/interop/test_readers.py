"""Readers that others wrote open a merged recording of two modules, and find in it what was published.

Foxglove's in JavaScript, mcap-ros1-support and rosbags in Python, and Debian's rosbag.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections import Counter
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import pytest

from lab.bed.processes import Process
from lab.bed.ros import PYTHON
from rmpa.record.bag import write_bag
from rmpa.record.format import CLOCK, ClockRecord, ModuleRecord, RecordedSource, SegmentWriter
from rmpa.record.merge import Timeline
from rmpa.ros.types.messages import MessageType
from tests.interop import npm
from tests.interop.conftest import ShellFactory
from tests.interop.ros import Ros
from tests.record.conftest import SECOND, START, text

RUN: Final = 60.0
# Seconds by which the clock of the module base is ahead.
AHEAD: Final = 0.25
CUSTOM: Final = "uint32 number\nstring[] words\n"


class Sent(NamedTuple):
    """A message as it was published: seconds from the start, and what it says in few words."""

    at: float
    module: str
    source: RecordedSource
    data: bytes
    words: list[str | int]

    @property
    def row(self) -> tuple[int, str, str, str, list[str | int]]:
        """What a reader has to find: time, topic, type, bytes, contents."""
        return self.time, self.source.topic, self.source.type, hashlib.sha1(self.data).hexdigest(), self.words

    @property
    def time(self) -> int:
        return START + round(self.at * SECOND)

    @property
    def caller(self) -> str:
        """Its publisher's name in a bag."""
        return f"/rmpa/{self.module}{self.source.node}"


def source(topic: str, kind: str, node: str, *, latching: bool = False) -> RecordedSource:
    known = MessageType(kind)
    return RecordedSource(topic, kind, known.md5sum, known.definition, node, latching)


def packed(*values: str | int) -> bytes:
    """Values as ROS serializes them: numbers of 32 bits, and strings."""
    made = (v if isinstance(v, int) else v.encode() for v in values)
    return b"".join(struct.pack("<I", v) if isinstance(v, int) else struct.pack("<I", len(v)) + v for v in made)


def published() -> list[Sent]:
    """What two modules published, in order."""
    joint = RecordedSource(
        "/joint",
        "lab_msgs/Joint",
        hashlib.md5(CUSTOM.strip().encode()).hexdigest(),
        CUSTOM,
        "/driver",
    )
    chatter, camera = (
        source("/chatter", "std_msgs/String", "/talker"),
        source("/image", "sensor_msgs/Image", "/camera"),
    )
    frames = source("/tf_static", "tf2_msgs/TFMessage", "/fixed", latching=True)
    tf = MessageType("tf2_msgs/TFMessage")
    fixed = tf.given(None, {"transforms": [{"child_frame_id": "laser"}, {"child_frame_id": "lens"}]})
    sent = [
        Sent(0.0, "arm", source("/map", "std_msgs/String", "/mapper", latching=True), text("the map"), ["the map"]),
        Sent(0.001, "base", frames, tf.serialize(fixed), ["laser", "lens"]),
    ]
    for n in range(30):
        at = 0.01 + n * 0.05
        sent += [
            Sent(at, "arm", joint, packed(n, 2, f"joint{n}", "é"), [f"joint{n}", "é"]),
            Sent(at + 0.01, "arm", chatter, text(f"arm {n}"), [f"arm {n}"]),
            Sent(at + 0.02, "base", chatter, text(f"base {n}"), [f"base {n}"]),
        ]
        if n % 3 == 0:
            picture = bytes((n + i) % 251 for i in range(160 * 120 * 3))
            header = packed(n, 1, 2, "lens", 120, 160, "rgb8") + b"\0" + packed(480, len(picture))
            sent.append(Sent(at + 0.03, "base", camera, header + picture, [160, 120, "rgb8"]))
    return sent


@pytest.fixture(scope="module")
def sent() -> list[Sent]:
    """What was published, by the clock of the module arm."""
    return published()


@pytest.fixture(scope="module")
def merged(sent: list[Sent], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of ``all.mcap`` and ``all.bag``: two segments of each module, the second with the latched again."""
    home = tmp_path_factory.mktemp("merged")
    half = sent[len(sent) // 2].at
    for module, ahead in (("arm", 0.0), ("base", AHEAD)):
        (home / module).mkdir()
        for number in (1, 2):
            with (home / module / f"{number}.mcap").open("wb") as file:
                writer = SegmentWriter(file, ModuleRecord(name=module))
                if module == "arm":
                    known = msgspec.json.encode(ClockRecord(START, AHEAD, 0.0001)).decode()
                    writer.metadata(CLOCK, {"base": known})
                for one in (each for each in sent if each.module == module):
                    first = one.time + round(ahead * SECOND)
                    if (one.at < half) == (number == 1):
                        writer.write(one.source, first, first, one.data)
                    elif one.source.latching:
                        writer.write(one.source, first + round(half * SECOND), first, one.data)
                writer.finish()
    timeline = Timeline([home / "arm", home / "base"], "arm")
    with (home / "all.mcap").open("wb") as file:
        timeline.write(file)
    assert (timeline.count, timeline.doubles) == (len(sent), 2)
    write_bag(timeline.messages(), home / "all.bag")
    return home


def javascript(file: Path) -> tuple[list[tuple[Any, ...]], list[list[Any]]]:
    """What Foxglove's libraries find: messages and sources."""
    command: list[str | Path] = ["node", npm.CLIENTS / "recordings.mjs", npm.packages(), file]
    with Process(command, name="recordings.mjs") as reader:
        assert reader.wait(RUN) == 0, reader.output
        rows = [(int(str(e["at"])), e["topic"], e["type"], e["digest"], e["words"]) for e in reader.events("message")]
        sources: Any = reader.events("sources")[0]["sources"]
        return rows, sources


def test_mcap_core_finds_all_in_order(sent: list[Sent], merged: Path) -> None:
    rows, sources = javascript(merged / "all.mcap")
    assert rows == [one.row for one in sent]
    wanted = {(s.source.topic, s.source.node, s.source.latching, s.module) for s in sent}
    assert {tuple(each) for each in sources} == wanted


def test_foxglove_rosbag_finds_all_in_order(sent: list[Sent], merged: Path) -> None:
    rows, sources = javascript(merged / "all.bag")
    assert rows == [one.row for one in sent]
    assert {tuple(each) for each in sources} == {(s.source.topic, s.caller, s.source.latching) for s in sent}


def test_mcap_ros1_support_decodes_all_in_order(sent: list[Sent], merged: Path) -> None:
    mcap_reader = pytest.importorskip("mcap.reader", reason="mcap is not installed (extra record)")
    mcap_ros1 = pytest.importorskip("mcap_ros1.decoder", reason="mcap-ros1-support is not installed (web-peers)")
    with (merged / "all.mcap").open("rb") as stream:
        reader = mcap_reader.make_reader(stream, validate_crcs=True, decoder_factories=[mcap_ros1.DecoderFactory()])
        rows = [
            (m.log_time, c.topic, s.name, c.metadata["callerid"], c.metadata["module"], m.data, said(values))
            for s, c, m, values in reader.iter_decoded_messages()
        ]
    assert rows == [(s.time, s.source.topic, s.source.type, s.source.node, s.module, s.data, s.words) for s in sent]


def said(message: Any) -> list[Any]:
    """What a message of the tests says in few words."""
    if hasattr(message, "transforms"):
        return [each.child_frame_id for each in message.transforms]
    if hasattr(message, "encoding"):
        return [message.width, message.height, message.encoding]
    return list(message.words) if hasattr(message, "words") else [message.data]


def test_rosbags_decodes_all_in_order(sent: list[Sent], merged: Path) -> None:
    from rosbags.interfaces import ConnectionExtRosbag1
    from rosbags.rosbag1 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    with Reader(merged / "all.bag") as reader:
        for each in reader.connections:
            store.register(get_types_from_msg(each.msgdef.data, each.msgtype))
        assert {one.msgdef.data for one in reader.connections} == {s.source.definition for s in sent}
        rows = [
            (at, one.topic, one.ext.callerid, bool(one.ext.latching), said(store.deserialize_ros1(data, one.msgtype)))
            for one, at, data in reader.messages()
            if isinstance(one.ext, ConnectionExtRosbag1)
        ]
    assert rows == [(s.time, s.source.topic, s.caller, s.source.latching, s.words) for s in sent]


# Debian's rosbag, by its own interpreter: all that it gives of a bag.
ROSBAG: Final = """
import json, sys, hashlib, rosbag
for topic, raw, at, head in rosbag.Bag(sys.argv[1]).read_messages(raw=True, return_connection_header=True):
    data = hashlib.sha1(raw[1]).hexdigest()
    head = {key: value if isinstance(value, str) else value.decode() for key, value in head.items()}
    caller, latching = head["callerid"], head["latching"]
    print(json.dumps([at.to_nsec(), topic, raw[0], data, caller, latching == "1"]))
"""


@pytest.mark.ros
def test_debians_rosbag_checks_and_lists_it(sent: list[Sent], merged: Path, shell: ShellFactory) -> None:
    ros, bag = shell(), str(merged / "all.bag")
    checked = ros.tool("rosbag", "check", bag)
    assert {line.split()[2] for line in checked.splitlines() if "* From:" in line} == {"lab_msgs/Joint"}, "no package"
    info = ros.tool("rosbag", "info", "--yaml", bag)
    counts = Counter(one.source.topic for one in sent)
    for topic, count in counts.items():
        kind = next(one.source.type for one in sent if one.source.topic == topic)
        assert f"- topic: {topic}\n      type: {kind}\n      messages: {count}\n" in info, info
    rows = [json.loads(line) for line in ros.tool(PYTHON, "-c", ROSBAG, bag).splitlines()]
    assert rows == [[*one.row[:4], one.caller, one.source.latching] for one in sent]


# A node that takes all of it as bytes, so that it needs no package of the types.
LISTENER: Final = """
import hashlib, json, sys, rospy
rospy.init_node("listener", disable_signals=True)
def heard(message, topic):
    head = message._connection_header
    data = hashlib.sha1(message._buff).hexdigest()
    event = {"event": "heard", "topic": topic, "type": head["type"], "md5": head["md5sum"], "data": data}
    event["latching"] = head.get("latching") == "1"
    print("@", json.dumps(event), flush=True)
for topic in sys.argv[1:]:
    rospy.Subscriber(topic, rospy.AnyMsg, heard, callback_args=topic, queue_size=1000)
print("@", json.dumps({"event": "up"}), flush=True)
rospy.spin()
"""


@pytest.mark.ros
def test_debians_rosbag_plays_it_to_a_node(sent: list[Sent], merged: Path, shell: ShellFactory) -> None:
    ros: Ros = shell()
    ros.master()
    topics = list(dict.fromkeys(one.source.topic for one in sent))
    listener = ros.start(PYTHON, "-c", LISTENER, *topics, name="listener")
    listener.wait_event("up")
    ros.tool("rosbag", "play", "-r", "5", "-d", "2", "--wait-for-subscribers", str(merged / "all.bag"), timeout=RUN)
    wanted = {
        topic: [
            (s.source.type, s.source.md5sum, s.row[3], s.source.latching) for s in sent if s.source.topic == topic
        ]
        for topic in topics
    }
    for topic, messages in wanted.items():
        listener.wait_event("heard", where=lambda e, t=topic, m=messages: (e["topic"], e["data"]) == (t, m[-1][2]))  # type: ignore[misc]
        came = [
            (e["type"], e["md5"], e["data"], e["latching"]) for e in listener.events("heard") if e["topic"] == topic
        ]
        assert came == messages, topic
