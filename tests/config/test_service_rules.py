"""``[services]`` and ``[[service]]``: what they may say, and what a user is told who says something else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.config.peer_rules import ServiceRule
from rmpa.config.settings import ServiceSettings
from rmpa.core.contract import Transport

if TYPE_CHECKING:
    from tests.config.conftest import Load, Refuse


def test_defaults_let_all_but_loggers_cross_for_a_minute(load: Load) -> None:
    assert load("").settings.services == ServiceSettings(("/**",), (), False, 60.0, Transport.RELAY, ())


def test_a_file_says_it_all(load: Load) -> None:
    text = """
        [services]
        allow = ["/arm/**"]
        deny = ["/**/restart"]
        loggers = true
        timeout = "500 ms"
        transport = "auto"
        [[service]]
        names = ["/plan/**", "/map"]
        timeout = "5 min"
        [[service]]
        names = ["/ik"]
        transport = "direct"
        [[service]]
        names = ["/**"]
        timeout = 2
        transport = "relay"
    """
    rules = (
        ServiceRule(("/plan/**", "/map"), 300.0),
        ServiceRule(("/ik",), None, Transport.DIRECT),
        ServiceRule(("/**",), 2.0, Transport.RELAY),
    )
    assert load(text).settings.services == ServiceSettings(
        ("/arm/**",), ("/**/restart",), True, 0.5, Transport.AUTO, rules
    )


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("[services]\nallow = ['/a//b']", 2, "services.allow: '/a//b' matches no service"),
        ("[services]\nallow = ['arm']", 2, 'did you mean "/arm"?'),
        ("[services]\ntimeout = 'infinite'", 2, "too long for a call"),
        ("[services]\ntimeout = 4000", 2, "at most 3600 s"),
        ("[services]\ntimeout = '10 Hz'", 2, "is a rate"),
        ("[services]\ntimeouts = 1", 2, "did you mean services.timeout?"),
        ("[services]\nloggers = 1", 2, "is not true or false"),
        ("[[service]]\nnames = ['/a']", 1, "a rule without timeout and transport; one has names"),
        ("[[service]]\ntimeout = 1", 1, "a rule without names"),
        ("[[service]]\ntransport = 'auto'", 1, "a rule without names"),
        ("[[service]]\nnames = ['/a']\ntransport = 'diret'", 3, 'one of relay, direct, auto; did you mean "direct"?'),
        ("[services]\ntransport = 1", 2, "services.transport: 1 is not a text in quotes"),
        ("\n[[service]]\nnames = []\ntimeout = 1", 3, "an empty list fits nothing"),
        ("[[service]]\nnames = ['/a', 'b c']\ntimeout = 1", 2, "'b c' is not a glob over services"),
        ("[[service]]\nnames = ['/a']\ntimeout = 0", 3, "service.timeout: 0 is out of range"),
        ("[service]\nnames = ['/a']", 1, "write [[service]]"),
        ("[[service]]\nname = ['/a']\ntimeout = 1", 2, "did you mean service.names?"),
    ],
)
def test_what_cannot_be_is_named_with_its_line(refuse: Refuse, text: str, line: int, words: str) -> None:
    said = refuse(text)
    assert (said.startswith(f"rmpa.toml:{line}: "), words in said) == (True, True), said
