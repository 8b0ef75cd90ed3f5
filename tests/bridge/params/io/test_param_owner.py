"""What the permissions of a secured mesh keep from a peer that asks for a module's parameters."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge.params import rules as transfer
from rmpa.bridge.params.owner import read_text, write_text
from rmpa.bridge.policy import OPEN_GATE, PermissionGate
from rmpa.config.peer_rules import Effect, PermissionRule
from rmpa.config.settings import ParamSettings, TrustSettings
from rmpa.core.errors import PeerRefused
from rmpa.trust.permissions import Permissions
from tests.bridge.params.io.test_part import Side, join

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.ros.wire.xmlrpc import XmlRpcValue


def denying(*names: str) -> PermissionGate:
    """Permissions by which a peer may have all parameters but these."""
    allow = PermissionRule(("*",), names={"param": ("/**",)})
    deny = PermissionRule(("*",), names={"param": names}, effect=Effect.DENY)
    return PermissionGate(Permissions(TrustSettings(rules=(allow, deny))))


@asynccontextmanager
async def linked(params: ParamSettings, gate: PermissionGate = OPEN_GATE) -> AsyncIterator[tuple[Side, Side]]:
    """An owner with these rules, and a peer of it."""
    owner, peer = Side("base", params, gate=gate), Side("pad")
    try:
        join(owner, peer)
        yield owner, peer
    finally:
        await owner.close()
        await peer.close()


ALL = ParamSettings(remote_get=("/**",), remote_set=("/**",))


@pytest.mark.parametrize("denied", ["/motors/limit", "/motors/*", "/**/limit"])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("/motors/limit", {"": 5}),
        ("/motors/limit/", {"": 5}),
        ("/motors", {"limit/": 5}),
        ("/", {"motors/limit": 5}),
        ("/", {"motors/limit/": 5}),
    ],
)
async def test_a_slash_at_the_end_does_not_pass_a_deny(denied: str, key: str, value: XmlRpcValue) -> None:
    async with linked(ALL, denying(denied)) as (owner, peer):
        owner.core.set("/motors/limit", 1)
        with pytest.raises(PeerRefused, match="do not let pad read or set"):
            await peer.ask(transfer.SET, {"key": key, "text": await write_text("", value)})
        assert owner.core.get("/motors/limit") == 1
        await peer.ask(transfer.SET, {"key": "/speed", "text": await write_text("", {"max": 2})})
        assert owner.core.get("/speed/max") == 2


async def test_without_trust_a_member_with_a_slash_at_its_end_is_set_as_before() -> None:
    async with linked(ALL) as (owner, peer):
        await peer.ask(transfer.SET, {"key": "/motors", "text": await write_text("", {"limit/": 5})})
        assert owner.core.get("/motors") == {"limit": 5}


async def test_an_error_does_not_name_a_parameter_that_the_permissions_hide() -> None:
    """The globs of [params] refuse it as well, and their error names the first parameter that none fits."""
    async with linked(ParamSettings(remote_get=("/open/**", "/run_id")), denying("/secret/**")) as (owner, peer):
        owner.core.set("/open", {"a": 1})
        owner.core.set("/secret/door", 1234)
        with pytest.raises(PeerRefused) as caught:
            await peer.ask(transfer.GET, {"key": "/"})
        assert "secret" not in str(caught.value)
        text = (await peer.ask(transfer.GET, {"key": "/open"}))["text"]
        assert await read_text(text) == {"a": 1}


async def test_a_peer_that_names_other_sites_is_refused_and_logged_by_its_own_name(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """What a member says of the sites that ask is not proved: it must not fill the log, nor put others in it."""
    async with linked(ALL, denying("/door")) as (owner, peer):
        for number in range(20):
            with pytest.raises(PeerRefused, match="permissions there do not let"):
                await peer.ask(transfer.GET, {"key": "/door", "site": f"site{number}", "askers": ["base"]})
        assert owner.params.owner._gate._counters["permission.param"] == 20
    lines = [record.getMessage() for record in caplog.records if "may not" in record.getMessage()]
    assert [line[: len("! pad may not")] for line in lines] == ["! pad may not"]


@pytest.mark.parametrize("site", [0, False, [], {}, 0.0])
async def test_what_is_no_name_of_a_site_is_refused(site: object) -> None:
    async with linked(ALL, denying("/door")) as (owner, peer):
        with pytest.raises(PeerRefused, match="is not the name of a site or a module"):
            await peer.ask(transfer.GET, {"key": "/run_id", "site": site})
        assert owner.counters["ask.failed"] == 0
