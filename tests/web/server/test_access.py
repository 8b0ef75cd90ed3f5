"""Which requests are served, as a table of headers, and the file of the token."""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

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


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        (("localhost:8480",), "granted"),
        (("LOCALHOST",), "granted"),
        (("localhost.:8480",), "granted"),
        (("127.0.0.1:8480",), "granted"),
        (("192.168.1.7:8480",), "granted"),  # an address cannot be rebound
        (("[::1]:8480",), "granted"),
        (("base",), "granted"),
        (("base.local:8480",), "granted"),
        (("evil.example:8480",), "host"),
        (("localhost.evil.example",), "host"),
        (("127.0.0.1.evil.example:8480",), "host"),
        (("0x7f.1",), "host"),
        (("localhost:8480@evil.example",), "host"),
        (("localhost, evil.example",), "host"),
        (("",), "host"),
        ((), "host"),
        (("localhost", "evil.example"), "host"),
    ],
)
def test_a_name_that_is_not_ours_is_a_rebound_one(host: tuple[str, ...], expected: str) -> None:
    assert reason(OPEN.judge(RequestFacts(host))) == expected
    # The right token does not help: a rebound page would have the browser send the cookie.
    with_token = reason(CLOSED.judge(RequestFacts(host, authorization=f"Bearer {TOKEN}")))
    assert with_token == expected


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ("http://base.local:8480", "granted"),
        ("https://BASE.local:8480", "granted"),
        ("http://base.local:8481", "origin"),
        ("http://base.local", "origin"),
        ("http://evil.example", "origin"),
        ("http://evil.example/base.local:8480", "origin"),
        ("null", "origin"),
        ("", "origin"),
        ("ftp://base.local:8480", "origin"),
        ("chrome-extension://abc", "origin"),
    ],
)
def test_only_our_own_pages_may_read(origin: str, expected: str) -> None:
    assert reason(OPEN.judge(RequestFacts(HERE, origin=origin))) == expected
    assert reason(CLOSED.judge(RequestFacts(HERE, origin=origin, cookie=TOKEN))) == expected


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ("https://base.local:8480", "granted"),
        ("https://BASE.local:8480", "granted"),
        ("http://base.local:8480", "origin"),  # whoever is on the way can forge that page
        ("HTTP://base.local:8480", "origin"),
        ("null", "origin"),
    ],
)
def test_a_server_of_https_takes_no_page_of_plain_http_for_its_own(origin: str, expected: str) -> None:
    assert reason(OPEN.judge(RequestFacts(HERE, origin=origin, secure=True))) == expected
    assert reason(CLOSED.judge(RequestFacts(HERE, origin=origin, cookie=TOKEN, secure=True))) == expected


@pytest.mark.parametrize(
    ("origin", "is_preflight", "expected"),
    [
        ("https://app.example", True, "preflight"),
        ("https://APP.example", True, "preflight"),
        ("https://app.example", False, "token"),
        ("http://app.example", True, "origin"),  # another scheme is another origin
        ("https://app.example:8443", True, "origin"),
        ("https://app.example.evil.example", True, "origin"),
        ("*", True, "origin"),
        ("null", True, "origin"),
        ("http://base.local:8480", True, "token"),  # our own pages ask nothing before
        (None, True, "token"),
    ],
)
def test_only_listed_sites_are_told_what_their_pages_may_send(
    origin: str | None, is_preflight: bool, expected: str
) -> None:
    policy = AccessPolicy(8480, HOSTS, TOKEN, frozenset({"https://app.example", "*"}))
    assert reason(policy.judge(RequestFacts(HERE, origin=origin, is_preflight=is_preflight))) == expected
    rebound = RequestFacts(("evil.example",), origin=origin, is_preflight=is_preflight)
    assert reason(policy.judge(rebound)) == "host"


@pytest.mark.parametrize(
    ("site", "mode", "is_page", "expected"),
    [
        ("same-origin", "cors", False, "granted"),
        ("none", "navigate", True, "granted"),
        ("cross-site", "navigate", True, "granted"),  # a link in a wiki
        ("cross-site", "navigate", False, "origin"),
        ("cross-site", "no-cors", False, "origin"),  # <script src>, <img src>
        ("cross-site", "websocket", False, "origin"),
        ("same-site", "no-cors", True, "origin"),  # another port of this host
    ],
)
def test_what_other_sites_load_is_refused_without_an_origin_too(
    site: str, mode: str, is_page: bool, expected: str
) -> None:
    facts = RequestFacts(HERE, fetch_site=site, fetch_mode=mode, is_page=is_page)
    assert reason(OPEN.judge(facts)) == expected


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        ({}, "token"),
        ({"authorization": f"Bearer {TOKEN}"}, "granted"),
        ({"authorization": f"bearer  {TOKEN} "}, "granted"),
        ({"authorization": f"Basic {TOKEN}"}, "token"),
        ({"authorization": "Bearer "}, "token"),
        ({"authorization": f"Bearer {TOKEN}x"}, "token"),
        ({"authorization": f"Bearer {TOKEN[:-1]}"}, "token"),
        ({"authorization": "Bearer \udcff\u00e4"}, "token"),
        ({"cookie": TOKEN}, "granted"),
        ({"cookie": "old"}, "token"),
        ({"cookie": ""}, "token"),
        ({"token": TOKEN}, "granted"),
        ({"token": TOKEN, "is_page": True}, "move token"),
        ({"token": TOKEN, "is_page": True, "cookie": "old"}, "move token"),
        ({"token": "wrong", "is_page": True}, "token"),
        ({"token": "wrong", "cookie": TOKEN}, "granted"),
        ({"is_open": True}, "granted"),
    ],
)
def test_the_token_comes_as_bearer_cookie_or_query(facts: dict[str, object], expected: str) -> None:
    assert reason(CLOSED.judge(RequestFacts(HERE, **facts))) == expected  # type: ignore[arg-type]


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
    assert is_new
    assert len(token) >= 43  # 256 bits
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert token_from(file) == (token, False)


def test_a_token_that_others_can_read_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "token"
    token_from(file)
    file.chmod(0o644)
    with pytest.raises(StartError, match=r"other users may use .*644.*chmod 600"):
        token_from(file)


@pytest.mark.parametrize(
    "text", ["", "short", "with spaces in the middle of it", "n" * 20 + "\x00", "\N{SNOWMAN}" * 20]
)
def test_a_file_without_a_token_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "token"
    file.write_text(text)
    file.chmod(0o600)
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
