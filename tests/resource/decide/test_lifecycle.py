from __future__ import annotations

import pytest

from rmpa.core.errors import LocalProtocolError
from rmpa.resource.decide.reports import TRANSITIONS, LifeCycle, LifecycleState, Transition


def at(state: LifecycleState) -> LifeCycle:
    one = LifeCycle()
    for transition in {
        LifecycleState.UNCONFIGURED: (),
        LifecycleState.INACTIVE: (Transition.CONFIGURE,),
        LifecycleState.ACTIVE: (Transition.CONFIGURE, Transition.ACTIVATE),
        LifecycleState.FINALIZED: (Transition.FINALIZE,),
    }[state]:
        one.begin(transition)
        one.succeeded()
    return one


@pytest.mark.parametrize("state", LifecycleState)
@pytest.mark.parametrize("transition", Transition)
def test_transitions_follow_the_table(state: LifecycleState, transition: Transition) -> None:
    one = at(state)
    assert one.state is state
    if (state, transition) in TRANSITIONS:
        one.begin(transition)
        assert (one.state, one.under_way) == (state, transition)
        assert one.succeeded() is one.state is TRANSITIONS[state, transition]
    else:
        with pytest.raises(LocalProtocolError, match=f"{state} does not lead anywhere by {transition}"):
            one.begin(transition)


def test_one_transition_at_a_time() -> None:
    one = at(LifecycleState.INACTIVE)
    one.begin(Transition.ACTIVATE)
    with pytest.raises(LocalProtocolError, match="finalize while activate is under way"):
        one.begin(Transition.FINALIZE)


def test_failing_hook_leaves_the_state() -> None:
    one = at(LifecycleState.INACTIVE)
    one.begin(Transition.ACTIVATE)
    assert one.failed() is LifecycleState.INACTIVE
    one.begin(Transition.ACTIVATE)
    assert one.succeeded() is LifecycleState.ACTIVE


@pytest.mark.parametrize("transition", [Transition.FINALIZE, Transition.DEACTIVATE])
def test_what_ends_ends_even_if_its_hook_raises(transition: Transition) -> None:
    one = at(LifecycleState.ACTIVE)
    one.begin(transition)
    assert one.failed() is not LifecycleState.ACTIVE
