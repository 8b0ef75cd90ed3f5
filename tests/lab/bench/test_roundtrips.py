"""Who cannot take part is left out with the reason, and the others are compared all the same."""

from __future__ import annotations

import io
import sys
from array import array
from typing import TYPE_CHECKING

from rich.console import Console

from lab.bed.bench import Bed
from lab.bed.processes import Deadline, Process
from lab.bed.ros import NODES
from lab.bench import contenders
from lab.bench.contenders import Entry
from lab.bench.roundtrips import TripScore, claims, rows, start_all

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from lab.bench.contenders import RoundTripPath


def unstartable(_bed: Bed) -> RoundTripPath:
    raise Deadline("it said nothing")


def test_the_first_reason_is_told() -> None:
    assert Entry(unstartable, needs=(lambda: "", lambda: "no cable")).why_not() == "no cable"


def test_what_does_not_start_is_left_out_and_the_rest_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(contenders.ENTRIES, "dead", Entry(unstartable))
    monkeypatch.setitem(contenders.ENTRIES, "missing", Entry(unstartable, needs=(lambda: "no cable",)))
    left_out: dict[str, str] = {}
    with Bed() as bed:
        assert start_all(bed, ["dead", "missing"], left_out, Console(file=io.StringIO())) == []
    assert left_out.keys() == {"dead", "missing"}
    assert "it said nothing" in left_out["dead"]


def test_each_is_compared_with_roscpp_and_ours_with_it() -> None:
    scores = {
        (key, 64): TripScore(array("Q", [2000 * us] * 10))
        for key, us in (("roscpp_nodelay", 50), ("agents_hosts", 80), ("relays", 40))
    }
    titles = {"roscpp_nodelay": "roscpp", "relays": "relays"}
    found = {row["contender"]: (row["to_roscpp"], row["agents_to_it"]) for row in rows(scores, titles)}
    assert found == {"roscpp_nodelay": (1.0, 1.6), "relays": (0.8, 2.0)}


def test_the_direct_transport_is_held_against_roscpp_over_the_same_cable() -> None:
    def score(us: int) -> TripScore:
        return TripScore(array("Q", [2000 * us] * 980 + [4000 * us] * 20))

    scores = {
        (key, 64): score(us) for key, us in (("roscpp_hosts", 100), ("direct_hosts", 104), ("agents_hosts", 150))
    }
    found = {claim.text: (claim.value, claim.reached) for claim in claims(scores)}
    assert found == {
        "64 B, p50, RMPA direct / roscpp over the same cable": (1.04, True),
        "64 B, p99, RMPA direct / roscpp over the same cable": (1.04, True),
    }
    assert claims({("agents_hosts", 64): score(150)}) == []


def test_a_ping_answers_lines_with_samples_and_losses(tmp_path: Path) -> None:
    program = tmp_path / "ping.py"
    program.write_text(
        "import sys\n"
        f"sys.path.insert(0, {str(NODES)!r})\n"
        "from roundtrips import measure\n"
        "answers = iter([False, True] + [True, False, True])\n"
        "measure(lambda size: lambda: next(answers))\n"
    )
    samples = tmp_path / "samples"
    with Process([sys.executable, program], commands=True) as ping:
        ping.wait_event("ready")
        ping.tell(f"64 3 {samples}")
        assert ping.wait_event("round")["lost"] == 1
    assert len(samples.read_bytes()) == 2 * 8
