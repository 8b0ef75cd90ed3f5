"""Which gateway leads: never two that hear each other, and one that is left takes over."""

from __future__ import annotations

import random

from rmpa.gateway.sites.catalogue import Leader
from rmpa.gateway.sites.keys import SiteGateway

PATIENCE = 1.0


def gateway(rank: int, number: int | None = None, site: str = "home") -> SiteGateway:
    return SiteGateway(site, rank, f"{rank if number is None else number:032x}")


def leads(leader: Leader) -> bool:
    """Asked by a function, since a type checker takes the attribute for unchanged."""
    return leader.leads


def test_the_lowest_rank_leads_and_of_equal_ones_the_lowest_instance() -> None:
    for own, other in ((gateway(2), gateway(1)), (gateway(1, 5), gateway(1, 4))):
        leader = Leader(own, PATIENCE, 0.0)
        leader.handle_timer(1.0)
        leader.seen(other, 2.0)
        assert not leads(leader)
        assert leader.leader == other
        assert leader.next_timer() is None


def test_the_next_one_takes_over_after_its_patience_and_other_sites_and_its_own_token_do_not_count() -> None:
    leader = Leader(gateway(2), PATIENCE, 0.0)
    leader.seen(gateway(1), 0.5)
    leader.gone(gateway(1), 3.0)
    for other in (gateway(1, 3, "elsewhere"), gateway(2)):
        leader.seen(other, 3.1)
    leader.handle_timer(3.9)
    assert not leads(leader)
    leader.handle_timer(4.0)
    assert leads(leader)


def test_of_gateways_that_hear_each_other_at_most_one_leads() -> None:
    for seed in range(200):
        rng = random.Random(seed)
        owns = [gateway(rng.randint(0, 3), number) for number in range(4)]
        leaders = {own: Leader(own, PATIENCE, 0.0) for own in owns}
        up: set[SiteGateway] = set(owns)
        for a in owns:
            for b in owns:
                leaders[a].seen(b, 0.0)
        now = 0.0
        for _ in range(60):
            now += rng.random()
            changed = rng.choice(owns)
            for other in owns:
                if changed in up:
                    leaders[other].gone(changed, now)
                else:
                    leaders[other].seen(changed, now)
            up ^= {changed}
            for leader in leaders.values():
                leader.handle_timer(now)
            # A token that is down belongs to a gateway that does not run: it is not asked.
            assert sum(leaders[own].leads for own in up) <= 1, (seed, now)
        now += PATIENCE
        for leader in leaders.values():
            leader.handle_timer(now)
        assert sum(leaders[own].leads for own in up) == (1 if up else 0)
