"""What ``rmpa doctor`` says of a module's part in a secured mesh."""

from __future__ import annotations

from rmpa.observe.doctor.agents import judge_membership
from rmpa.observe.peer_info import FAIL, OK, WARN
from rmpa.trust.permissions import TrustStatus

WALL = 1_790_000_000.0


def test_a_certificate_that_is_near_its_end_or_behind_it_is_told() -> None:
    whole = TrustStatus(on=True, module="arm", expires=int(WALL) + 7200, key=3, deny_number=1)
    check = judge_membership(whole, WALL)
    assert (check.level, check.text) == (
        OK,
        "its certificate is valid for 2 h more; group key 3, deny list 1",
    )
    near = TrustStatus(
        on=True, module="arm", expires=int(WALL) + 7200, problems=("ends in 2 h; start the authority",)
    )
    check = judge_membership(near, WALL)
    assert (check.level, check.text, check.remedy) == (WARN, "ends in 2 h", "start the authority")
    assert judge_membership(near, WALL + 8000).level is FAIL


def test_a_clock_that_is_not_set_is_a_warning() -> None:
    unset = TrustStatus(on=True, module="arm", expires=5, clock_set=False, problems=("not set; set it",))
    assert judge_membership(unset, WALL).level is WARN
