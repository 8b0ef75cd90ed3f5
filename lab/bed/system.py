"""The two systems of an experiment: classic ROS with one master, and RMPA. A ``Place`` has the hosts they run on."""

from __future__ import annotations

import abc
import collections
import signal
import time
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed import transport
from lab.bed.agents import Agent, last_link
from lab.bed.processes import BedError, Closing, Deadline, Process
from lab.bed.ros import NODES, PYTHON, Ros, compiled, words
from rmpa.core.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from lab.bed.namespaces import Host, Lab
    from lab.bed.plan import Client, Kind, Transport
    from lab.bed.transport import Pair
    from rmpa.observe.snapshot import Snapshot

CORE_PORT: Final = 11311
# Seconds until a node must have said ``up``.
_UP: Final = 30.0
# Seconds until all agents must be linked: 32 of them start on one machine.
_LINKED: Final = 120.0


class Place:
    """The hosts of one robot: network namespaces on one switch, as the paper's four boards were on theirs (Fig. 7).

    What a host sends is limited to what its cable carries; what it gets is not, which makes no difference while one
    sender alone fills its cable.

    Args:
        lab: Where they are made.
        hosts: Their names.
        link: What each cable carries (``100mbit``); empty for unshaped.
        bands: Whether packets leave a shaped cable by the kernel's usual three bands.
    """

    def __init__(self, lab: Lab, hosts: Sequence[str], *, link: str, bands: bool) -> None:
        self._lab = lab
        self._link, self._bands = link, bands
        self._hosts = {name: lab.host(name, 0) for name in hosts}
        for host in self._hosts.values():
            self._shape(host)

    def host(self, name: str) -> Host:
        """The host of this name."""
        return self._hosts[name]

    def off(self, name: str) -> None:
        """Pull its plug; all processes there have ended when this returns."""
        self._lab.power_off(self._hosts[name])

    def on(self, name: str) -> None:
        """Switch it on again."""
        self._lab.power_on(self._hosts[name])
        self._shape(self._hosts[name])

    def cut(self, name: str) -> None:
        """Pull its cable out."""
        self._hosts[name].cut()

    def restore(self, name: str) -> None:
        """Put its cable in again."""
        self._hosts[name].restore()

    def traffic(self, name: str) -> Mapping[str, int]:
        """What went through its cable since it was plugged."""
        return self._hosts[name].traffic()

    def _shape(self, host: Host) -> None:
        if self._link:
            host.shape(self._link, bands=self._bands)


