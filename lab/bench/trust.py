"""What trust costs: a secured mesh (TLS on all links) beside a plain one, in one run, and what attacks cost it.

Two pairs of agents, each on a network of its own, take turns with the same streams: processor time a message, latency
and how much goes through. Then how long a handshake takes, how soon a number of modules is linked, with what memory,
and what a linked agent loses and uses while forged beacons, forged prefaces and half handshakes come to its port.
"""

from __future__ import annotations

import asyncio
import socket
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

import psutil

from lab import samples
from lab.bed.bench import Bed
from lab.bed.members import ALLOWED, MeasuredMesh
from lab.bed.processes import BedError
from lab.bed.ros import NODES
from lab.bench import schedule
from lab.bench.joining import meshed
from lab.bench.scale import per_message
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, ratio, table_of, us
from lab.usage import Meter
from rmpa.core.guid import Guid
from rmpa.core.outbox import Outbox
from rmpa.mesh import limits
from rmpa.runtime.event_loop import AgentLoop
from rmpa.runtime.record_layer import TlsHandshake
from rmpa.runtime.stream import Stream
from rmpa.trust.io.contexts import link_context

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab.bed.agents import Agent
    from rmpa.runtime.record_layer import SecureSocket
    from rmpa.trust.io.store import TrustStore

_MB: Final = 1024 * 1024
_CPU_LIMIT: Final = 6.0
_SMALL_LIMIT: Final = 1.1
_LARGE_LIMIT: Final = 1.3
_GIGABIT: Final = 125.0
"""MB/s."""
_HANDSHAKE_LIMIT: Final = 5.0
_LINKED_LIMIT: Final = 2.0
_MEMORY_LIMIT: Final = 3.0
_ATTACKED_LIMIT: Final = 25.0
_LINKS: Final = 16
_FORGED: Final = 10_000.0
"""A second."""
_DEADLINE: Final = 180.0
_SETTLE: Final = 3.0
_STREAMED: Final = {64: 3000, 8192: 1000, 65536: 300, _MB: 30}
"""Messages of each size that cross alone, in this process."""
_ATTACKS: Final = ("beacons", "prefaces", "handshakes")
_KINDS: Final = (
    schedule.AgentPair("agents_plain", "two agents"),
    schedule.AgentPair("agents_tls", "two agents, TLS", config=ALLOWED),
)


@dataclass(frozen=True, slots=True)
class TrustPlan:
    """How much is measured.

    Args:
        seconds: Of each round of a stream.
        rounds: Turns of each.
        handshakes: How many.
        modules: In the mesh whose links are timed and whose memory is read: one more than the links of each.
        joins: How often the last one joins.
        attack: Seconds of each attack.
    """

    seconds: float
    rounds: int
    handshakes: int
    modules: int
    joins: int
    attack: float


FULL: Final = TrustPlan(4.0, 8, 200, 17, 5, 10.0)
QUICK: Final = TrustPlan(2.0, 2, 50, 5, 1, 4.0)


@dataclass(slots=True)
class Score:
    """One pair of agents, over all rounds.

    Args:
        cpu: µs of processor time an agent and message of 64 B, of each round and agent.
        small: Latencies at 64 B, µs.
        large: Likewise at 1 MB.
        filled: MB/s of each round that was meant to fill 1 Gbit/s.
        lost: Messages of the streams that never came.
    """

    cpu: list[float] = field(default_factory=list)
    small: list[float] = field(default_factory=list)
    large: list[float] = field(default_factory=list)
    filled: list[float] = field(default_factory=list)
    lost: int = 0


@dataclass(frozen=True, slots=True)
class Attacked:
    """A linked agent under one attack.

    Args:
        rate: Forgeries a second that were sent.
        lost: Messages of its stream that never came.
        messages: That were sent meanwhile.
        cpu: Percent of a core that it used more than without the attack.
    """

    rate: float
    lost: int
    messages: int
    cpu: float


