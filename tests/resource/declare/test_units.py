from __future__ import annotations

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.declare.attributes import convert, quantity


@pytest.mark.parametrize(
    ("text", "to", "value"),
    [
        ("20 Hz", "Hz", 20.0),
        ("0.02 kHz", "Hz", 20.0),
        ("50ms", "s", 0.05),
        ("  1e3 µs ", "ms", 1.0),
        (".5", "m", 0.5),
        (3, "m", 3.0),
        ("10 Mbit/s", "B/s", 1_250_000.0),
        ("5 %", "", 0.05),
        ("36 km/h", "m/s", 10.0),
        ("7 widgets", "widgets", 7.0),
    ],
)
def test_quantity_is_converted_to_the_unit(text: str | float, to: str, value: float) -> None:
    assert quantity(text, to, "rate") == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "to", "said"),
    [
        ("fast", "Hz", "not a number with a unit; for example 20 Hz"),
        ("20 kHzz", "Hz", "'kHzz' is not a unit known here; did you mean kHz?"),
        ("20 s", "Hz", "'s' is a unit of time; latency is a frequency, in 'Hz'"),
        ("20 s", "widgets", "'s' is a unit of time; latency is of its own, in 'widgets'"),
        (True, "Hz", "True is not a number with a unit"),
        (float("nan"), "Hz", "nan is not a number"),
        (float("inf"), "Hz", "inf is not a number"),
        ("1e999", "Hz", "inf is not a number"),
        ("", "Hz", "'' is not a number"),
    ],
)
def test_invalid_quantity_is_refused(text: str | float, to: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        quantity(text, to, "latency")
    assert said in str(caught.value)


def test_known_units_convert_both_ways() -> None:
    assert convert(convert(33.0, "deg", "rad", "x"), "rad", "deg", "x") == pytest.approx(33.0)
