"""Every fuzz target: its seeds, seeded mutations of them, and hypothesis's own bytes.

``make test-long`` makes more of them (FUZZ_MUTATIONS), ``python -m tests.fuzz --seconds 60`` as many as it can.
"""

from __future__ import annotations

import os
import random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz import targets
from tests.fuzz.mutate import mutate

MUTATIONS = int(os.environ.get("FUZZ_MUTATIONS", "500"))
every_target = pytest.mark.parametrize("name", targets.names())


@every_target
def test_seeds(name: str) -> None:
    target = targets.load(name)
    assert target.seeds
    for seed in target.seeds:
        target.fuzz(seed)


@every_target
def test_seeded_mutations(name: str) -> None:
    target = targets.load(name)
    rng = random.Random(f"rmpa {name}")
    for number in range(MUTATIONS):
        data = mutate(rng, target.seeds)
        try:
            target.fuzz(data)
        except Exception as error:
            error.add_note(f"mutation {number} of {name}: fuzz({data!r})")
            raise


@every_target
def test_any_bytes(name: str) -> None:
    target = targets.load(name)

    @settings(max_examples=MUTATIONS // 10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
    @given(st.binary(max_size=512))
    def run(data: bytes) -> None:
        target.fuzz(data)

    run()