@dataclass(frozen=True, slots=True)
class Joined:
    """A mesh of some modules.

    Args:
        joins: Seconds from the start of the last one to the full mesh.
        memory: MB of each agent that is private to it, with its links.
        alone: MB of the first one before the others were started.
    """

    joins: list[float]
    memory: list[float]
    alone: float


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the tables, write the file; return the result."""
    plan = QUICK if quick else FULL
    mesh = MeasuredMesh()
    handshakes, alone = _in_process(plan, mesh)
    scores, attacked = _streams(plan, mesh, console)
    joined = {kind.key: _joined(plan, mesh if kind.config else None, console) for kind in _KINDS}
    console.print(_table(scores))
    console.print(_attack_table(attacked))
    result: dict[str, object] = {
        "streams": {key: _row(score) for key, score in scores.items()},
        "stream_us": {str(size): costs for size, costs in alone.items()},
        "handshake_ms": _spread(handshakes),
        "joined": {key: asdict(one) for key, one in joined.items()},
        "attacked": {name: asdict(one) for name, one in attacked.items()},
    }
    return finish(
        console,
        "trust",
        asdict(plan),
        result,
        json,
        claims=_claims(plan, scores, handshakes, joined, attacked, alone),
    )


# --- streams --------------------------------------------------------------------------------------------------------


def _streams(plan: TrustPlan, mesh: MeasuredMesh, console: Console) -> tuple[dict[str, Score], dict[str, Attacked]]:
    with Bed() as bed:
        ways = []
        for network, kind in enumerate(_KINDS, 1):
            if kind.config:
                for end in "ab":
                    mesh.admit(bed.home, f"{kind.key}_{end}", f"{kind.key}_{end}")
            ways.append(schedule.agents(bed, kind, network=network))
        streams = {way.key: way.stream(bed, "/measured") for way in ways}
        agents = {way.key: {f"agent {n}": agent.pid for n, agent in enumerate(way.agents, 1)} for way in ways}
        idle = {}
        for key, pids in agents.items():
            meter = Meter(pids)
            time.sleep(plan.seconds)
            idle[key] = meter.read()
        scores = {way.key: Score() for way in ways}
        for turn in range(plan.rounds):
            console.print(f"round {turn + 1} of {plan.rounds}", style="dim")
            for key in (list(scores), list(reversed(scores)))[turn % 2]:
                score, stream = scores[key], streams[key]
                small = stream.run(64, 1000.0, plan.seconds)
                score.cpu += [per_message(small.usage[name], idle[key][name], small.total) for name in agents[key]]
                score.small += small.latencies()
                large = stream.run(_MB, 20.0, plan.seconds)
                score.large += large.latencies()
                score.lost += small.lost + large.lost
                full = stream.run(_MB, 1.2 * _GIGABIT * 1e6 / _MB, plan.seconds)
                score.filled.append(full.bytes_per_second(_MB, full.came[0], full.came[-1]) / 1e6)
        secured = ways[-1]
        attacker = bed.shell(bed.lab.host("attacker", len(ways)))
        target = secured.agents[1]
        port = Guid.parse(target.snapshot().agent.guid).port
        attacked = {}
        for attack in _ATTACKS:
            console.print(f"attack by {attack}", style="dim")
            stream, pid = streams[secured.key], target.pid
            calm = stream.run(64, 200.0, plan.attack)
            words = [attack, target.host.address, str(port), "--rate", str(_FORGED)]
            forger = attacker.start(sys.executable, NODES / "forger.py", *words, name="forger")
            forger.wait_event("sent", _DEADLINE)
            meter = Meter({"agent": pid})
            under = stream.run(64, 200.0, plan.attack)
            used = meter.read()["agent"].percent
            event = forger.wait_event("sent", _DEADLINE, where=lambda e: float(str(e["seconds"])) > plan.attack)
            rate = float(str(event["count"])) / float(str(event["seconds"]))
            forger.end()
            before = calm.usage["agent 2"].percent
            attacked[attack] = Attacked(round(rate), under.lost, under.sent, round(used - before, 2))
        return scores, attacked


# --- handshakes, links, memory --------------------------------------------------------------------------------------


def _in_process(plan: TrustPlan, mesh: MeasuredMesh) -> tuple[list[float], dict[int, tuple[float, float]]]:
    """Handshakes, ms of processor time of both ends; and by size µs of a message and end, plain and with TLS.

    One process has both ends, so that other processes disturb these figures least.
    """
    with Bed() as bed:
        stores = [mesh.admit(bed.home, "lab", name) for name in ("one", "other")]
        contexts = [_context(store, server_side=bool(n)) for n, store in enumerate(stores)]
    taken = []
    for _ in range(plan.handshakes):
        begun = time.thread_time_ns()
        _shake(contexts)
        taken.append((time.thread_time_ns() - begun) / 1e6)
    costs = {}
    for size, count in _STREAMED.items():
        rounds = [[_cost(size, count, made) for made in (None, contexts)] for _ in range(plan.rounds * 2)]
        costs[size] = (round(min(one[0] for one in rounds), 2), round(min(one[1] for one in rounds), 2))
    return taken, costs


def _cost(size: int, count: int, contexts: list[ssl.SSLContext] | None) -> float:
    loop = AgentLoop()
    try:
        return loop.run_until_complete(_ping_pong(size, count, contexts))
    finally:
        loop.close()


async def _ping_pong(size: int, count: int, contexts: list[ssl.SSLContext] | None) -> float:
    """µs of processor time an end and message, which crosses alone: each end sends when it has one."""
    loop = asyncio.get_running_loop()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        socks = [socket.create_connection(listener.getsockname()), listener.accept()[0]]
    for sock in socks:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    secure: list[SecureSocket | None] = [None, None]
    if contexts is not None:
        secure = [end.secure(sock) for end, sock in zip(_shake(contexts), socks, strict=True)]
    message = (bytes(limits.FRAME_HEADER_BYTES), bytes(size))
    whole = limits.FRAME_HEADER_BYTES + size
    done: asyncio.Future[None] = loop.create_future()
    streams: list[Stream] = []
    left = 0

    def reader(other: int) -> Callable[[memoryview], tuple[int, int]]:
        def received(view: memoryview) -> tuple[int, int]:
            nonlocal left
            if len(view) < whole:
                return 0, whole
            left -= 1
            if left > 0:
                streams[other].send(message, 1)
            elif not done.done():
                done.set_result(None)
            return whole, 0

        return received

    for number, sock in enumerate(socks):
        outbox = Outbox(_MB, 64 * _MB)
        streams.append(Stream(sock, on_bytes=reader(number), on_close=_ended, outbox=outbox, secure=secure[number]))
    begun = 0
    for trips in (count // 10, count):
        left, done = trips, loop.create_future()
        begun = time.thread_time_ns()
        streams[0].send(message, 1)
        await done
    spent = time.thread_time_ns() - begun
    for stream in streams:
        stream.close()
    return spent / count / 2e3


def _ended(error: Exception | None) -> None:
    raise BedError(f"a measured connection ended: {error}")


def _shake(contexts: list[ssl.SSLContext]) -> tuple[TlsHandshake, TlsHandshake]:
    client, server = (TlsHandshake(context, server_side=bool(n)) for n, context in enumerate(contexts))
    client.receive(b"")
    while not (client.done and server.done):
        server.receive(client.take_output())
        client.receive(server.take_output())
    return client, server


def _context(store: TrustStore, *, server_side: bool) -> ssl.SSLContext:
    files = store.load()
    return link_context(store.path("module.crt"), store.path("module.key"), files.ca, server_side=server_side)


def _joined(plan: TrustPlan, mesh: MeasuredMesh | None, console: Console) -> Joined:
    """Start a mesh of modules, and let its last one join again."""
    console.print(f"{plan.modules} modules, {'plain' if mesh is None else 'secured'}", style="dim")
    with Bed() as bed:
        hosts = bed.lab.hosts(*(f"m{number}" for number in range(plan.modules)))
        if mesh is not None:
            for host in hosts:
                mesh.admit(bed.home, host.name, host.name)
        config = ALLOWED if mesh is not None else ""
        agents = [bed.agent(host, name=host.name, start=False, config=config) for host in hosts]
        agents[0].start()
        agents[0].wait_ready(_DEADLINE)
        time.sleep(_SETTLE)
        alone = _memory(agents[0])
        for agent in agents[1:]:
            agent.start()
        with ThreadPoolExecutor(len(agents)) as waiting:
            list(waiting.map(lambda agent: agent.wait_ready(_DEADLINE), agents[1:]))
        meshed(agents)
        last, joins = agents[-1], []
        for _ in range(plan.joins):
            last.terminate()
            for agent in agents[:-1]:
                agent.wait_no_peer(last.name, _DEADLINE)
            last.start()
            last.wait_ready(_DEADLINE)
            joins.append(meshed(agents) - last.process.started)
        time.sleep(_SETTLE)
        memory = [round(_memory(agent), 2) for agent in agents[:-1]]
        return Joined([round(one, 3) for one in joins], memory, round(alone, 2))


def _memory(agent: Agent) -> float:
    """MB that are this process's alone."""
    return float(psutil.Process(agent.pid).memory_full_info().uss) / 1e6


