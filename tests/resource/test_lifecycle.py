from __future__ import annotations

import pytest

from rmpa.core.errors import LocalProtocolError
from rmpa.resource.lifecycle import TRANSITIONS, LifeCycle, State, Transition


def at(state: State) -> LifeCycle:
    one = LifeCycle()
    for transition in {
        State.UNCONFIGURED: (),
        State.INACTIVE: (Transition.CONFIGURE,),
        State.ACTIVE: (Transition.CONFIGURE, Transition.ACTIVATE),
        State.FINALIZED: (Transition.FINALIZE,),
    }[state]:
        one.begin(transition)
        one.succeeded()
    return one


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("transition", Transition)
def test_every_transition_leads_where_the_table_says_or_nowhere(state: State, transition: Transition) -> None:
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
    one = at(State.INACTIVE)
    one.begin(Transition.ACTIVATE)
    with pytest.raises(LocalProtocolError, match="finalize while activate is under way"):
        one.begin(Transition.FINALIZE)


def test_a_hook_that_raises_leaves_the_state_and_is_said() -> None:
    one = at(State.INACTIVE)
    one.begin(Transition.ACTIVATE)
    assert one.failed("no such device") is State.INACTIVE
    assert one.problem == "activate: no such device"
    one.begin(Transition.ACTIVATE)
    assert one.succeeded() is State.ACTIVE
    assert one.problem == ""


@pytest.mark.parametrize("transition", [Transition.FINALIZE, Transition.DEACTIVATE])
def test_what_ends_ends_even_if_its_hook_raises(transition: Transition) -> None:
    one = at(State.ACTIVE)
    one.begin(transition)
    assert one.failed("it hurts") is not State.ACTIVE
    assert one.problem == f"{transition}: it hurts"
