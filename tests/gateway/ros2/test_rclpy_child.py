"""ROS 2's half without ROS 2: its syntax, its frames, and what it makes of the gateway's words, by a stand-in."""

from __future__ import annotations

import ast
import asyncio
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from rmpa.core.errors import StartError
from rmpa.gateway.ros2 import half
from rmpa.gateway.ros2.format import (
    EntityKind,
    Ros2Attachment,
    Ros2Endpoint,
    Ros2Node,
    Ros2Qos,
    gid_of,
)
from rmpa.gateway.ros2.rclpy_session import RclpySession
from rmpa.gateway.ros2.ros2 import pythons
from rmpa.gateway.zenoh.threads import ZenohQos

STAND_IN = """
import json, os, socket, struct, sys

def main():
    sock = socket.socket(fileno=int(sys.argv[-1]))
    HEAD = struct.Struct("<IBI")
    def say(operation, number, body):
        sock.sendall(HEAD.pack(len(body) + 5, ord(operation), number) + body)
    def read():
        size, operation, number = HEAD.unpack(sock.recv(9, socket.MSG_WAITALL))
        return chr(operation), number, sock.recv(size - 5, socket.MSG_WAITALL) if size > 5 else b""
    assert read()[0] == "H"
    say("H", 0, json.dumps({"protocol": 1, "distribution": "jazzy", "rmw": "stand-in", "prefix": "0" * 24,
                         "environment": dict(os.environ)}).encode())
    row = {"gid": "f" * 32, "kind": "MS", "node": "/there", "name": "/x", "type": "std_msgs/msg/String"}
    row |= {"hash": "", "qos": {}}
    say("G", 0, json.dumps({"nodes": ["/there"], "added": [row], "removed": []}).encode())
    made = {}
    while True:
        operation, number, body = read()
        if operation == "+":
            asked = json.loads(body)
            if any(name == asked["name"] and kind != asked["type"] for name, kind in made.values()):
                say("!", number, b'{"text": "invalid allocator"}')
            else:
                made[number] = asked["name"], asked["type"]
        elif operation == "-":
            made.pop(number, None)
        elif operation == "M" and number in made:  # what is published comes back as if another node had sent it
            if body == b"die":
                os._exit(1)
            say("M", number, bytes([16]) + b"g" * 16 + struct.pack("<qq", 7, 9) + body)
        elif operation == "Q":
            say("A", number, body[:8] + b"\\1" + body[8:].upper())
"""


@pytest.mark.parametrize("file", sorted(Path(half.__file__).parent.glob("*.py")), ids=lambda file: file.name)
def test_it_is_of_the_grammar_of_python_3_8_and_imports_nothing_of_ours(file: Path) -> None:
    tree = ast.parse(file.read_text("utf-8"), feature_version=(3, 8))
    named = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    named |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not {name for name in named if name.startswith(("rmpa", "numpy", "msgspec"))}


