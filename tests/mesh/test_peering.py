"""Which side dials, when, and which of two links stays."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity
from rmpa.mesh import limits
from rmpa.mesh.frames import FULL, Hello, Refusal, Refuse
from rmpa.mesh.peering import LINK_STABLE, REFUSED_RETRY, Peering, PeeringOutput
from tests.mesh.worlds import HIGH, LOW, Known, with_peer

AGAIN = Identity(Guid.of("10.0.0.2", 40002, 2), b"A" * 16, "high")


def of(ours: Identity) -> Peering[Known]:
    return Peering(ours, rng=lambda: 0.999999)


def dials(outputs: list[PeeringOutput[Known]]) -> list[tuple[str, int]]:
    return [dial[2][0] for dial in outputs if dial[0] == "dial"]


def until_dial(peering: Peering[Known], now: float) -> tuple[float, tuple[str, int]]:
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
    peering, links = of(LOW), []
    for number in range(1, count + 1):
        identity = Identity(Guid.of(f"10.1.{number}.2", 40002), bytes([number]) * 16, f"peer{number}")
        links.append(with_peer(identity))
        peering.peer_found(identity, -100.0)
        peering.link_up(links[-1], -99.0)
    peering.take()
    for link in links:
        peering.link_down(link, "silent", 0.0, silent=True, needed=needed)
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


def test_a_silent_link_is_replaced_by_a_new_connection_on_any_path() -> None:
    """Each attempt is short; the next one follows while the link is silent, and none once it is heard again."""
    low, link = of(LOW), with_peer(HIGH)
    low.peer_found(HIGH, 0.0, "10.9.0.2")
    low.link_up(link, 0.0)
    low.take()
    link.alive, link.stuck = False, True
    low.link_silent(link)
    low.link_silent(link)
    endpoints = (HIGH.guid.endpoint, ("10.9.0.2", HIGH.guid.port))
    assert low.take() == [("dial", HIGH.guid, endpoints, True)]
    low.dial_failed(HIGH.guid, "no answer", 1.0)
    assert until_dial(low, 1.0)[0] == 1.0 + limits.REDIAL_PAUSE
    assert low.dial_opened(HIGH.guid, 1.1)
    link.stuck = False
    assert not low.dial_opened(HIGH.guid, 1.2), "it waits for nothing"
    low.link_silent(link)
    link.alive = True
    low.take()
    low.dial_failed(HIGH.guid, "no answer", 2.0)
    assert low.next_timer() is None
    assert (low.peers()[0].state, low.peers()[0].last_error) == ("linked", "")


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
    for number in range(1, 9):
        before = now
        now, _ = until_dial(low, now)
        pauses.append(now - before)
        low.link_up(link := with_peer(HIGH), now)
        now += 0.01 if number < 7 else LINK_STABLE
        low.link_down(link, "lost", now)
    assert pauses[5] > 1.0
    now, _ = until_dial(low, now)
    assert now - (before + pauses[-1]) <= LINK_STABLE + limits.BACKOFF_FIRST


def test_unannounced_peer_is_forgotten_after_its_link() -> None:
    low, link = of(LOW), with_peer(HIGH, dialled=False)
    low.link_up(link, 0.0)
    assert low.take() == [("up", link)]
    low.link_down(link, "lost", 10.0)
    assert low.take() == [("down", link, "lost")]
    now = 10.0
    while (due := low.next_timer()) is not None:
        now = due
        low.handle_timer(now)
        for output in low.take():
            assert output[0] == "dial"
            low.dial_failed(output[1], "refused", now)
    assert now <= 10.0 + limits.FORGET_UNANNOUNCED
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
    low, ghost, link = of(LOW), with_peer(HIGH), with_peer(AGAIN)
    low.peer_found(HIGH, 0.0)
    low.link_up(ghost, 0.0)
    low.take()
    low.peer_found(AGAIN, 1.0)
    assert low.take() == [
        ("close", ghost, "the peer restarted"),
        ("down", ghost, "the peer restarted"),
        ("dial", AGAIN.guid, AGAIN.endpoints, False),
    ]
    low.link_up(link, 1.1)
    assert low.take() == [("up", link)]
    low.peer_found(HIGH, 1.2)
    low.peer_gone(HIGH.guid)
    low.link_down(ghost, "late", 1.4)
    assert low.take() == []
    assert low.peers()[0].state == "linked"


def test_two_live_instances_with_one_address_are_refused() -> None:
    low = of(LOW)
    low.link_up(with_peer(HIGH, dialled=False), 0.0)
    verdict = low.judge(Hello.of(AGAIN, lease=1.0, expected=None), 1.0)
    assert verdict is not None
    assert verdict.code == Refusal.DUPLICATE


def test_invented_identities_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(core_limits, "PEERS_MAX", 256)
    low = of(LOW)
    for i in range(2 * core_limits.PEERS_MAX):
        stranger = Identity(Guid.of("10.1.0.0", i + 1), i.to_bytes(16, "big"), "x")
        low.link_up(link := with_peer(stranger, dialled=False), 0.0)
        low.link_down(link, "lost", 0.0)
    assert len(low.peers()) <= core_limits.PEERS_MAX


def test_own_identity_is_no_peer() -> None:
    low = of(LOW)
    low.peer_found(LOW, 0.0)
    low.peer_found(replace(LOW, instance=b"x" * 16), 0.0)
    assert low.peers() == []


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
                    self.peering.link_up(with_peer(identity), self.now)

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


def hello_of(identity: Identity) -> Hello:
    return Hello.of(identity, lease=1.0, expected=LOW.guid)


def test_a_full_mesh_neither_dials_nor_accepts_one_more_until_discovery_has_given_up_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limits, "MODULES_MAX", 4)
    peering, links = of(LOW), [with_peer(stranger(number)) for number in range(1, 4)]
    for link in links:
        peering.peer_found(link.identity, 0.0)
        peering.link_up(link, 0.0)
    peering.take()
    peering.peer_found(stranger(4), 1.0)
    assert dials(peering.take()) == []
    assert peering.judge(hello_of(stranger(4)), 1.0) is FULL
    (status,) = [each for each in peering.peers() if each.identity == stranger(4)]
    assert (status.state, status.last_error) == ("refused", str(FULL))
    peering.link_down(links[1], "silent", 2.0, silent=True)
    assert peering.judge(hello_of(stranger(4)), 3.0) is FULL, "the place is kept for the one that is away"
    assert peering.judge(hello_of(stranger(2)), 3.0) is None
    peering.peer_gone(stranger(2).guid)
    assert peering.judge(hello_of(stranger(4)), 4.0) is None
    assert until_dial(peering, 4.0)[0] < 4.0 + REFUSED_RETRY
