"""Several machines on one: each a network namespace, joined by switches of their own.

::

    with Lab() as lab:
        a, b = lab.hosts("a", "b")         # 10.77.0.1 and 10.77.0.2 on one switch
        Process(a.command(["rmpa", "up"]))
        a.cut()                            # the cable is out
        a.restore()

A switch lives in a namespace of its own, so that nothing ever appears in the machine's own network and parallel
runs cannot meet. Names carry our process id; those of dead processes are removed by ``remove_stale``.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bed.processes import Closing
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Sequence

_PREFIX: Final = "rmpa"
# Where ``ip`` keeps its namespaces (ip-netns(8)).
_PLACES: Final = Path("/run/netns")
_CLONE_NEWNET: Final = 0x40000000
_MASQUERADE: Final = """
table ip nat {{
    chain out {{ type nat hook postrouting priority 100; policy accept; oifname "{uplink}" masquerade; }}
    chain past {{ type filter hook forward priority 0; policy accept; iifname "{uplink}" ct state new drop; }}
}}"""
_libc = ctypes.CDLL(None, use_errno=True)
_labs = itertools.count(1)


@functools.cache
def why_not() -> str:
    """Why network namespaces cannot be made here, or an empty string."""
    if shutil.which("ip") is None:
        return "no iproute2 here (apt install iproute2)"
    if os.geteuid() != 0:
        return "network namespaces need root"
    name = f"{_PREFIX}-{os.getpid()}-probe"
    try:
        _ip("netns", "add", name)
    except NetworkError as error:
        return f"this machine allows no network namespaces ({error})"
    # Some containers and every plain chroot let them be added but not entered: to enter one, ip mounts /sys anew.
    try:
        _ip("netns", "exec", name, "true")
        _ip("-n", name, "link", "add", "probe", "type", "veth", "peer", "name", "probe-peer")
    except NetworkError as error:
        return f"this machine's network namespaces cannot be used ({error})"
    finally:
        _ip("netns", "del", name)
    return ""


@functools.cache
def why_no_nat() -> str:
    """Why ``Lab.nat`` cannot be used here, or an empty string."""
    if reason := why_not():
        return reason
    if shutil.which("nft") is None:
        return "no nftables here (apt install nftables)"
    with Lab() as lab:
        try:
            lab.nat("nat", 1, 0)
        except NetworkError as error:
            return f"this machine's namespaces allow no NAT ({error})"
    return ""


class NetworkError(RmpaError):
    """``ip`` or ``tc`` refused a command."""


@dataclass(frozen=True, slots=True)
class Cable:
    """One host's connection to one network.

    Args:
        interface: Its name inside the host.
        address: Its IPv4 address.
        switch: The namespace of the network's switch.
        port: The switch's end.
        network: The network's number.
    """

    interface: str
    address: str
    switch: str
    port: str
    network: int


@dataclass(slots=True)
class Host:
    """A machine: a network namespace, or (with ``namespace`` empty) the real one.

    Args:
        name: Short, unique in its lab.
        namespace: The name of its network namespace.
        cables: Its connections, first the one made first.
    """

    name: str
    namespace: str = ""
    cables: list[Cable] = field(default_factory=list)

    @property
    def address(self) -> str:
        """Its first address; 127.0.0.1 for the real machine."""
        return self.cables[0].address if self.cables else "127.0.0.1"

    def command(self, argv: Sequence[str | Path]) -> list[str]:
        """The command line that runs ``argv`` on this host; the process becomes ``argv``, its id stays."""
        inside = [str(part) for part in argv]
        return ["ip", "netns", "exec", self.namespace, *inside] if self.namespace else inside

    def open_socket(self, family: int = socket.AF_INET, kind: int = socket.SOCK_STREAM) -> socket.socket:
        """A new socket in this host's network, for a program that itself runs on the real machine."""
        if not self.namespace:
            return socket.socket(family, kind)
        with ThreadPoolExecutor(1) as pool:  # setns(2) moves one thread, which ends here
            return pool.submit(self._socket_within, family, kind).result()

    def _socket_within(self, family: int, kind: int) -> socket.socket:
        with (_PLACES / self.namespace).open("rb") as place:
            if _libc.setns(place.fileno(), _CLONE_NEWNET):
                number = ctypes.get_errno()
                raise OSError(number, f"{self.namespace} cannot be entered: {os.strerror(number)}")
        return socket.socket(family, kind)

    def ip(self, *args: str) -> str:
        """Run ``ip`` in this host."""
        return _ip("-n", self.namespace, *args)

    def cut(self, cable: int = 0) -> None:
        """Pull the cable out at the switch: the host sees its carrier go, as with a real one."""
        wire = self.cables[cable]
        _ip("-n", wire.switch, "link", "set", wire.port, "down")

    def restore(self, cable: int = 0) -> None:
        """Put the cable in again."""
        wire = self.cables[cable]
        _ip("-n", wire.switch, "link", "set", wire.port, "up")

    def outage(self, seconds: float, cable: int = 0) -> None:
        """Pull the cable out, and put it in again after a while."""
        self.cut(cable)
        time.sleep(seconds)
        self.restore(cable)

    def dropout(self, seconds: float, cable: int = 0) -> None:
        """Let the switch drop every frame of this host for a while; the carrier stays, as with a radio.

        An outage of a carrier takes up to a second longer than asked for, because the kernel gathers its changes.
        """
        wire = self.cables[cable]
        # Not `ip link set type bridge_slave state`: the kernel takes it and goes on forwarding.
        port = ["bridge", "-n", wire.switch, "link", "set", "dev", wire.port, "state"]
        _run([*port, "0"])
        time.sleep(seconds)
        _run([*port, "3"])

    def switch_off(self, cable: int = 0) -> None:
        """Take the interface down inside the host (its routes go with it)."""
        self.ip("link", "set", self.cables[cable].interface, "down")

    def switch_on(self, cable: int = 0) -> None:
        """Take the interface up again."""
        self.ip("link", "set", self.cables[cable].interface, "up")

    def shape(
        self, rate: str, *, burst: str = "32kb", latency: str = "50ms", bands: bool = False, cable: int = 0
    ) -> None:
        """Limit what this host sends to ``rate`` (as ``tc`` writes it: ``100mbit``) by a token bucket.

        Args:
            rate: Of the cable.
            burst: What may leave at once.
            latency: For how long a packet may wait.
            bands: Whether they leave by the kernel's usual three bands (``pfifo_fast``), which look at SO_PRIORITY,
                and not in the order in which they came.
            cable: Which.
        """
        qdisc = ["tc", "-n", self.namespace, "qdisc", "replace", "dev", self.cables[cable].interface]
        _run([*qdisc, "root", "handle", "1:", "tbf", "rate", rate, "burst", burst, "latency", latency])
        if bands:
            _run([*qdisc, "parent", "1:1", "handle", "10:", "pfifo_fast"])

    def traffic(self, cable: int = 0) -> dict[str, int]:
        """What went through a cable since it was plugged: ``tx_bytes``, ``tx_packets`` and the same with ``rx``."""
        shown = self.ip("-json", "-statistics", "link", "show", "dev", self.cables[cable].interface)
        counters = json.loads(shown)[0]["stats64"]
        return {f"{way}_{unit}": int(counters[way][unit]) for way in ("tx", "rx") for unit in ("bytes", "packets")}

    def unshape(self, cable: int = 0) -> None:
        """Take the limit away."""
        _run(["tc", "-n", self.namespace, "qdisc", "del", "dev", self.cables[cable].interface, "root"])


