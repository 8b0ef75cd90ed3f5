"""Which requests are served, as a table of headers, and the file of the token."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.config.settings import WebSettings
from rmpa.core.errors import StartError
from rmpa.web.server.access import (
    AccessPolicy,
    AccessRefused,
    RequestFacts,
    Verdict,
    is_loopback,
    own_names,
    token_from,
)
from rmpa.web.server.process import access_of, url_of

if TYPE_CHECKING:
    from pathlib import Path

TOKEN = "t" * 43
HOSTS = own_names(("base",))
OPEN = AccessPolicy(8480, HOSTS)
CLOSED = AccessPolicy(8480, HOSTS, TOKEN)
HERE = ("base.local:8480",)


def reason(verdict: Verdict) -> str:
    return verdict.reason if isinstance(verdict, AccessRefused) else verdict


LISTED = AccessPolicy(8480, HOSTS, TOKEN, frozenset({"https://app.example", "*"}))
ORIGIN = "http://base.local:8480"
APP = {"origin": "https://app.example", "is_preflight": True}
# Each: what the request has beside ``Host: base.local:8480``, and what becomes of it.
WITHOUT_TOKEN: list[Any] = [
    # A name that is not ours is a rebound one; an address cannot be rebound.
    *(({"host": (f"{name}:8480",)}, "granted") for name in ("localhost", "localhost.", "127.0.0.1", "192.168.1.7")),
    *(({"host": (name,)}, "granted") for name in ("LOCALHOST", "base", "base.local:8480", "[::1]:8480")),
    *(({"host": (f"{name}:8480",)}, "host") for name in ("evil.example", "127.0.0.1.evil.example", "0x7f.1")),
    *(({"host": (name,)}, "host") for name in ("localhost.evil.example", "localhost:8480@evil.example", "")),
    *(({"host": names}, "host") for names in (("localhost, evil.example",), (), ("localhost", "evil.example"))),
    # Only our own pages may read.
    *(({"origin": each}, "granted") for each in (ORIGIN, "https://BASE.local:8480")),
    *(({"origin": f"http://{each}"}, "origin") for each in ("base.local:8481", "base.local", "evil.example")),
    *(({"origin": each}, "origin") for each in ("http://evil.example/base.local:8480", "null", "")),
    *(({"origin": each}, "origin") for each in ("ftp://base.local:8480", "chrome-extension://abc")),
    # A server of HTTPS takes no page of plain HTTP for its own: what is on the way can forge that page.
    *(({"origin": f"https://{each}:8480", "secure": True}, "granted") for each in ("base.local", "BASE.local")),
    *(({"origin": each, "secure": True}, "origin") for each in (ORIGIN, "HTTP://base.local:8480", "null")),
    # What other sites load is refused without an origin, too; a link on another page may lead here.
    ({"fetch_site": "same-origin", "fetch_mode": "cors"}, "granted"),
    ({"fetch_site": "none", "fetch_mode": "navigate", "is_page": True}, "granted"),
    ({"fetch_site": "cross-site", "fetch_mode": "navigate", "is_page": True}, "granted"),
    *(({"fetch_site": "cross-site", "fetch_mode": each}, "origin") for each in ("navigate", "no-cors", "websocket")),
    ({"fetch_site": "same-site", "fetch_mode": "no-cors", "is_page": True}, "origin"),  # another port of this host
]
WITH_TOKEN: list[Any] = [
    # It comes as bearer, cookie or query.
    *(({"authorization": each}, "granted") for each in (f"Bearer {TOKEN}", f"bearer  {TOKEN} ")),
    *(({"authorization": f"Bearer {each}"}, "token") for each in (f"{TOKEN}x", TOKEN[:-1], "", "\udcff\u00e4")),
    *(({"cookie": each}, "token") for each in ("old", "", None)),
    ({"authorization": f"Basic {TOKEN}"}, "token"),
    ({"cookie": TOKEN}, "granted"),
    ({"token": TOKEN}, "granted"),
    ({"token": TOKEN, "is_page": True}, "move token"),
    ({"token": TOKEN, "is_page": True, "cookie": "old"}, "move token"),
    ({"token": "wrong", "is_page": True}, "token"),
    ({"token": "wrong", "cookie": TOKEN}, "granted"),
    ({"is_open": True}, "granted"),
    # Only listed sites are told what their pages may send.
    (APP, "preflight"),
    (APP | {"origin": "https://APP.example"}, "preflight"),
    (APP | {"is_preflight": False}, "token"),
    *((APP | {"origin": each}, "origin") for each in ("http://app.example", "https://app.example:8443", "*", "null")),
    (APP | {"origin": "https://app.example.evil.example"}, "origin"),
    *((APP | {"origin": each}, "token") for each in (ORIGIN, None)),  # our own pages ask nothing before
    (APP | {"host": ("evil.example",)}, "host"),
]


@pytest.mark.parametrize(("given", "expected"), WITHOUT_TOKEN)
def test_who_may_ask_where_there_is_no_token(given: dict[str, Any], expected: str) -> None:
    assert reason(OPEN.judge(RequestFacts(**{"host": HERE, **given}))) == expected
    # The right token does not help: a rebound page would have the browser send the cookie.
    for token in ({"authorization": f"Bearer {TOKEN}"}, {"cookie": TOKEN}):
        assert reason(CLOSED.judge(RequestFacts(**{"host": HERE, **token, **given}))) == expected


@pytest.mark.parametrize(("given", "expected"), WITH_TOKEN)
def test_who_may_ask_where_there_is_a_token(given: dict[str, Any], expected: str) -> None:
    assert reason(LISTED.judge(RequestFacts(**{"host": HERE, **given}))) == expected


def test_a_refusal_says_what_to_do() -> None:
    for facts, remedy in (
        (RequestFacts(("base.lan",)), "--host"),
        (RequestFacts(HERE, origin="http://evil.example"), "open its own pages"),
        (RequestFacts(HERE), "Authorization: Bearer TOKEN"),
        (RequestFacts(HERE, cookie="old"), "the token is wrong"),
    ):
        verdict = CLOSED.judge(facts)
        assert isinstance(verdict, AccessRefused)
        assert remedy in verdict.detail


def test_only_loopback_needs_no_token() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.3.4.5", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "192.168.1.7", "base", "")))


def test_two_servers_of_one_host_have_cookies_of_their_own() -> None:
    assert AccessPolicy(8480, HOSTS).cookie != AccessPolicy(8481, HOSTS).cookie


def test_a_token_is_made_once_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "base" / "web-token"
    token, is_new = token_from(file)
    assert (is_new, stat.S_IMODE(file.stat().st_mode)) == (True, 0o600)
    assert len(token) >= 43  # 256 bits
    assert token_from(file) == (token, False)
    file.chmod(0o644)
    with pytest.raises(StartError, match=r"other users may use .*644.*chmod 600"):
        token_from(file)
    file.chmod(0o600)
    for text in ("", "short", "with spaces in the middle of it", "n" * 20 + "\x00", "\N{SNOWMAN}" * 20):
        file.write_text(text)
        with pytest.raises(StartError, match="holds no token"):
            token_from(file)


def test_loopback_needs_none_unless_a_file_is_given(tmp_path: Path) -> None:
    environ = {"RMPA_STATE_DIR": str(tmp_path)}
    assert access_of(WebSettings(), "base", environ).token == ""
    given = access_of(WebSettings(token_file=str(tmp_path / "mine")), "base", environ)
    assert given.token == (tmp_path / "mine").read_text().strip()


def test_beyond_loopback_the_token_is_made_and_its_url_told_once(tmp_path: Path) -> None:
    environ, web = {"RMPA_STATE_DIR": str(tmp_path)}, WebSettings(listen="192.168.1.7")
    first = access_of(web, "base", environ)
    assert first.file == tmp_path / "base" / "web-token"
    assert url_of(web, first, 8480) == f"http://192.168.1.7:8480/?token={first.token}"
    again = access_of(web, "base", environ)
    assert again.token == first.token
    assert first.token not in url_of(web, again, 8480)


def test_without_a_place_for_the_token_the_remedy_is_told() -> None:
    with pytest.raises(StartError, match="--token-file"):
        access_of(WebSettings(listen="192.168.1.7"), "base", {})


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files to another user")
def test_a_token_that_another_user_has_made_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "token"
    token_from(path)
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    assert token_from(path)[0], "root's"
    os.chown(path, 999, -1)
    with pytest.raises(StartError, match="belongs to user 999, who knows the token"):
        token_from(path)
