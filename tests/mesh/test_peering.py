"""Which side dials, when, and which of two links stays."""

from __future__ import annotations

import itertools
from dataclasses import replace
from ipaddress import IPv4Address

import pytest

from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity
from rmpa.mesh import limits
from rmpa.mesh.frames import FULL, Hello, Refusal, Refuse
from rmpa.mesh.peering import DIAL_FALLBACK, LINK_STABLE, PURSUITS_PER_SECOND, REFUSED_RETRY, Peering, PeeringOutput
from tests.mesh.worlds import HIGH, LOW

DUAL = replace(HIGH, addresses=(IPv4Address("192.168.0.2"),))
AGAIN = Identity(Guid.of("10.0.0.2", 40002, 2), b"A" * 16, "high")


def of(ours: Identity, *, alive: bool = True) -> Peering:
    return Peering(ours, rng=lambda: 0.999999, alive=lambda _: alive)


def dials(outputs: list[PeeringOutput]) -> list[tuple[str, int]]:
    return [dial[2][0] for dial in outputs if dial[0] == "dial"]


def until_dial(peering: Peering, now: float) -> tuple[float, tuple[str, int]]:
    while not (made := dials(peering.take())):
        due = peering.next_timer()
        assert due is not None
        now = max(now, due)
        peering.handle_timer(now)
    return now, made[0]


def dialled_after_silence(
    count: int, *, needed: bool = True, seconds: float = 12.0
) -> list[tuple[float, tuple[Guid, bool]]]:
    """The dials to peers whose links fell silent at 0 s; each of them fails after ``limits.REDIAL_TIMEOUT``."""
    peering = of(LOW)
    for number in range(1, count + 1):
        identity = Identity(Guid.of(f"10.1.{number}.2", 40002), bytes([number]) * 16, f"peer{number}")
        peering.peer_found(identity, -100.0)
        peering.link_up(number, identity, -99.0, dialled=True, endpoint=identity.guid.endpoint)
    peering.take()
    for number in range(1, count + 1):
        peering.link_down(number, "silent", 0.0, silent=True, needed=needed)
    made: list[tuple[float, tuple[Guid, bool]]] = []
    failing: list[tuple[float, tuple[Guid, bool]]] = []
    for now in (tick / 100 for tick in range(round(100 * seconds))):
        while failing and failing[0][0] <= now:
            peering.dial_failed(failing.pop(0)[1][0], "no answer", now)
        peering.handle_timer(now)
        new = [(output[1], output[3]) for output in peering.take() if output[0] == "dial"]
        made += [(now, dial) for dial in new]
        failing += [(now + limits.REDIAL_TIMEOUT, dial) for dial in new]
    return made


def test_a_needed_peer_that_fell_silent_is_dialled_by_short_attempts() -> None:
    """A long attempt that began shortly before the network is back waits a second for TCP's own repetition."""
    made = dialled_after_silence(1)
    times = [at for at, (_, briefly) in made if briefly]
    assert times[-1] > limits.PURSUIT - 0.5
    assert max(b - a for a, b in itertools.pairwise([0.0, *times])) <= 0.31
    assert all(briefly == (at < limits.PURSUIT) for at, (_, briefly) in made)
    assert not any(briefly for _, (_, briefly) in dialled_after_silence(1, needed=False))


def test_many_peers_that_fall_silent_share_the_attempts() -> None:
    made = dialled_after_silence(64)
    first = {guid: at for at, (guid, _) in reversed(made)}
    assert len(first) == 64
    assert max(first.values()) < 1.0
    assert len(made) < limits.PURSUIT * PURSUITS_PER_SECOND


def test_all_addresses_are_dialled_before_a_pause() -> None:
    low = of(LOW)
    low.peer_found(DUAL, 0.0, source="172.16.0.2")
    now, seen = 0.0, []
    for _ in range(3):
        while not (made := [o for o in low.take() if o[0] == "dial"]):
            due = low.next_timer()
            assert due is not None
            now = max(now, due)
            low.handle_timer(now)
        seen.append((round(now, 3), [host for host, _ in made[0][2]]))
        low.dial_failed(DUAL.guid, "no answer anywhere", now)
    everywhere = ["172.16.0.2", "10.0.0.2", "192.168.0.2"]
    assert seen == [(0.0, everywhere), (0.1, everywhere), (0.3, everywhere)]
    (status,) = low.peers()
    assert (status.state, status.last_error, status.attempts) == ("waiting", "no answer anywhere", 3)


def test_retries_for_ever_with_a_cap() -> None:
    low = of(LOW)
    low.peer_found(HIGH, 0.0)
    now, pauses = 0.0, []
    for _ in range(200):
        before = now
        now, _ = until_dial(low, now)
        pauses.append(now - before)
        low.dial_failed(HIGH.guid, "refused", now)
    assert max(pauses) <= limits.BACKOFF_MAX
    assert pauses[-1] > 0.9 * limits.BACKOFF_MAX