# The real machine, for tests without namespaces.
MACHINE: Final = Host("machine")


@dataclass(slots=True)
class Network:
    """A switch and the addresses 10.77.``subnet``.0/24 on it.

    Args:
        number: Its number in the lab.
        switch: The namespace of its switch.
        subnet: The third byte of its addresses; two networks behind NAT may have the same.
    """

    number: int
    switch: str
    subnet: int
    _next: int = 1

    def plug(self, host: Host, *, octet: int | None = None) -> Cable:
        """Connect a host; its interface is ``eth`` with the number of its cable."""
        if octet is None:
            octet, self._next = self._next, self._next + 1
        interface, port = f"eth{len(host.cables)}", f"port{octet}"
        cable = Cable(interface, f"10.77.{self.subnet}.{octet}", self.switch, port, self.number)
        # The hardware address is the address's, so that a host that was off comes back as itself.
        hardware = f"02:4d:50:00:{self.number:02x}:{octet:02x}"
        names = ["link", "add", interface, "address", hardware, "netns", host.namespace]
        _ip(*names, "type", "veth", "peer", "name", port, "netns", self.switch)
        _ip("-n", self.switch, "link", "set", port, "master", "switch", "up")
        host.ip("address", "add", f"{cable.address}/24", "brd", "+", "dev", interface)
        host.ip("link", "set", interface, "up")
        host.cables.append(cable)
        return cable

    @property
    def broadcast(self) -> str:
        """Its broadcast address."""
        return f"10.77.{self.subnet}.255"