class System(Closing):
    """Hosts with what makes them one system: masters or agents, cables and nodes.

    Args:
        place: Where the hosts are.
        hosts: Their names.
        home: An existing directory for files and logs.
    """

    # The transport between its modules; ``None`` where there are none.
    _way: Transport | None = None

    def __init__(self, place: Place, hosts: Sequence[str], home: Path) -> None:
        self._place = place
        self._hosts = tuple(hosts)
        self._home = home
        self._shells = {name: self._shell(name) for name in hosts}
        self._nodes: list[Process] = []
        self._off: set[str] = set()
        self._numbers: collections.Counter[tuple[str, str]] = collections.Counter()

    @property
    @abc.abstractmethod
    def kind(self) -> Kind:
        """Which of the two."""

    @property
    def hosts(self) -> Sequence[str]:
        """The names of its hosts."""
        return self._hosts

    @property
    def master(self) -> str:
        """The host of the one master; empty where each has its own."""
        return ""

    @abc.abstractmethod
    def boot(self, *, linked: bool = True) -> None:
        """Start what the system itself runs, and wait until it is ready.

        Args:
            linked: Whether each agent must be linked with every other; a master has no such links.
        """

    @abc.abstractmethod
    def pids(self) -> Mapping[str, int]:
        """What of the system itself runs, by ``what@host``."""

    def node(self, host: str, program: str, client: Client, *, wait: bool = True, **options: object) -> Process:
        """Start one of our nodes; returns when it said ``up``, or at once.

        Its name in the graph is its program's and host's with a number, and the same again after a restart of the
        host, as on a real robot.

        Raises:
            Deadline: It did not come up.
        """
        shell = self._shells[host]
        self._numbers[host, program] += 1
        name = f"{program}_{host.replace('-', '_')}_{self._numbers[host, program]}"
        argv: list[str | Path] = [PYTHON, NODES / f"{program}.py"] if client == "rospy" else [compiled(program)]
        given = words({"name": name, **options})
        process = shell.start(*argv, *given, name=f"{client} {program}", commands=True)
        self._nodes.append(process)
        if wait:
            process.wait_event("up", _UP)
        return process

    def require_transport(self, pairs: Iterable[Pair], way: Transport | None = None) -> None:
        """Make sure that publishers reach these subscribers by the system's transport, or by ``way``.

        Raises:
            BedError: They do not.
        """
        if wanted := way or self._way:
            transport.require(wanted, pairs)

    def kill(self, host: str) -> None:
        """End a host as a pulled plug does."""
        self._off.add(host)
        self._place.off(host)
        ended = [*self._shells[host].processes, *self._own(host)]
        for process in ended:
            process.send(signal.SIGKILL)
        for process in ended:
            process.wait()
        self._shells[host].close()

    def start(self, host: str) -> float:
        """Switch a killed host on again; returns when its master or agent is ready, with when that was executed."""
        self._place.on(host)
        self._off.discard(host)
        self._shells[host] = self._shell(host)
        for key in [key for key in self._numbers if key[0] == host]:
            del self._numbers[key]
        began = time.monotonic()
        self._boot(host)
        own = self._own(host)
        return own[0].started if own else began

    @abc.abstractmethod
    def linked(self) -> float:
        """Wait until all that run are joined; when the last one was."""

    def cut(self, host: str) -> None:
        """Pull its cable out."""
        self._place.cut(host)

    def restore(self, host: str) -> None:
        """Put its cable in again."""
        self._place.restore(host)

    def traffic(self, host: str) -> Mapping[str, int]:
        """What went through its cable since it was plugged (a restart is a new plug)."""
        return self._place.traffic(host)

    def close(self) -> None:
        """End all that was started; nodes are not asked, for some take their time."""
        for process in self._nodes:
            process.send(signal.SIGKILL)
        for shell in self._shells.values():
            shell.close()

    @abc.abstractmethod
    def _shell(self, host: str) -> Ros:
        """A user's shell there, set for this system."""

    @abc.abstractmethod
    def _boot(self, host: str) -> None:
        """Start what the system itself runs on a host, if anything, and wait until it is ready."""

    def _own(self, host: str) -> list[Process]:  # noqa: ARG002 - of those that have some
        """What the system itself runs there beside its shell's processes."""
        return []


class Classic(System):
    """ROS as it comes: one master, on ``pc`` or else on the last host; all others are told where it is."""

    def __init__(self, place: Place, hosts: Sequence[str], home: Path) -> None:
        self._at = "pc" if "pc" in hosts else hosts[-1]
        self._core: Process | None = None
        super().__init__(place, hosts, home)

    @property
    def kind(self) -> Kind:
        """Which of the two."""
        return "classic"

    @property
    def master(self) -> str:
        """The host of the one master."""
        return self._at

    def boot(self, *, linked: bool = True) -> None:  # noqa: ARG002 - a master has no links
        """Start the master."""
        self._boot(self._at)

    def linked(self) -> float:
        """Classic ROS is joined when its master answers, which ``boot`` and ``start`` wait for."""
        return time.monotonic()

    def pids(self) -> Mapping[str, int]:
        """The master, ``rosout``, and ``roscore``, which started both."""
        if self._core is None or self._core.returncode is not None:
            return {}
        found = {f"roscore@{self._at}": self._core.pid}
        for child in psutil.Process(self._core.pid).children(recursive=True):
            command = " ".join(child.cmdline())
            for word, name in (("rosmaster", "master"), ("rosout", "rosout")):
                if word in command:
                    found[f"{name}@{self._at}"] = child.pid
                    break
        return found

    def _shell(self, host: str) -> Ros:
        made = Ros(self._place.host(host), self._home, CORE_PORT)
        made.env["ROS_IP"] = made.host.address
        made.env["ROS_MASTER_URI"] = f"http://{self._place.host(self._at).address}:{made.port}/"
        return made

    def _boot(self, host: str) -> None:
        if host == self._at:
            self._core = self._shells[host].roscore()