def test_flapping_link_is_dialled_slower_than_a_stable_one() -> None:
    low = of(LOW)
    low.peer_found(HIGH, 0.0)
    now, before, pauses = 0.0, 0.0, []
    for link in range(1, 9):
        before = now
        now, _ = until_dial(low, now)
        pauses.append(now - before)
        low.link_up(link, HIGH, now, dialled=True, endpoint=HIGH.guid.endpoint)
        now += 0.01 if link < 7 else LINK_STABLE
        low.link_down(link, "lost", now)
    assert pauses[5] > 1.0
    now, _ = until_dial(low, now)
    assert now - (before + pauses[-1]) <= LINK_STABLE + limits.BACKOFF_FIRST


def test_unannounced_peer_is_forgotten_after_its_link() -> None:
    low = of(LOW)
    low.link_up(7, HIGH, 0.0, dialled=False)
    assert low.take() == [("up", 7)]
    low.link_down(7, "lost", 10.0)
    assert low.take() == [("down", 7, "lost")]
    now = 10.0
    while (due := low.next_timer()) is not None:
        now = due
        low.handle_timer(now)
        for output in low.take():
            assert output[0] == "dial"
            low.dial_failed(output[1], "refused", now)
    assert now <= 10.0 + limits.FORGET_UNANNOUNCED
    assert low.peers() == []


def test_gone_stops_dialling_but_not_a_live_link() -> None:
    low = of(LOW)
    low.peer_found(HIGH, 0.0)
    low.take()
    low.peer_gone(HIGH.guid)
    assert low.next_timer() is None
    low.dial_failed(HIGH.guid, "refused", 1.0)
    assert low.peers() == []
    low.link_up(1, HIGH, 2.0, dialled=False)
    low.peer_gone(HIGH.guid)
    assert low.take() == [("up", 1)]
    low.link_down(1, "lost", 4.0)
    assert low.next_timer() is None
    assert low.peers() == []


@pytest.mark.parametrize("code", [Refusal.VERSION, Refusal.DOMAIN, Refusal.DUPLICATE])
def test_lasting_refusal_is_reported_once_and_retried_slowly(code: Refusal) -> None:
    low = of(LOW)
    low.peer_found(HIGH, 0.0)
    now, said = 0.0, 0
    for _ in range(5):
        before = now
        while not dials(outputs := low.take()):
            said += sum(o[0] == "refused" for o in outputs)
            due = low.next_timer()
            assert due is not None
            now = due
            low.handle_timer(now)
        assert now == 0 or now - before >= REFUSED_RETRY
        low.dial_refused(HIGH.guid, Refuse(code, "do this"), now)
        assert low.peers()[0].state == "refused"
    assert said + sum(o[0] == "refused" for o in low.take()) == 1
    low.peer_found(AGAIN, now)
    assert until_dial(low, now)[0] == now, "a restart deserves a new try at once"


def test_a_new_instance_replaces_its_ghost() -> None:
    low = of(LOW)
    low.peer_found(HIGH, 0.0)
    low.link_up(1, HIGH, 0.0, dialled=True, endpoint=HIGH.guid.endpoint)
    low.take()
    low.peer_found(AGAIN, 1.0)
    assert low.take() == [
        ("close", 1, "the peer restarted"),
        ("down", 1, "the peer restarted"),
        ("dial", AGAIN.guid, AGAIN.endpoints, False),
    ]
    low.link_up(2, AGAIN, 1.1, dialled=True, endpoint=AGAIN.guid.endpoint)
    assert low.take() == [("up", 2)]
    low.peer_found(HIGH, 1.2)
    low.peer_gone(HIGH.guid)
    low.link_down(1, "late", 1.4)
    assert low.take() == []
    assert low.peers()[0].state == "linked"


def test_two_live_instances_with_one_address_are_refused() -> None:
    low = of(LOW, alive=True)
    low.link_up(1, HIGH, 0.0, dialled=False)
    verdict = low.judge(Hello.of(AGAIN, lease=1.0, expected=None), 1.0)
    assert verdict is not None
    assert verdict.code == Refusal.DUPLICATE


def test_invented_identities_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(core_limits, "PEERS_MAX", 256)
    low = of(LOW)
    for i in range(2 * core_limits.PEERS_MAX):
        stranger = Identity(Guid.of("10.1.0.0", i + 1), i.to_bytes(16, "big"), "x")
        low.link_up(i + 1, stranger, 0.0, dialled=False)
        low.link_down(i + 1, "lost", 0.0)
    assert len(low.peers()) <= core_limits.PEERS_MAX