# --- what came out --------------------------------------------------------------------------------------------------


def _claims(
    plan: TrustPlan,
    scores: dict[str, Score],
    handshakes: list[float],
    joined: dict[str, Joined],
    attacked: dict[str, Attacked],
    alone: dict[int, tuple[float, float]],
) -> list[Claim]:
    plain, secured = (scores[kind.key] for kind in _KINDS)
    bare, members = (joined[kind.key] for kind in _KINDS)
    more = statistics.median(secured.cpu) - statistics.median(plain.cpu)
    links = [statistics.median(one.memory) - one.alone for one in (members, bare)]
    memory = (links[0] - links[1]) * _LINKS / (plan.modules - 1)
    return [
        Claim("64 B: processor time a message and agent more with TLS, µs", round(more, 2), _CPU_LIMIT),
        Claim("64 B: the same of a stream alone, an end, µs", round(alone[64][1] - alone[64][0], 2), _CPU_LIMIT),
        Claim("64 B: p50, TLS / plain", ratio(_p50(secured.small), _p50(plain.small)), _SMALL_LIMIT),
        Claim("1 MB: p50, TLS / plain", ratio(_p50(secured.large), _p50(plain.large)), _LARGE_LIMIT),
        Claim(
            "1 Gbit/s filled by 1 MB with TLS, MB/s",
            round(statistics.median(secured.filled), 1),
            _GIGABIT,
            at_least=True,
        ),
        Claim(
            "handshake, both ends, ms of processor time", round(statistics.median(handshakes), 2), _HANDSHAKE_LIMIT
        ),
        Claim(
            f"{plan.modules} modules: last start to full mesh with TLS, s",
            round(statistics.median(members.joins), 3),
            _LINKED_LIMIT,
        ),
        Claim(f"memory more with TLS, MB for {_LINKS} links", round(memory, 2), _MEMORY_LIMIT),
        *(
            Claim(f"{_FORGED:.0f} forged {name} a second: messages lost", one.lost, 0)
            for name, one in attacked.items()
        ),
        *(
            Claim(f"{_FORGED:.0f} forged {name} a second: percent of a core more", one.cpu, _ATTACKED_LIMIT)
            for name, one in attacked.items()
        ),
    ]


