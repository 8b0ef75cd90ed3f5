"""Judges whether agents may end the TCP connections that a vanished host leaves behind."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.observe.check import OK, SKIPPED, WARN, Check

if TYPE_CHECKING:
    from collections.abc import Mapping

_NAME = "stale connections"
_EFFECT = (
    "when the host of a direct subscriber vanishes, a rospy publisher without queue_size may hang for minutes in "
    "publish()"
)


def judge_stale_connections(agents: Mapping[str, str | None], here: str, *, direct: bool) -> list[Check]:
    """Whether each agent may end them, or one that is started here.

    Args:
        agents: By the name of each running agent ``AgentInfo.end_connections``: empty, or why it may not, with the
            remedy after the first ``"; "``; ``None`` from an agent that does not report it.
        here: The same of this process, which counts where no agent runs.
        direct: Whether the settings allow direct transport; without it nothing is stale that an agent would end.
    """
    if not agents:
        return [_judge("an agent started by this user", "", here, direct=direct)]
    found = []
    for name, problem in agents.items():
        if problem is None:
            text = "the agent does not report whether it may end them: it is of an older version"
            found.append(Check(_NAME, SKIPPED, text, where=name))
        else:
            found.append(_judge("the agent", name, problem, direct=direct))
    return found


def _judge(subject: str, where: str, problem: str, *, direct: bool) -> Check:
    if not problem:
        return Check(_NAME, OK, f"{subject} may end those that a vanished host leaves behind", where=where)
    reason, _, remedy = problem.partition("; ")
    text = f"{subject} may not end those that a vanished host leaves behind ({reason})"
    if not direct:
        return Check(_NAME, OK, f"{text}; nothing goes direct here, so it need not", where=where)
    return Check(_NAME, WARN, f"{text}: {_EFFECT}", f"{remedy} (docs/systemd.md)", where)