class Lab(Closing):
    """Hosts and networks that vanish at the end, whatever happened in between, with all that still runs in them."""

    def __init__(self) -> None:
        self._prefix = f"{_PREFIX}-{os.getpid()}-{next(_labs)}"
        self._namespaces: list[str] = []
        self._networks: dict[int, Network] = {}

    def network(self, number: int = 0, subnet: int | None = None) -> Network:
        """Network 10.77.``subnet``.0/24 (default: its number), made when first asked for."""
        if number not in self._networks:
            switch = self._namespace(f"switch{number}")
            _ip("-n", switch, "link", "add", "switch", "type", "bridge", "forward_delay", "0", "mcast_snooping", "0")
            _ip("-n", switch, "link", "set", "switch", "up")
            self._networks[number] = Network(number, switch, number if subnet is None else subnet)
        return self._networks[number]

    def host(self, name: str, *networks: int) -> Host:
        """A new host, plugged into the networks with these numbers (none: unplugged; see ``hosts``)."""
        host = Host(name, self._namespace(name))
        host.ip("link", "set", "lo", "up")
        for number in networks:
            self.network(number).plug(host)
        return host

    def hosts(self, *names: str, network: int = 0) -> list[Host]:
        """Several hosts on one network."""
        return [self.host(name, network) for name in names]

    def power_off(self, host: Host) -> None:
        """Pull a host's plug: its cables fall silent, its processes end, and its sockets with them, without a word.

        A killed process alone would be unlike it: the kernel closes its connections, and tells the others.
        """
        for wire in host.cables:
            _ip("-n", wire.switch, "link", "del", wire.port)
        _remove(host.namespace)

    def power_on(self, host: Host) -> None:
        """Switch such a host on again, with the cables that it had; shape them anew."""
        _ip("netns", "add", host.namespace)
        host.ip("link", "set", "lo", "up")
        wires, host.cables[:] = list(host.cables), []
        for wire in wires:
            self.network(wire.network).plug(host, octet=int(wire.address.rpartition(".")[2]))

    def router(self, first: int, second: int, name: str = "router") -> Host:
        """A host that forwards between two networks; tell the hosts there by ``route``. No multicast crosses."""
        router = Host(name, self._namespace(name))
        router.ip("link", "set", "lo", "up")
        for number in (first, second):
            self.network(number).plug(router, octet=254)
        _run(router.command(["sysctl", "-qw", "net.ipv4.ip_forward=1"]))
        return router

    def nat(self, name: str, inside: int, outside: int) -> Host:
        """A host that forwards from network ``inside`` to ``outside`` and hides the addresses of ``inside`` (NAT).

        Its cable 0 is the inner one, cable 1 the uplink. As with a router at home, hosts inside reach those outside
        when they are told by ``route``, and nothing from outside can begin a connection inwards. Needs ``nft``.
        """
        nat = Host(name, self._namespace(name))
        nat.ip("link", "set", "lo", "up")
        self.network(inside).plug(nat, octet=254)
        uplink = self.network(outside).plug(nat)
        _run(nat.command(["sysctl", "-qw", "net.ipv4.ip_forward=1"]))
        _run(nat.command(["nft", _MASQUERADE.format(uplink=uplink.interface)]))
        return nat

    def route(self, host: Host, via: Host) -> None:
        """Make ``via`` the default gateway of ``host``: the router's address on a network they share."""
        mine = {cable.switch for cable in host.cables}
        gateway = next(cable.address for cable in via.cables if cable.switch in mine)
        host.ip("route", "replace", "default", "via", gateway)

    def close(self) -> None:
        """End what still runs in the namespaces and remove them."""
        while self._namespaces:
            _remove(self._namespaces.pop())
        self._networks.clear()

    def _namespace(self, name: str) -> str:
        full = f"{self._prefix}-{name}"
        _ip("netns", "add", full)
        self._namespaces.append(full)
        return full


def remove_stale() -> list[str]:
    """Remove namespaces left behind by runs whose process is gone; return their names."""
    stale = []
    for line in _ip("netns", "list").splitlines():
        name = line.split()[0] if line.strip() else ""
        prefix, _, rest = name.partition("-")
        pid = rest.partition("-")[0]
        if prefix == _PREFIX and pid.isdecimal() and not Path(f"/proc/{pid}").exists():
            _remove(name)
            stale.append(name)
    return stale


def _remove(namespace: str) -> None:
    """Delete one of our namespaces and end the processes inside: a namespace lives on while one is in it."""
    deadline = time.monotonic() + 5.0
    with contextlib.suppress(NetworkError):
        while (pids := _ip("netns", "pids", namespace).split()) and time.monotonic() < deadline:
            for pid in pids:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(pid), signal.SIGKILL)
            time.sleep(0.02)
    with contextlib.suppress(NetworkError):
        _ip("netns", "del", namespace)


def _ip(*args: str) -> str:
    return _run(["ip", *args])


def _run(argv: Sequence[str]) -> str:
    done = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=20)
    if done.returncode:
        raise NetworkError(f"{' '.join(argv)}: {done.stderr.strip()}")
    return done.stdout
