"""Every error says what happened, where, and what to do."""

from __future__ import annotations

import inspect
import sys
from email.message import Message
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rmpa.core import errors

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (errors.ConfigError("--port", "too high"), "--port: too high"),
        (errors.ConfigError("core.port", "x", "y", Path("a.toml"), 3), "a.toml:3: core.port: x; y"),
        (errors.ConfigError("the file", "x", path=Path("a.toml")), "a.toml: the file: x"),
        (errors.StartError("port 1", "is taken", "use another"), "port 1: is taken; use another"),
        (errors.StartError("port 1", "is taken"), "port 1: is taken"),
        (errors.LimitExceeded("a frame", 5, 4), "a frame of 5 bytes exceeds the limit of 4"),
        (errors.PeerRefused("base", "no", "do"), "base refused: no; do"),
        (errors.PeerRefused("base", "no"), "base refused: no"),
        (errors.UnreachableError("agent", "/x", "start it"), "no agent answers at /x; start it"),
        (errors.UnreachableError("agent", "/x"), "no agent answers at /x"),
    ],
)
def test_texts(error: errors.RmpaError, text: str) -> None:
    assert str(error) == text


def test_one_tree() -> None:
    for _, kind in inspect.getmembers(errors, inspect.isclass):
        if issubclass(kind, Exception):
            assert issubclass(kind, errors.RmpaError)
            assert kind.__name__ in (errors.__doc__ or "")


def test_our_fault_and_the_peers_fault_are_apart() -> None:
    assert not issubclass(errors.LocalProtocolError, errors.RemoteProtocolError)
    assert issubclass(errors.LimitExceeded, errors.RemoteProtocolError)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A prefix that holds rmpa without a clone around it, and without the Debian package's pages."""
    is_dir = Path.is_dir
    monkeypatch.setattr(Path, "is_dir", lambda path: path.is_relative_to(tmp_path) and is_dir(path))
    monkeypatch.setattr(errors, "__file__", str(tmp_path / "lib/site-packages/rmpa/core/errors.py"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    errors._place_of_docs.cache_clear()
    yield tmp_path
    errors._place_of_docs.cache_clear()


@pytest.mark.parametrize(
    ("url", "folder", "said"),
    [
        ("https://rmpa.invalid", "", "docs/guides/trust.md#keys of RMPA's repository"),
        ("https://example.org/rmpa", "", "https://example.org/rmpa/blob/HEAD/docs/guides/trust.md#keys"),
        ("https://example.org/rmpa", "share/doc/rmpa/docs", "PREFIX/share/doc/rmpa/docs/guides/trust.md#keys"),
    ],
)
def test_a_text_that_names_a_page_says_where_it_is(
    installed: Path, monkeypatch: pytest.MonkeyPatch, url: str, folder: str, said: str
) -> None:
    about = Message()
    about["Project-URL"] = f"Source, {url}"
    about["Project-URL"] = f"Documentation, {url}/blob/HEAD/docs/start/install.md"
    monkeypatch.setattr(metadata, "metadata", lambda _: about)
    if folder:
        (installed / folder).mkdir(parents=True)
    text = errors.with_places("do it (docs/guides/trust.md#keys); see https://a/docs/b.md, docs/")
    assert text == f"do it ({said.replace('PREFIX', str(installed))}); see https://a/docs/b.md, docs/"


def test_in_a_clone_a_page_stays_as_it_is() -> None:
    assert errors.with_places("see docs/guides/trust.md") == "see docs/guides/trust.md"
