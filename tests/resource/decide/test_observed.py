from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.decide.quality import MissingInputs, ObservedQualities
from rmpa.resource.declare.requirements import Requirement, at_least
from rmpa.resource.declare.resource import Resource

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Value


def camera() -> Resource:
    one = Resource("camera", role="sensing")
    one.output("frames", "std_msgs/String")
    one.attribute("light", better="exact", scale="nominal", words=("day", "night"))
    return one


@pytest.fixture
def observed() -> ObservedQualities:
    return ObservedQualities(camera().attributes, "camera", 3.0)


def asks(client: str) -> dict[str, Requirement]:
    return {client: Requirement(client, {"rate": at_least("10 Hz").bound(camera().attributes["rate"])})}


def judged(
    observed: ObservedQualities, measured: dict[str, Value], client: str, now: float = 0.0
) -> dict[str, Value]:
    return observed.worst(measured, asks(client), now)


def test_worse_of_measured_and_observed_counts(observed: ObservedQualities) -> None:
    observed.report("/viewer", [("rate", "4 Hz"), ("latency", "300 ms"), ("light", "night")], 0.0)
    sent: dict[str, Value] = {"rate": 20.0, "latency": 0.001, "loss": 0.0}
    assert judged(observed, dict(sent), "/viewer") == {"rate": 4.0, "latency": 0.3, "loss": 0.0, "light": "night"}
    assert judged(observed, {"rate": 3.0}, "/viewer")["rate"] == 3.0
    assert observed.observed("/viewer", "rate") == 4.0
    assert observed.observed("/viewer", "loss") is observed.observed("/other", "rate") is None


def test_reports_count_for_clients_and_expire(observed: ObservedQualities) -> None:
    observed.report("/viewer", [("rate", "4 Hz")], 0.0)
    assert judged(observed, {"rate": 20.0}, "/driver") == {"rate": 20.0}
    assert judged(observed, {"rate": 20.0}, "/viewer", 3.0) == {"rate": 4.0}
    assert judged(observed, {"rate": 20.0}, "/viewer", 3.1) == {"rate": 20.0}
    observed.report("/viewer", [("rate", "4 Hz")], 5.0)
    observed.clear()
    assert judged(observed, {"rate": 20.0}, "/viewer", 5.0) == {"rate": 20.0}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([("rat", "4 Hz")], "did you mean rate"),
        ([("rate", "4 m")], "unit of length"),
        ([("rate", "nan")], "rate"),
        ([("light", "dusk")], "day, night"),
        ([("rate", "4 Hz")] * 300, "more than 256"),
    ],
)
def test_invalid_report_keeps_the_previous_one(
    observed: ObservedQualities, values: list[tuple[str, str]], said: str
) -> None:
    observed.report("/viewer", [("rate", "4 Hz")], 0.0)
    with pytest.raises(ConfigError, match=said):
        observed.report("/viewer", values, 1.0)
    assert observed.observed("/viewer", "rate") == 4.0


def test_missing_input_is_reported_once() -> None:
    missing = MissingInputs()
    news = [missing.update(texts) for texts in (["a"], [], ["a"], ["a", "b"], ["a", "b"], ["b"], [])]
    assert news == [[], [], [], [("a", True)], [("b", True)], [("a", False)], [("b", False)]]
