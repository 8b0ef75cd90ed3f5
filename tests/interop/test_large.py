"""Lanes, and large messages: each byte arrives, or nothing of a message does."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path

import pytest

from lab.bed.namespaces import Host
from lab.bed.processes import Event, Process, eventually
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module, flows
from tests.interop.recordings import connected, in_order, recorded, wait_last

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]
MB = 1 << 20
KINDS = ("roscpp", "rospy")


def received_bytes(module: Module) -> int:
    """What came over a module's cable so far."""
    text = Path(f"/proc/{module.agent.pid}/net/dev").read_text()
    return int(text.partition("eth0:")[2].split()[0])


def slow_down(host: Host, interface: str, rate: str) -> None:
    """Limit what leaves by an interface of a host; on ``lo`` that is all between its own processes."""
    words = ["root", "tbf", "rate", rate, "burst", "256kb", "latency", "500ms"]
    command = ["tc", "-n", host.namespace, "qdisc", "replace", "dev", interface, *words]
    subprocess.run(command, check=True, capture_output=True, timeout=20)


def half_way(sender: Process, size: int, to: Module) -> None:
    """Tell a sender to send one message; return when some of it, but not all, has come over the cable."""
    before = received_bytes(to)
    sender.tell(f"{size} 1 0")
    eventually(lambda: received_bytes(to) > before + size // 5, what="a part of the message", every=0.01)
    assert received_bytes(to) < before + size * 3 // 4


def wake(sender: Process, source: int, listeners: list[Process]) -> int:
    """Send small messages until each listener has one: then all are connected. Return how many were sent."""

    def heard() -> bool:
        since = sender.mark_events()
        sender.tell("100 1 0")
        sent.append(int(str(sender.wait_event("told", since=since)["sent"])))
        return all(str(source) in counts(listener) for listener in listeners)

    sent: list[int] = []
    eventually(heard, what="the first message everywhere", every=0.2)
    return sent[-1]


def counts(listener: Process) -> dict[str, dict[str, int]]:
    """What a listener has of each source."""
    reports = listener.events("report")
    return reports[-1]["sources"] if reports else {}  # type: ignore[return-value]  # as nodes/payload has it


def arrived(listener: Process, source: int, last: int) -> Event:
    """Wait until a listener has a message of a source; return its report, in which no byte may be wrong."""
    found = listener.wait_event("report", where=lambda event: counts_of(event, source)["last"] >= last)
    assert (found["bad"], found["gaps"], found["doubled"]) == (0, 0, 0), found
    return found


def counts_of(event: Event, source: int) -> dict[str, int]:
    """What a report says of one source."""
    sources: dict[str, dict[str, int]] = event["sources"]  # type: ignore[assignment]  # as nodes/payload has it
    return sources.get(str(source), {"last": 0, "count": 0})


def md5s(folder: Path) -> dict[str, str]:
    """The sums of the large ones among the saved messages, by SOURCE-SEQUENCE."""
    large = [path for path in folder.iterdir() if path.suffix != ".part" and path.stat().st_size > MB]
    return {path.name: hashlib.md5(path.read_bytes(), usedforsecurity=False).hexdigest() for path in large}


def listeners_at(module: Module, tmp_path: Path, name: str = "came") -> dict[Path, Process]:
    """A recorder of each kind, and the folder to which it saves what comes."""
    folders = {kind: tmp_path / f"{name}_to_{kind}" for kind in KINDS}
    for folder in folders.values():
        folder.mkdir()
    return {
        folder: module.ros.node(kind, "recorder", topic="/large", save=folder) for kind, folder in folders.items()
    }


@pytest.mark.parametrize("sending", ["roscpp", pytest.param("rospy", marks=pytest.mark.long)])
def test_each_byte_arrives(modules: ModuleFactory, tmp_path: Path, sending: str) -> None:
    here, there = modules("a", "b") if sending == "roscpp" else reversed(modules("a", "b"))
    (sent := tmp_path / "sent").mkdir()
    heard = listeners_at(there, tmp_path)
    teller = here.ros.node(sending, "teller", topic="/large", wait=1, save=sent, commands=True)
    last = wake(teller, 1, list(heard.values()))
    teller.tell(f"{10 * MB},{50 * MB},100000 3 0")
    for folder, listener in heard.items():
        arrived(listener, 1, last + 3)
        assert md5s(folder) == md5s(sent)
        assert len(md5s(folder)) == 2


@pytest.mark.parametrize("dies", ["publisher", pytest.param("agent", marks=pytest.mark.long)])
def test_what_dies_in_the_middle_leaves_no_half_message(modules: ModuleFactory, tmp_path: Path, dies: str) -> None:
    a, b = modules("a", "b")
    heard = listeners_at(b, tmp_path)
    sender = a.ros.roscpp("teller", topic="/large", wait=1, commands=True)
    told = wake(sender, 1, list(heard.values()))
    cable = "lo" if dies == "publisher" else "eth0"
    slow_down(a.host, cable, "100mbit")
    half_way(sender, 50 * MB, b)
    (sender if dies == "publisher" else a.agent).kill()
    slow_down(a.host, cable, "10gbit")
    if dies == "agent":
        a.agent.restart()
    # Another publisher sends a message: each listener gets it, whole, and nothing of the one that broke off.
    other = a.ros.rospy("teller", topic="/large", wait=1, source=2, commands=True)
    last = wake(other, 2, list(heard.values()))
    other.tell(f"{50 * MB} 1 0")
    for folder, listener in heard.items():
        report = arrived(listener, 2, last + 1)
        # The kernel may have had the rest of it: then it comes whole.
        assert counts_of(report, 1)["last"] in (told, told + 1)
        assert set(md5s(folder)) - {f"1-{told + 1}"} == {f"2-{last + 1}"}


@pytest.mark.long
def test_the_receiving_agent_dies_in_the_middle(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b")
    heard = listeners_at(b, tmp_path)
    sender = a.ros.rospy("teller", topic="/large", wait=1, commands=True)
    wake(sender, 1, list(heard.values()))
    slow_down(a.host, "eth0", "100mbit")
    half_way(sender, 50 * MB, b)
    b.agent.kill()
    slow_down(a.host, "eth0", "10gbit")
    b.agent.restart()
    anew = listeners_at(b, tmp_path, "came_later")
    last = wake(sender, 1, list(anew.values()))
    sender.tell(f"{50 * MB} 1 0")
    for listener in anew.values():
        arrived(listener, 1, last + 1)
    for folder, listener in heard.items():  # the new agent has them back; what broke off with the old one is missing
        found = listener.wait_event("report", where=lambda event: counts_of(event, 1)["last"] >= last + 1)
        assert found["bad"] == 0
        assert list(md5s(folder)) == [f"1-{last + 1}"]


def test_a_cable_pulled_in_the_middle_leaves_no_half_message(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b")
    (sent := tmp_path / "sent").mkdir()
    heard = listeners_at(b, tmp_path)
    sender = a.ros.roscpp("teller", topic="/large", wait=1, save=sent, commands=True)
    wake(sender, 1, list(heard.values()))
    slow_down(a.host, "eth0", "100mbit")
    half_way(sender, 50 * MB, b)
    b.host.outage(0.8)  # another link follows, before the talker's proxy has left the graph
    slow_down(a.host, "eth0", "10gbit")
    b.agent.wait_peer("a")
    # Who was hung up on comes back a moment later: one of the next ones reaches everybody.
    eventually(lambda: all_have(sender, heard), what="a whole message everywhere", every=0.5)
    for folder, listener in heard.items():
        assert listener.events("report")[-1]["bad"] == 0
        assert md5s(folder).items() <= md5s(sent).items()


def all_have(sender: Process, heard: dict[Path, Process]) -> bool:
    """Send one more of 5 MB; whether each listener has a large one."""
    sender.tell(f"{5 * MB} 1 0")
    return all(md5s(folder) for folder in heard)


@pytest.mark.long
def test_two_publishers_of_large_messages_are_not_mixed(modules: ModuleFactory, tmp_path: Path) -> None:
    # Without a depth, what waits for half a second on a busy machine is dropped.
    a, b = modules("a", "b", config='[[contract]]\ntopics = ["/large"]\ndepth = 10\n')
    (sent := tmp_path / "sent").mkdir()
    heard = listeners_at(b, tmp_path)
    tellers = [
        a.ros.node(kind, "teller", topic="/large", wait=1, source=source, save=sent, commands=True)
        for source, kind in enumerate(KINDS, 1)
    ]
    lasts = [wake(teller, source, list(heard.values())) for source, teller in enumerate(tellers, 1)]
    for teller in tellers:
        teller.tell(f"{8 * MB} 3 0")  # no queue on the way is too short for all of them
    for folder, listener in heard.items():
        for source, last in enumerate(lasts, 1):
            arrived(listener, source, last + 3)
        assert md5s(folder) == md5s(sent)


MBIT = 100
IMAGE = 1 << 20
# At 100 Hz.
COMMANDS = 400
RULES = """
[[contract]]
topics = ["/urgent"]
priority = "high"
[[contract]]
topics = ["/later"]
priority = "low"
"""


def lanes(module: Module, topic: str) -> list[str]:
    """The lane of each route of a topic, as ``rmpa topic info --json`` says."""
    code, output = module.agent.rmpa("topic", "info", topic, "--json")
    assert code == 0, output
    return [str(route["lane"]) for route in json.loads(output)["mesh"]["routes"]]


def test_commands_cross_a_cable_that_images_fill(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config=RULES)
    for module in (a, b):
        module.host.shape(f"{MBIT}mbit", bands=True)
    images = b.ros.roscpp("listener", "__name:=eye", topic="/image", queue=2)
    # The same commands on the lane of the images: what the express lane spares them, whatever else the machine does.
    topics = ("/command", "/later")
    recorders = [b.ros.roscpp("recorder", topic=topic, nodelay=True, commands=True) for topic in topics]
    # More than the cable carries, so that an image is always waiting.
    a.ros.roscpp("talker", "__name:=camera", topic="/image", size=IMAGE, rate=15, queue=2, wait=1)
    flows(images, 3)
    tellers = [a.ros.roscpp("teller", topic=topic, nodelay=True, wait=1, commands=True) for topic in topics]
    for teller in tellers:
        teller.wait_event("connected")
    for teller in tellers:
        teller.tell(f"64 {COMMANDS} 100")
    for teller, recorder in zip(tellers, recorders, strict=True):
        teller.wait_event("told")
        wait_last(recorder, COMMANDS)
    after = images.events("report")[-1]
    rows, behind = (recorded(recorder, tmp_path) for recorder in recorders)
    in_order(rows, COMMANDS)
    # Behind one image in one queue a command waits for up to 84 ms, and for 42 ms on the average.
    ages, late = (sorted(row.age for row in each) for each in (rows, behind))
    assert late[len(late) // 2] > 0.02, "the cable is full"
    assert ages[COMMANDS // 2] < late[len(late) // 2] / 2
    assert ages[COMMANDS * 9 // 10] < late[len(late) * 9 // 10]
    assert after["bad"] == 0
    for module in (a, b):
        assert lanes(module, "/command") == ["express"]
        assert lanes(module, "/image") == lanes(module, "/later") == ["bulk"]


def test_a_topic_of_small_and_large_messages_keeps_its_order(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b")
    for module in (a, b):
        module.host.shape(f"{MBIT}mbit", bands=True)
    recorders = [
        b.ros.node(kind, "recorder", topic="/mixed", nodelay=True, commands=True) for kind in ("rospy", "roscpp")
    ]
    teller = a.ros.roscpp("teller", topic="/mixed", nodelay=True, wait=1, commands=True)
    teller.wait_event("connected")
    first = told = connected(teller, recorders)
    assert lanes(b, "/mixed") == ["express"]
    for recorder in recorders:
        recorded(recorder, tmp_path)  # one may have missed what was sent before it was connected
    # 200 KB at 100 Hz would be 160 Mbit/s; each fifth are 32 Mbit/s, still under way when small ones follow. A row
    # of small ones takes the topic back to the express lane, 5 s after the last large one.
    for sizes, count, rate, lane in (
        ("100,100,204800,100,100", 200, 100, "bulk"),
        ("100", 1200, 200, "express"),
        ("100,204800,100,100,100", 200, 100, "bulk"),
    ):
        since = teller.mark_events()
        teller.tell(f"{sizes} {count} {rate}")
        teller.wait_event("told", since=since)
        told += count
        for recorder in recorders:
            wait_last(recorder, told)
        assert lanes(a, "/mixed") == [lane]
    for recorder in recorders:
        in_order(recorded(recorder, tmp_path), told, after=first)
