"""What is shown of a module that knocks: what it says proves nothing, and takes no member's name."""

from __future__ import annotations

import pytest

from rmpa.core.identity import Guid, Identity
from rmpa.discovery.beacon import Stranger
from rmpa.observe.snapshot_builder import judge_refusal, judge_stranger, judge_strangers
from rmpa.trust.permissions import MemberInfo, TrustReason, TrustStatus

MEMBER = TrustStatus(on=True, module="pc", authority="base", revoked=("old", "back"))
LONE = TrustStatus(on=True, module="pc")
AUTHORITY = TrustStatus(
    on=True,
    module="base",
    is_authority=True,
    revoked=("old", "back"),
    members=tuple(MemberInfo(name=name, issued=1, expires=9) for name in ("base", "back", "lost")),
)
INVITE = "rmpa trust invite --module arm"
PLAIN, OLD_KEY = TrustReason.UNSECURED, TrustReason.REVOKED


@pytest.mark.parametrize(
    ("trust", "name", "reason", "state", "words", "invite"),
    [
        (AUTHORITY, "arm", PLAIN, "pending", f"not proved; if it is yours, run here: {INVITE} (", INVITE),
        (MEMBER, "arm", PLAIN, "pending", f"not proved; if it is yours, run on base: {INVITE} (", INVITE),
        (LONE, "arm", PLAIN, "pending", f"run on the authority: {INVITE} (", INVITE),
        # A member's name, and this module's own.
        (AUTHORITY, "pc", PLAIN, "foreign", "it uses the name pc without a certificate", ""),
        (AUTHORITY, "PC", PLAIN, "foreign", "do not invite it", ""),
        (MEMBER, "pc", TrustReason.KEY, "foreign", "do not invite it", ""),
        # One that has joined and was not started again, or has lost its files.
        (
            AUTHORITY,
            "lost",
            PLAIN,
            "pending",
            "if it is lost, its agent runs without its keys: restart it: sudo systemctl restart rmpa if",
            "rmpa trust invite --module lost",
        ),
        # Revoked ones, with their former group key or with none any more; and one that has joined again since.
        (MEMBER, "old", OLD_KEY, "revoked", "rmpa trust leave --yes on old, then run on base: rmpa trust invite", ""),
        (AUTHORITY, "old", PLAIN, "revoked", "then run here: rmpa trust invite --module old", ""),
        (AUTHORITY, "back", PLAIN, "pending", "if it is back, its agent", "rmpa trust invite --module back"),
        # Names that differ only in case: none is offered beside a member's, or as one that was never revoked.
        (AUTHORITY, "Lost", PLAIN, "foreign", "it uses the name Lost without a certificate; do not invite it", ""),
        (AUTHORITY, "OLD", PLAIN, "revoked", "its beacons have the name OLD, which was revoked", ""),
        # Another mesh, another release, another clock: as the beacons' refusal says.
        (AUTHORITY, "arm", TrustReason.FOREIGN, "foreign", "the problem", ""),
        (AUTHORITY, "arm", TrustReason.KEY, "foreign", "the problem", ""),
        (AUTHORITY, "arm", None, "foreign", "the problem", ""),
        (None, "arm", None, "foreign", "the problem", ""),
    ],
)
def test_a_module_that_knocks(
    trust: TrustStatus | None, name: str, reason: TrustReason | None, state: str, words: str, invite: str
) -> None:
    shown = judge_stranger(name, reason, "the problem", trust=trust, members={"base", "pc"})
    assert shown is not None
    assert (shown[0], shown[2]) == (state, invite)
    assert words in shown[1]


@pytest.mark.parametrize(("trust", "name"), [(MEMBER, "arm"), (AUTHORITY, "arm"), (None, "old")])
def test_a_member_that_was_away_with_the_former_key_is_not_shown(trust: TrustStatus | None, name: str) -> None:
    assert judge_stranger(name, OLD_KEY, "", trust=trust, members={"base", "pc"}) is None


def test_one_that_joined_again_and_is_linked_is_not_shown_for_its_former_key() -> None:
    assert judge_stranger("back", OLD_KEY, "", trust=MEMBER, members={"base", "back"}) is None


@pytest.mark.parametrize(
    ("relayed", "joined", "shown"),
    [
        ((), {}, ["arm", "10.0.0.9:4000"]),
        (("Arm",), {}, ["10.0.0.9:4000"] * 2),
        ((), {"ARM": 4.5}, ["10.0.0.9:4000"] * 2),
        ((), {"ARM": 6.0}, ["10.0.0.9:4000"]),  # heard at 5.0, before its link
    ],
)
def test_a_members_name_is_not_shown_among_strangers(
    relayed: tuple[str, ...], joined: dict[str, float], shown: list[str]
) -> None:
    at = Guid.of("10.0.0.9", 4000)
    heard = [Stranger(Identity(at, b"i" * 16, name, domain=0), "", PLAIN, 4.0, 5.0) for name in ("arm", "PC")]
    assert [
        one.name for one in judge_strangers(heard, 7.0, AUTHORITY, joined=joined, others={"pc", *relayed})
    ] == shown


def test_to_a_module_without_keys_a_secured_mesh_is_pending_and_another_mesh_is_foreign() -> None:
    state, text, invite = judge_refusal(TrustReason.PLAIN, "arm")
    assert (state, invite) == ("pending", INVITE)
    assert f"to join it, run on its authority: {INVITE} (it prints the line to run here)" in text
    state, text, invite = judge_refusal(TrustReason.PLAIN, "arm", "sudo systemctl restart rmpa")
    assert (state, invite) == ("pending", "")
    assert text.endswith("its agent runs without; restart it: sudo systemctl restart rmpa")
    assert judge_refusal(TrustReason.FOREIGN, "arm")[::2] == ("foreign", "")