def test_own_identity_is_no_peer() -> None:
    low = of(LOW)
    low.peer_found(LOW, 0.0)
    low.peer_found(replace(LOW, instance=b"x" * 16), 0.0)
    assert low.peers() == []


class Crossing:
    """Both dial at once; what is in flight is delivered in an order that the test chooses.

    Link ids are 1 for the lower's call and 2 for the higher's, on both sides. What one side sends on one
    connection stays in order, as TCP keeps it.
    """

    def __init__(self) -> None:
        self.sides = {"low": of(LOW), "high": of(HIGH)}
        self.who = {"low": LOW, "high": HIGH}
        self.wires: dict[tuple[int, str], list[Refuse | str]] = {(1, "high"): ["hello"], (2, "low"): ["hello"]}
        self.used: dict[str, int | None] = {"low": None, "high": None}
        self.sides["low"].peer_found(HIGH, 0.0)
        self.sides["high"].peer_found(LOW, -DIAL_FALLBACK)
        self.sides["high"].handle_timer(0.0)
        for side in self.sides.values():
            assert len(dials(side.take())) == 1

    def choices(self) -> list[tuple[int, str]]:
        return sorted(k for k, queue in self.wires.items() if queue)

    def deliver(self, wire: tuple[int, str]) -> None:
        link, me = wire
        what = self.wires[wire].pop(0)
        peering, other = self.sides[me], "low" if me == "high" else "high"
        theirs = self.who[other]
        if isinstance(what, Refuse):
            peering.dial_refused(theirs.guid, what, 0.0)
        elif what == "hello":
            verdict = peering.judge(Hello.of(theirs, lease=1.0, expected=self.who[me].guid), 0.0)
            self.send(link, other, verdict if verdict is not None else "welcome")
            if verdict is None:
                peering.link_up(link, theirs, 0.0, dialled=False)
        elif what == "welcome":
            peering.link_up(link, theirs, 0.0, dialled=True, endpoint=theirs.guid.endpoint)
        else:
            peering.link_down(link, "bye", 0.0)
        self.act(me, other)

    def act(self, me: str, other: str) -> None:
        for output in self.sides[me].take():
            if output[0] == "close":
                self.send(output[1], other, "bye")
            elif output[0] == "up":
                assert self.used[me] is None, "one link at a time"
                self.used[me] = output[1]
            elif output[0] == "down":
                assert self.used[me] == output[1]
                self.used[me] = None
            else:
                assert output[0] != "dial", "nothing more to dial"

    def send(self, link: int, to: str, what: Refuse | str) -> None:
        self.wires.setdefault((link, to), []).append(what)


def test_lower_guids_link_stays_in_any_order() -> None:
    todo: list[list[tuple[int, str]]] = [[]]
    ends = 0
    while todo:
        path = todo.pop()
        world = Crossing()
        for wire in path:
            world.deliver(wire)
        choices = world.choices()
        todo.extend([*path, choice] for choice in choices)
        if not choices:
            ends += 1
            assert world.used == {"low": 1, "high": 1}, path
    assert ends >= 6


# --- peers that nobody has linked yet, of which many may be invented ---------------------------------------------


def stranger(number: int) -> Identity:
    return Identity(Guid.of(f"10.1.{number // 250}.{1 + number % 250}", 40000), number.to_bytes(16, "big"), "forged")


class Network:
    """Answers the dials of one peering at once: existing peers are linked, others do not answer."""

    def __init__(self, *there: Identity) -> None:
        self.peering = of(LOW)
        self.there = {identity.guid: identity for identity in there}
        self.now = 0.0
        self.dialled: list[tuple[float, Guid]] = []
        self.links = 0

    def find(self, *identities: Identity) -> None:
        for identity in identities:
            self.peering.peer_found(identity, self.now)
            self.answer()

    def answer(self) -> None:
        while outputs := self.peering.take():
            for output in outputs:
                if output[0] != "dial":
                    continue
                self.dialled.append((self.now, output[1]))
                identity = self.there.get(output[1])
                if identity is None:
                    self.peering.dial_failed(output[1], "nobody there", self.now)
                else:
                    self.links += 1
                    self.peering.link_up(
                        self.links, identity, self.now, dialled=True, endpoint=identity.guid.endpoint
                    )

    def run(self, seconds: float) -> int:
        """Let time pass; return how many dials that were."""
        before, end = len(self.dialled), self.now + seconds
        while (due := self.peering.next_timer()) is not None and due <= end:
            self.now = max(self.now, due)
            self.peering.handle_timer(self.now)
            self.answer()
        self.now = end
        return len(self.dialled) - before

    def first(self, identity: Identity) -> float:
        return next(at for at, guid in self.dialled if guid == identity.guid)

    def linked(self) -> list[str]:
        return [status.identity.name for status in self.peering.peers() if status.state == "linked"]