class Rmpa(System):
    """An agent with its core on each host; nodes know nothing of the others.

    Args:
        place: As of ``System``; so are the next two.
        hosts: Also the agents' names.
        home: For files.
        way: The transport of what no contract in ``config`` gives another one.
        config: Further text of every agent's ``rmpa.toml``.
        flags: Further words for ``rmpa up``.
    """

    def __init__(
        self,
        place: Place,
        hosts: Sequence[str],
        home: Path,
        *,
        way: Transport = "relay",
        config: str = "",
        flags: Sequence[str] = (),
    ) -> None:
        super().__init__(place, hosts, home)
        self._way = way
        self._agents = {
            name: Agent(
                place.host(name),
                home,
                name=name,
                core_port=CORE_PORT,
                log_level="warning",
                config=config + transport.settings(way),
                flags=flags,
            )
            for name in hosts
        }

    @property
    def kind(self) -> Kind:
        """Which of the two."""
        return "rmpa"

    def boot(self, *, linked: bool = True) -> None:
        """Start all agents, and wait until each is ready and, if asked, linked with every other."""
        for agent in self._agents.values():
            agent.start()
        for agent in self._agents.values():
            agent.wait_ready(_LINKED)
        if linked:
            self.wait_linked()

    def linked(self) -> float:
        """Wait until every agent that runs is linked with every other; when the last link came up."""
        self.wait_linked()
        alive = {name for name in self._hosts if name not in self._off}
        snapshots = {name: self._snapshot(name) for name in alive}
        ups = [last_link(found, alive - {name}, time.monotonic()) for name, found in snapshots.items()]
        if None in ups:
            raise BedError("a link fell again while all agents were asked for theirs")
        return max((up for up in ups if up is not None), default=time.monotonic())

    def wait_linked(self, timeout: float = _LINKED) -> None:
        """Wait until every agent that runs is linked with every other.

        Raises:
            Deadline: They are not; the text says which are missing.
        """
        deadline = time.monotonic() + timeout
        alive = [name for name in self._hosts if name not in self._off]
        for name in alive:
            while missing := set(alive) - {name} - self.linked_with(name):
                if time.monotonic() > deadline:
                    raise Deadline(f"agent {name} is not linked with {', '.join(sorted(missing))} after {timeout} s")
                time.sleep(0.02)

    def linked_with(self, host: str) -> set[str]:
        """The names of the agents that a host's agent has a live link to; none if it does not answer."""
        found = self._snapshot(host)
        return {peer.name for peer in found.peers if peer.state == "linked"} if found else set()

    def _snapshot(self, host: str) -> Snapshot | None:
        """What its agent says of itself; ``None`` if it does not answer."""
        try:
            return self._agents[host].snapshot()
        except UnreachableError:
            return None

    def pids(self) -> Mapping[str, int]:
        """The agents that run."""
        running = {name: agent for name, agent in self._agents.items() if name not in self._off}
        return {f"agent@{name}": agent.pid for name, agent in running.items() if hasattr(agent, "process")}

    def close(self) -> None:
        """End all that was started: nodes first, as a user does."""
        super().close()
        for agent in self._agents.values():
            if hasattr(agent, "process"):
                agent.process.send(signal.SIGTERM)
        for agent in self._agents.values():
            agent.close()

    def _shell(self, host: str) -> Ros:
        made = Ros(self._place.host(host), self._home, CORE_PORT)
        made.env["ROS_IP"] = made.host.address  # as with classic ROS
        return made

    def _boot(self, host: str) -> None:
        agent = self._agents[host]
        agent.process.end()
        agent.start()
        agent.wait_ready(_LINKED)  # beside as many others as there are

    def _own(self, host: str) -> list[Process]:
        return [self._agents[host].process]
