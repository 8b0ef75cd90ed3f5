from __future__ import annotations

import pytest

from lab import words
from lab.findings import Claim


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (0.0, "0"),
        (1.2345, "1.23"),
        (0.000512, "0.000512"),
        (99.96, "100"),
        (103.8, "104"),
        (12345.6, "12,346"),
        (-250.0, "-250"),
        (2.5e-6, "2.50e-06"),
        (3.2e12, "3.20e+12"),
    ],
)
def test_numbers_for_people(value: float | None, text: str) -> None:
    assert words.number(value) == text


def test_a_value_that_misses_its_limit_by_little_does_not_look_like_it() -> None:
    assert words.measured(Claim("", 1.1004, 1.1)) == "1.1004"
    assert words.measured(Claim("", 1.1, 1.1)) == "1.1"
    assert words.measured(Claim("", 0.5, 1.1, unit="ms")) == "0.5 ms"
    assert words.measured(Claim("", None, 1.1, unit="ms")) == "-"


@pytest.mark.parametrize(
    ("value", "at_least", "verdict"),
    [(1.0, False, "✓ reached"), (1.0, True, "✗ **not reached**"), (None, True, "? too few samples to say")],
)
def test_verdicts(value: float | None, at_least: bool, verdict: str) -> None:
    claim = Claim("", value, 2.0, at_least)
    assert words.verdict(claim) == verdict
    assert words.wanted(claim) == ("≥ 2" if at_least else "≤ 2")


def test_a_table_puts_figures_to_the_right_and_keeps_bars_in_their_cell() -> None:
    made = words.table(["a|b", "n", "word"], [["x | y", "1.5", "so"], [r"z \| w", "", "2"]])
    assert made.splitlines() == [
        r"| a\|b | n | word |",
        "|---|---:|---|",
        r"| x \| y | 1.5 | so |",
        r"| z \| w |  | 2 |",
    ]


def test_text_from_elsewhere_means_nothing_in_markdown() -> None:
    assert words.plain("a*b\n<c> `d` [e](f) | g") == r"a\*b \<c\> \`d\` \[e\](f) \| g"


def test_anchors_are_those_of_code_hosts() -> None:
    assert words.slug("1. Rates and control delay (Figs. 8 and 9)") == "1-rates-and-control-delay-figs-8-and-9"


def test_values_of_a_manifest() -> None:
    assert words.value([1.23456, True, None, "x", {"a": [1]}]) == "1.235, yes, none, x, a 1"
    assert (words.count(1, "cell"), words.count(1200, "cell")) == ("1 cell", "1,200 cells")


@pytest.mark.parametrize(
    ("carries", "text"), [("100mbit", "100 Mbit/s"), ("9kbit", "9 kbit/s"), ("1gbit", "1 Gbit/s"), ("", "not shaped")]
)
def test_what_a_cable_carries(carries: str, text: str) -> None:
    assert words.link(carries) == text