@pytest.mark.parametrize("count", [100, 160])
def test_silent_peers_share_one_dial_rate(count: int) -> None:
    network = Network()
    network.find(*map(stranger, range(count)))
    first = network.run(60.0) + limits.DIAL_STRANGERS_BURST
    assert first <= limits.DIAL_STRANGERS_BURST + 60 * limits.DIAL_STRANGERS_RATE + 1
    assert {guid for _, guid in network.dialled} == {stranger(n).guid for n in range(count)}, "each had its turn"
    # And they are dialled for ever, as seldom as there are many of them.
    assert 30 * limits.DIAL_STRANGERS_RATE <= network.run(60.0) <= 60 * limits.DIAL_STRANGERS_RATE + 1


def test_bound_does_not_slow_down_a_few_silent_peers() -> None:
    network = Network()
    network.find(*map(stranger, range(10)))
    network.run(10.0)
    for number in range(10):
        at = [when for when, guid in network.dialled if guid == stranger(number).guid]
        assert at[0] == 0.0
        assert max(b - a for a, b in itertools.pairwise(at)) <= limits.BACKOFF_MAX


def test_new_peer_is_dialled_at_once_among_many_silent_ones() -> None:
    network = Network(HIGH)
    network.find(*map(stranger, range(160)))
    network.run(0.5)
    network.find(HIGH)
    network.run(2.0)
    assert network.linked() == ["high"]
    assert network.first(HIGH) - 0.5 <= 2 / limits.DIAL_STRANGERS_RATE + 1e-6


def test_forged_peers_do_not_starve_a_waiting_one() -> None:
    """Each second a hundred new ones, of which none was dialled; a real one that was not there at first comes up."""
    network = Network()
    network.find(HIGH)
    network.now = 1.0
    network.there[HIGH.guid] = HIGH
    for second in range(60):
        for number in range(100):
            network.find(stranger(second % 5 * 100 + number))
            network.run(0.01)
        for number in range(100):
            network.peering.peer_gone(stranger(second % 5 * 100 + number).guid)
    assert network.linked() == ["high"]


def test_a_stranger_that_leaves_the_line_is_not_dialled() -> None:
    peering = of(LOW)
    crowd = [stranger(number) for number in range(limits.DIAL_STRANGERS_BURST + 2)]
    for identity in crowd:
        peering.peer_found(identity, 0.0)
    *_, gone, kept = crowd
    assert len(dials(peering.take())) == limits.DIAL_STRANGERS_BURST
    peering.peer_gone(gone.guid)
    peering.handle_timer(1.0)
    assert dials(peering.take()) == [kept.guid.endpoint]
    assert peering.next_timer() is None


def full_mesh(monkeypatch: pytest.MonkeyPatch) -> Peering:
    """A module of a mesh of four that is full."""
    monkeypatch.setattr(limits, "MODULES_MAX", 4)
    peering = of(LOW)
    for number in range(1, 4):
        peering.peer_found(stranger(number), 0.0)
        peering.link_up(number, stranger(number), 0.0, dialled=True, endpoint=stranger(number).guid.endpoint)
    peering.take()
    return peering


def hello_of(identity: Identity) -> Hello:
    return Hello.of(identity, lease=1.0, expected=LOW.guid)


def test_a_full_mesh_neither_dials_nor_accepts_one_more_until_discovery_has_given_up_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    peering = full_mesh(monkeypatch)
    peering.peer_found(stranger(4), 1.0)
    assert dials(peering.take()) == []
    assert peering.judge(hello_of(stranger(4)), 1.0) is FULL
    (status,) = [each for each in peering.peers() if each.identity == stranger(4)]
    assert (status.state, status.last_error) == ("refused", str(FULL))
    peering.link_down(2, "silent", 2.0, silent=True)
    assert peering.judge(hello_of(stranger(4)), 3.0) is FULL, "the place is kept for the one that is away"
    assert peering.judge(hello_of(stranger(2)), 3.0) is None
    peering.peer_gone(stranger(2).guid)
    assert peering.judge(hello_of(stranger(4)), 4.0) is None
    assert until_dial(peering, 4.0)[0] < 4.0 + REFUSED_RETRY


def test_a_module_for_which_there_is_no_place_says_so_once() -> None:
    peering = of(LOW)
    for number in (1, 2):
        peering.peer_found(stranger(number), 0.0)
        peering.dial_refused(stranger(number).guid, FULL, 0.1, stranger(number).guid.endpoint)
    assert [output for output in peering.take() if output[0] == "refused"] == [("refused", stranger(1), FULL)]
    assert peering.left_out
    peering.link_up(1, stranger(1), 1.0, dialled=True, endpoint=stranger(1).guid.endpoint)
    assert not peering.left_out
