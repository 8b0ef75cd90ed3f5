"""Whether a module may start without trust: not beside keys of this user's other modules, unless that is said.

A name or a state directory that was forgotten must not start a module of a secured mesh as an open one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.config.module_name import GATEWAY_SUFFIX, other_state_dirs
from rmpa.core.errors import StartError
from rmpa.trust.io.store import TrustStore, modules_with_keys

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from rmpa.config.settings import TrustSettings

_SHOWN = 5


def check_open(
    trust: TrustSettings, state: Path | None, module: str, environ: Mapping[str, str], option: str = "--name"
) -> None:
    """Check that a module without files of trust may start by its settings.

    Args:
        trust: The settings: ``require`` forbids it, ``insecure`` permits it also beside other modules' keys.
        state: As for ``check_open_start``, like those that follow.
        module: Likewise.
        environ: Likewise.
        option: Likewise.

    Raises:
        StartError: It may not.
    """
    if trust.require:
        problem = f"the module {module} has joined no secured mesh"
        remedy = "join one: rmpa trust join TOKEN, with a token of rmpa trust invite at the authority"
        raise StartError("trust.require", problem, remedy)
    if not trust.insecure:
        check_open_start(state, module, environ, option)


def check_open_start(state: Path | None, module: str, environ: Mapping[str, str], option: str = "--name") -> None:
    """Check that an open module is what the user wants.

    Args:
        state: The state directory in use; ``None``: there is none.
        module: The module, which has no files of trust there.
        environ: Says where other state directories are.
        option: The command's option for a name, for errors.

    Raises:
        StartError: Another module, or another state directory, has keys of a secured mesh; or it cannot be known.
    """
    here = modules_with_keys(state) if state is not None else []
    if here:
        start = [f"start as {name}: {option} {name}" for name in _startable(here, module)]
        raise _refused(module, f"{_listed(here)} here in {state}", start)
    others = [(place, there) for place in other_state_dirs(environ, state) if (there := _keys_in(place))]
    for place, there in sorted(others, key=lambda each: module not in each[1]):  # first where its own keys are
        names = [module] if module in there else _startable(there, module)
        start = [f"start with RMPA_STATE_DIR={place} {option} {name}" for name in names]
        raise _refused(module, f"{_listed(there)} in {place}", start)


def _startable(names: list[str], module: str) -> list[str]:
    """As which module to start instead: a gateway is none, and has a name of its own."""
    modules = [name for name in names if not name.endswith(GATEWAY_SUFFIX)]
    return modules[:1] if len(modules) == 1 and not module.endswith(GATEWAY_SUFFIX) else []


def _refused(module: str, others: str, start: list[str]) -> StartError:
    problem = f"has no keys, and would start without trust, beside keys of {others}"
    join = f"let {module} join: rmpa trust join TOKEN --name {module}"
    open_word = "start it open: --insecure (insecure = true in [trust])"
    return StartError(f"the module {module}", problem, "; or ".join((*start, join, open_word)))


def _keys_in(place: Path) -> list[str]:
    """The modules with keys in a state directory that is not in use; none if it is another user's."""
    try:
        return modules_with_keys(place)
    except StartError:
        # A folder of ours that is broken there says that there may be keys; one that we may not even see, that it is
        # another user's.
        try:
            return [entry.name for entry in place.iterdir() if _may_have_keys(place, entry.name)]
        except OSError:
            return []


def _may_have_keys(place: Path, name: str) -> bool:
    try:
        return TrustStore(place, name).exists
    except StartError:
        return True


def _listed(names: list[str]) -> str:
    shown = ", ".join(names[:_SHOWN])
    return f"{shown} and {len(names) - _SHOWN} more" if len(names) > _SHOWN else shown
