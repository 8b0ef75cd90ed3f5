"""What ``rmpa doctor`` says of connections that a vanished host leaves behind."""

from __future__ import annotations

import pytest

from rmpa.observe.check import Check, CheckLevel
from rmpa.observe.doctor.stale_connections import judge_stale_connections

WITHOUT = "this process has no CAP_NET_ADMIN; run the agent with it"


@pytest.mark.parametrize(
    ("problem", "direct", "level"),
    [
        ("", True, CheckLevel.OK),
        ("", False, CheckLevel.OK),
        (WITHOUT, True, CheckLevel.WARN),
        (WITHOUT, False, CheckLevel.OK),
        (None, True, CheckLevel.SKIPPED),
    ],
)
def test_the_right_matters_where_topics_may_go_direct(problem: str | None, direct: bool, level: CheckLevel) -> None:
    (found,) = judge_stale_connections({"base": problem}, "", direct=direct)
    assert (found.name, found.where, found.level) == ("stale connections", "base", level)
    if level is CheckLevel.WARN:
        assert "no CAP_NET_ADMIN" in found.text
        assert "a rospy publisher without queue_size may hang for minutes" in found.text
        assert found.remedy.startswith("run the agent with it")
    else:
        assert not found.remedy


def test_running_agents_count_and_not_the_user_who_asks() -> None:
    """The doctor may run as root, and the agent as another user; or the other way round."""

    def levels(found: list[Check]) -> list[tuple[str, CheckLevel]]:
        return [(check.where, check.level) for check in found]

    agents = {"base": WITHOUT, "arm": ""}
    expected = [("base", CheckLevel.WARN), ("arm", CheckLevel.OK)]
    assert levels(judge_stale_connections(agents, "", direct=True)) == expected
    assert levels(judge_stale_connections(agents, WITHOUT, direct=True)) == expected
    (alone,) = judge_stale_connections({}, WITHOUT, direct=True)
    assert alone.level is CheckLevel.WARN
    assert alone.text.startswith("an agent started by this user may not")
