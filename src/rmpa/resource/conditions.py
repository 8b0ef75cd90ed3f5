"""What bars profiles and raises alarms: preconditions, which are functions, and rules, which are expressions."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.resource import limits
from rmpa.runtime.accept import in_thread
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare import AlarmRule, Profile
    from rmpa.resource.resource import Resource
    from rmpa.resource.values import ExpressionValues


class Preconditions:
    """The preconditions of one resource's profiles (``needs=``), each in a thread of its own: they may block.

    Args:
        profiles: The declared profiles, by name.
    """

    def __init__(self, profiles: Mapping[str, Profile]) -> None:
        self._needs = {name: one.needs for name, one in profiles.items() if one.needs is not None}
        # The call under way, by profile.
        self._calls: dict[str, asyncio.Task[str | bool | None]] = {}

    async def check(self) -> dict[str, str]:
        """Call all preconditions, except those whose last call has not returned; at most one check at a time.

        Returns:
            The profiles that must not run, with the reason, after ``limits.PRECONDITION_TIMEOUT`` seconds at most.
        """
        for name, needs in self._needs.items():
            if name not in self._calls:
                what = f"needs of {name}"
                self._calls[name] = start_task(in_thread(needs, what), what, raises=(Exception,))
        if not self._calls:
            return {}
        done, _ = await asyncio.wait(self._calls.values(), timeout=limits.PRECONDITION_TIMEOUT)
        found = {}
        for name, call in list(self._calls.items()):
            why: str | bool | None = f"its precondition has not answered for {limits.PRECONDITION_TIMEOUT:g} s"
            if call in done:
                del self._calls[name]
                error = call.exception()
                why = f"its precondition failed: {type(error).__name__}: {error}" if error else call.result()
            if why is False:
                why = "its precondition does not hold"
            if why and isinstance(why, str):
                found[name] = why
        return found

    async def close(self) -> None:
        """Stop waiting for calls; threads that hang are left behind."""
        await end_tasks(*self._calls.values())


class Rules:
    """The rules of one resource's alarms and profiles, judged once in each window.

    Args:
        resource: The resource, completely declared.
        values: What the rules refer to.
    """

    def __init__(self, resource: Resource, values: ExpressionValues) -> None:
        self._values = values
        self._alarms = [(one, resource.expression(one.when, f"alarm {one.name}")) for one in resource.alarms.values()]
        self._profiles = {
            one.name: (one.rule, resource.expression(one.rule, f"profile {one.name}"))
            for one in resource.profiles.values()
            if one.rule
        }
        # The alarms that stand.
        self.standing: dict[str, AlarmRule] = {}

    def judge(self) -> list[tuple[AlarmRule, bool]]:
        """The alarms that are raised (true) or over now; one whose rule is unknown stays as it is."""
        values, changes = self._values.now() if self._alarms else {}, []
        for alarm, rule in self._alarms:
            holds, stands = rule.holds(values), alarm.name in self.standing
            if holds is None or holds == stands:
                continue
            if holds:
                self.standing[alarm.name] = alarm
            else:
                del self.standing[alarm.name]
            changes.append((alarm, holds))
        return changes

    def blocked(self) -> dict[str, str]:
        """The profiles whose rule is false, with the reason; an unknown rule blocks none."""
        values = self._values.now() if self._profiles else {}
        return {
            name: f"its rule does not hold: {text}"
            for name, (text, rule) in self._profiles.items()
            if rule.holds(values) is False
        }
