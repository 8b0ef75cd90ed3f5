"""Messages of tens of megabytes between real nodes: whole, or not at all if a process dies."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually

if TYPE_CHECKING:
    from lab.bed.namespaces import Host
    from lab.bed.processes import Event, Process
    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

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


@pytest.mark.parametrize("sending", KINDS)
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


def test_a_publisher_that_dies_leaves_no_half_message(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b")
    heard = listeners_at(b, tmp_path)
    dying = a.ros.roscpp("teller", topic="/large", wait=1, commands=True)
    told = wake(dying, 1, list(heard.values()))
    slow_down(a.host, "lo", "100mbit")
    half_way(dying, 50 * MB, b)
    dying.kill()
    slow_down(a.host, "lo", "10gbit")
    follows(a, heard, told)


def test_an_agent_that_dies_leaves_no_half_message(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b")
    heard = listeners_at(b, tmp_path)
    sender = a.ros.roscpp("teller", topic="/large", wait=1, commands=True)
    told = wake(sender, 1, list(heard.values()))
    slow_down(a.host, "eth0", "100mbit")
    half_way(sender, 50 * MB, b)
    a.agent.kill()
    slow_down(a.host, "eth0", "10gbit")
    a.agent.restart()
    follows(a, heard, told)


def follows(module: Module, heard: dict[Path, Process], told: int) -> None:
    """Let another publisher send a message: each listener gets it, whole, and nothing of the one that broke off."""
    other = module.ros.rospy("teller", topic="/large", wait=1, source=2, commands=True)
    last = wake(other, 2, list(heard.values()))
    other.tell(f"{50 * MB} 1 0")
    for folder, listener in heard.items():
        report = arrived(listener, 2, last + 1)
        # The kernel may have had the rest of it: then it comes whole.
        assert counts_of(report, 1)["last"] in (told, told + 1)
        assert set(md5s(folder)) - {f"1-{told + 1}"} == {f"2-{last + 1}"}


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
