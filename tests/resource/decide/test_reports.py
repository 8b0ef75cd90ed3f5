from __future__ import annotations

from rmpa.resource.decide.adaptation import Adaptation
from rmpa.resource.decide.decision import Alarm, AlarmKind, Decider, Shortfall
from rmpa.resource.decide.reports import alarm_values, answer_to, decision_report, describe_alarm, health
from rmpa.resource.declare.attributes import LATENCY, RATE
from rmpa.resource.declare.parameters import Profile
from rmpa.resource.declare.requirements import Bound, Requirement, bound
from rmpa.ros.types.definitions import DiagnosticLevel

ATTRIBUTES = {"rate": RATE, "latency": LATENCY}
FAST = Profile("fast", {"rate": 40.0})
WANTED = bound(RATE, at_least=20, hard=True)


def loop(*, runs: bool = True, rate: float = 20.0) -> Adaptation:
    one = Adaptation(ATTRIBUTES, Decider("camera", ATTRIBUTES, [FAST]))
    if runs:
        one.start(0.0)
        one.applied("fast", 0.0)
        one.require(asked(rate), 0.0)
    return one


def asked(rate: float = 20.0, client: str = "/a", priority: int = 0) -> Requirement:
    bounds = {"rate": bound(RATE, at_least=rate, hard=True), "latency": bound(LATENCY, at_most=0.1)}
    return Requirement(client, bounds, priority=priority)


def test_alarm_text_and_values() -> None:
    alarm = Alarm(AlarmKind.ADAPTATION, (Shortfall("rate", WANTED, 3.5),), "fast", "slow", 0.0)
    assert describe_alarm(alarm) == "adaptation: rate fell short under fast; slow takes over"
    assert alarm_values(alarm, ATTRIBUTES, cleared=False, reaction=2.0) == {
        "before": "fast", "after": "slow", "cleared": "false", "rate": "wanted at least 20 Hz, given 3.5 Hz",
    }  # fmt: skip
    assert alarm_values(alarm, ATTRIBUTES, cleared=True, reaction=2.0)["reaction"] == "2 s"
    none = Alarm(AlarmKind.NON_ADAPTABLE, (Shortfall("rate", WANTED, None),), "", "limp", 0.0)
    assert describe_alarm(none) == "non-adaptable: no profile gives rate as asked; limp is the best there is"
    assert alarm_values(none, ATTRIBUTES, cleared=False, reaction=None)["rate"].endswith("given nothing")


def test_health_reports_the_worst() -> None:
    assert health(loop(), [], []) == (DiagnosticLevel.OK, "profile fast")
    assert health(loop(), [], ["task a stuck"]) == (DiagnosticLevel.WARN, "task a stuck")
    assert health(loop(), ["no node publishes /b"], ["c"]) == (DiagnosticLevel.STALE, "no node publishes /b; c")
    assert health(loop(runs=False), [], ["c"]) == (DiagnosticLevel.ERROR, "no profile runs; c")
    level, text = health(loop(rate=90.0), ["no node publishes /b"], [])
    assert (level, text) == (
        DiagnosticLevel.ERROR, "non-adaptable: no profile gives rate as asked; fast is the best there is",
    )  # fmt: skip


def test_answer_to_a_client() -> None:
    level, message, values = answer_to(asked(), loop(), ATTRIBUTES, {"rate": 30.0})
    assert (level, message) == (DiagnosticLevel.OK, "profile fast")
    assert values == {
        "rate": "wanted at least 20 Hz, given 30 Hz",
        "latency": "wanted at most 0.1 s, given not measured yet",
    }
    assert answer_to(asked(), loop(), ATTRIBUTES, {"rate": 9.0})[:2] == (DiagnosticLevel.WARN, "rate falls short")
    both = answer_to(asked(), loop(), ATTRIBUTES, {"rate": 9.0, "latency": 2.0})
    assert both[:2] == (DiagnosticLevel.WARN, "rate, latency fall short")
    assert answer_to(asked(), loop(runs=False), ATTRIBUTES, {})[:2] == (DiagnosticLevel.WARN, "no profile runs yet")
    assert answer_to(asked(90.0), loop(rate=90.0), ATTRIBUTES, {})[0] is DiagnosticLevel.ERROR
    contradicted = loop()
    contradicted.require(Requirement("/b", {"rate": Bound(high=RATE.position(5.0), hard=True)}, priority=1), 0.0)
    level, message, _ = answer_to(asked(), contradicted, ATTRIBUTES, {"rate": 30.0})
    assert level is not DiagnosticLevel.OK
    assert "/b" in message


def test_decision_report_has_each_term() -> None:
    one = loop()
    found = decision_report(one, one.explain(0.0), 0.25)
    assert (found["profile"], found["applying"], found["reaction"], found["clients"]) == ("fast", "", 0.25, ["/a"])
    (score,) = found["scores"]
    assert {term["attribute"] for term in score["terms"]} == {"rate", "latency"}
