"""Every error says what happened, where, and what to do."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from rmpa.core import errors


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