def test_the_python_is_the_chosen_one_or_each_of_the_path(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    made = tmp_path / "two" / "python3"
    made.touch(0o755)
    path = f"{tmp_path / 'one'}::relative:{tmp_path / 'two'}:{tmp_path / 'two'}"
    assert pythons("", {"PATH": path})[0] == str(made)
    assert pythons("", {"PATH": path}).count(str(made)) == 1
    assert pythons("/opt/python", {"PATH": path}) == ["/opt/python"]


def test_the_python_of_a_bundle_is_not_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It runs isolated, and may have the release of Python that ROS 2 has, with PYTHONPATH set for that."""
    (tmp_path / "python3").symlink_to(sys.executable)
    own = str(tmp_path / "python3")
    assert own in pythons("", {"PATH": str(tmp_path)})
    bundle = SimpleNamespace(executable=sys.executable, flags=SimpleNamespace(isolated=1))
    monkeypatch.setattr("rmpa.gateway.ros2.ros2.sys", bundle)
    assert own not in pythons("", {"PATH": str(tmp_path)})


@pytest.fixture
async def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[RclpySession]:
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "child.py").write_text(STAND_IN)
    monkeypatch.setattr("rmpa.gateway.ros2.rclpy_session._HALF", tmp_path / "half")
    session = RclpySession(sys.executable, 0, "gate", {"PYTHONPATH": "/ros/2", "LD_LIBRARY_PATH": "/ros/lib"})
    await session.start()
    yield session
    await session.close()


async def until(found: Callable[[], object]) -> None:
    async with asyncio.timeout(20):
        while not found():
            await asyncio.sleep(0.01)


def endpoint(session: RclpySession, kind: EntityKind, number: int, base: str = "String") -> Ros2Endpoint:
    node = Ros2Node(0, session.zid, 1, "/rmpa/arm/node")
    return Ros2Endpoint(node, number, kind, "/x", f"std_msgs/msg/{base}", "RIHS01_1", Ros2Qos())


async def test_the_child_has_the_environment_that_was_sourced_and_nothing_of_the_gateway(
    session: RclpySession,
) -> None:
    given = session.hello["environment"]
    assert (given["PYTHONPATH"], given["LD_LIBRARY_PATH"]) == ("/ros/2", "/ros/lib")
    assert given.keys() <= {"PYTHONPATH", "LD_LIBRARY_PATH", "LC_CTYPE"}


async def test_a_second_type_of_a_topic_is_told_and_made_once_the_first_is_gone(session: RclpySession) -> None:
    problems: dict[str, str] = {}
    session.say = problems.__setitem__
    first = session.token(endpoint(session, EntityKind.PUBLISHER, 2).token())
    other = endpoint(session, EntityKind.SUBSCRIPTION, 3, "Int32").token()
    session.token(other)
    second = "/x of /rmpa/arm/node in ROS 2 (std_msgs/msg/Int32)"
    await until(lambda: problems.get(second, "").startswith("std_msgs/msg/String crosses, and std_msgs/msg/Int32"))
    first.close()
    await until(lambda: problems[second] == "")
    # What was asked before is done.
    await session.get("", b"", Ros2Attachment(1, 0, gid_of(other)).serialize())
    assert problems[second] == ""


async def test_messages_calls_and_demand_and_all_of_it_again_after_a_death(session: RclpySession) -> None:
    told: list[tuple[str, bool]] = []
    session.watch_tokens("", lambda token, alive: told.append((token.split("/")[5], alive)))
    await until(lambda: ("MS", True) in told)
    publisher = endpoint(session, EntityKind.PUBLISHER, 2)
    session.token(publisher.token())
    wanted: list[bool] = []
    sender = session.publisher(publisher.key(), ZenohQos(), wanted.append)
    await until(lambda: wanted == [True])
    arrived: list[bytes] = []
    session.subscribe(publisher.key(), lambda sample: arrived.append(sample.payload))
    attachment = Ros2Attachment(1, 0, gid_of(publisher.token())).serialize()
    sender.put_all([(b"one", attachment)])
    await until(lambda: arrived == [b"one"])
    assert (await session.get(publisher.key(), b"ask", attachment))[0].payload == b"ASK"

    sender.put_all([(b"die", attachment)])
    await until(lambda: ("MS", False) in told)
    assert (await session.get(publisher.key(), b"ask", attachment))[0].ok is False
    await until(lambda: not session.problem)
    sender.put_all([(b"two", attachment)])
    await until(lambda: arrived[-1] == b"two")


async def test_a_python_without_rclpy_is_told(tmp_path: Path) -> None:
    session = RclpySession(sys.executable, 0, "gate", {"PATH": str(tmp_path)})
    with pytest.raises(StartError, match="no rclpy"):
        await session.start()
    await session.close()
    with pytest.raises(StartError, match="cannot be started"):
        await RclpySession(str(tmp_path / "none"), 0, "gate", {}).start()