def _p50(values: list[float]) -> float | None:
    return samples.summary(values).p50


def _row(score: Score) -> dict[str, object]:
    return {
        "cpu_us": [round(one, 2) for one in score.cpu],
        "small_us": asdict(samples.summary(score.small)),
        "large_us": asdict(samples.summary(score.large)),
        "filled_mb_s": [round(one, 1) for one in score.filled],
        "lost": score.lost,
    }


def _spread(values: list[float]) -> dict[str, float]:
    return {"least": min(values), "median": statistics.median(values), "largest": max(values)}


def _table(scores: dict[str, Score]) -> Table:
    heads = ("CPU a message of 64 B, µs", "p50 64 B, µs", "p50 1 MB, µs", "MB/s", "lost")
    table = table_of("plain and secured, the same streams in turn", ("way",), heads)
    for kind in _KINDS:
        score = scores[kind.key]
        figures = [statistics.median(score.cpu), _p50(score.small), _p50(score.large)]
        table.add_row(kind.title, *map(us, figures), dash(statistics.median(score.filled)), str(score.lost))
    return table


def _attack_table(attacked: dict[str, Attacked]) -> Table:
    heads = ("a second", "messages", "lost", "CPU more, % of a core")
    table = table_of("a linked agent while its port is attacked", ("by",), heads)
    for name, one in attacked.items():
        table.add_row(name, f"{one.rate:.0f}", str(one.messages), str(one.lost), dash(one.cpu))
    return table
