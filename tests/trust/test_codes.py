"""The six-digit code: two machines agree, and something between them cannot make them agree."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.trust import limits
from rmpa.trust.codes import (
    CodeContext,
    CodeState,
    InvitingCode,
    JoiningCode,
    code_of,
    code_text,
    commitment_to,
)

CONTEXT = CodeContext("arm", b"m" * 32, b"a" * 32, b"token-id")
JOINING, INVITING = b"j" * 32, b"i" * 32


def _pair(
    joining: CodeContext = CONTEXT, inviting: CodeContext = CONTEXT, nonces: tuple[bytes, bytes] = (JOINING, INVITING)
) -> tuple[JoiningCode, InvitingCode]:
    """Both machines, up to the code."""
    one, other = JoiningCode(joining, nonces[0], 0.0), InvitingCode(nonces[1], 0.0)
    nonce = other.receive_commitment(one.commitment, inviting)
    other.receive_nonce(one.receive_nonce(nonce))
    return one, other


def _state(machine: JoiningCode | InvitingCode) -> CodeState:
    """The state, which mypy would take for unchanged."""
    return machine.state


def test_both_sides_show_one_code() -> None:
    one, other = _pair()
    assert one.code == other.code
    assert len(one.code) == 6
    assert one.code.isdigit()
    for machine in (one, other):
        assert _state(machine) is CodeState.SHOWN
        machine.agree()
        assert _state(machine) is CodeState.AGREED
        assert machine.next_timer() is None


def test_golden_code_and_commitment() -> None:
    packed = b"".join(len(p).to_bytes(4, "big") + p for p in (b"arm", b"m" * 32, b"a" * 32, b"token-id"))
    mac = hmac.new(JOINING + INVITING, b"rmpa code 1" + packed, hashlib.sha256).digest()
    assert code_of(CONTEXT, JOINING, INVITING) == str(int.from_bytes(mac[:8], "big") % 1_000_000).zfill(6)
    assert commitment_to(JOINING, b"m" * 32) == hashlib.sha256(b"rmpa commit 1" + JOINING + b"m" * 32).digest()


def test_a_code_is_read_in_two_groups() -> None:
    assert code_text("004902") == "004 902"


@pytest.mark.parametrize(
    "other",
    [
        replace(CONTEXT, module="base"),
        replace(CONTEXT, module_key=b"x" * 32),
        replace(CONTEXT, authority_key=b"x" * 32),
        replace(CONTEXT, token_id=b"tokenid2"),
    ],
)
def test_another_context_has_another_code(other: CodeContext) -> None:
    assert code_of(CONTEXT, JOINING, INVITING) != code_of(other, JOINING, INVITING)


def test_something_between_the_machines_is_seen() -> None:
    # It has a key of its own towards each side, and repeats the joining module's messages with that.
    evil = replace(CONTEXT, module_key=b"e" * 32)
    honest = JoiningCode(CONTEXT, JOINING, 0.0)
    authority = InvitingCode(INVITING, 0.0)
    between = JoiningCode(evil, b"z" * 32, 0.0)
    nonce = authority.receive_commitment(between.commitment, evil)
    authority.receive_nonce(between.receive_nonce(nonce))
    honest.receive_nonce(nonce)
    assert honest.code != authority.code


def test_a_nonce_that_was_not_committed_to_is_refused() -> None:
    one, other = JoiningCode(CONTEXT, JOINING, 0.0), InvitingCode(INVITING, 0.0)
    other.receive_commitment(one.commitment, CONTEXT)
    with pytest.raises(RemoteProtocolError, match="not the one of the commitment"):
        other.receive_nonce(b"k" * 32)
    assert other.state is CodeState.REJECTED
    with pytest.raises(RemoteProtocolError):
        other.receive_nonce(JOINING)
    with pytest.raises(LocalProtocolError):
        other.agree()


def test_a_commitment_of_another_key_is_refused() -> None:
    other = InvitingCode(INVITING, 0.0)
    other.receive_commitment(commitment_to(JOINING, b"x" * 32), CONTEXT)
    with pytest.raises(RemoteProtocolError):
        other.receive_nonce(JOINING)


def test_no_side_tells_its_nonce_early() -> None:
    one, other = JoiningCode(CONTEXT, JOINING, 0.0), InvitingCode(INVITING, 0.0)
    for machine in (one, other):
        with pytest.raises(LocalProtocolError, match="must not be told"):
            _ = machine.nonce
        with pytest.raises(LocalProtocolError, match="no code"):
            _ = machine.code
        with pytest.raises(LocalProtocolError):
            machine.agree()
    other.receive_commitment(one.commitment, CONTEXT)
    assert other.nonce == INVITING
    one.receive_nonce(INVITING)
    assert one.nonce == JOINING


def test_messages_out_of_turn_end_the_join() -> None:
    one, other = _pair()
    with pytest.raises(RemoteProtocolError):
        one.receive_nonce(INVITING)
    assert one.state is CodeState.REJECTED
    with pytest.raises(RemoteProtocolError):
        other.receive_commitment(bytes(32), CONTEXT)
    assert other.state is CodeState.REJECTED
    early = InvitingCode(INVITING, 0.0)
    with pytest.raises(RemoteProtocolError):
        early.receive_nonce(JOINING)


def test_a_second_commitment_gives_no_second_attempt() -> None:
    other = InvitingCode(INVITING, 0.0)
    other.receive_commitment(commitment_to(JOINING, CONTEXT.module_key), CONTEXT)
    with pytest.raises(RemoteProtocolError):
        other.receive_commitment(commitment_to(b"k" * 32, CONTEXT.module_key), CONTEXT)
    assert other.state is CodeState.REJECTED


def test_the_time_of_the_users_is_bounded() -> None:
    one, other = _pair()
    for machine in (one, other):
        assert machine.next_timer() == limits.CODE_TIMEOUT
        machine.handle_timer(limits.CODE_TIMEOUT - 0.1)
        assert _state(machine) is CodeState.SHOWN
        machine.handle_timer(limits.CODE_TIMEOUT)
        assert _state(machine) is CodeState.REJECTED
        machine.handle_timer(limits.CODE_TIMEOUT + 1)


def test_rejecting_is_final() -> None:
    one, _ = _pair()
    one.reject()
    one.reject()
    with pytest.raises(LocalProtocolError):
        one.agree()


def test_agreeing_is_final() -> None:
    one, _ = _pair()
    one.agree()
    one.reject()
    assert one.state is CodeState.AGREED


@pytest.mark.parametrize("size", [0, 31, 33])
def test_wrong_lengths_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match="a nonce has 32 bytes"):
        InvitingCode(bytes(size), 0.0)
    with pytest.raises(RemoteProtocolError):
        JoiningCode(CONTEXT, JOINING, 0.0).receive_nonce(bytes(size))
    with pytest.raises(RemoteProtocolError):
        InvitingCode(INVITING, 0.0).receive_commitment(bytes(size), CONTEXT)
    with pytest.raises(ValueError, match="hashes have 32"):
        replace(CONTEXT, module_key=bytes(size))


@given(st.binary(min_size=32, max_size=32), st.binary(min_size=32, max_size=32), st.text(max_size=64))
def test_the_codes_always_agree(joining: bytes, inviting: bytes, module: str) -> None:
    context = replace(CONTEXT, module=module)
    one, other = _pair(context, context, (joining, inviting))
    assert one.code == other.code


@given(st.text(max_size=8), st.binary(min_size=8, max_size=8), st.text(max_size=8), st.binary(min_size=8, max_size=8))
def test_no_two_contexts_have_the_same_bytes(one: str, first: bytes, other: str, second: bytes) -> None:
    contexts = [CodeContext(name, bytes(32), bytes(32), token) for name, token in ((one, first), (other, second))]
    assert (contexts[0].packed() == contexts[1].packed()) is (contexts[0] == contexts[1])
