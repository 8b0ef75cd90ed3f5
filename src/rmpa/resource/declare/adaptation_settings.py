"""How quickly a resource adapts: the parameters of its control loop."""

from __future__ import annotations

from dataclasses import dataclass

from rmpa.core.errors import ConfigError
from rmpa.resource.declare.units import quantity


@dataclass(frozen=True, slots=True)
class AdaptationSettings:
    """Parameters of a resource's control loop (``rmpa.resource.decide.adaptation``).

    Args:
        violations: ``k``: the number of violated windows among the last ``windows`` that is a disturbance.
        windows: ``n``: the number of last windows that are considered.
        improvement: ``h``: hysteresis; a change without a disturbance must reduce the distance by more than this.
        dwell: Least number of seconds that a profile runs before a change without a disturbance.
        settle: Settling time: windows that begin within so many seconds of a change are not judged, because messages
            that were queued under the previous profile still arrive.
        cool_down: Seconds for which a profile is excluded after it failed or was violated.
        cool_down_max: The longest cool-down; it doubles with each further failure.
        apply_timeout: Seconds after which a profile that is being applied counts as hung.
    """

    violations: int = 2
    windows: int = 3
    improvement: float = 0.05
    dwell: float = 2.0
    settle: float = 1.0
    cool_down: float = 10.0
    cool_down_max: float = 160.0
    apply_timeout: float = 5.0


_LEAST = {"window": 0.05, "dwell": 0.0, "settle": 0.0, "cool_down": 0.0, "apply_timeout": 0.01}
_DAY = 86400


def read_adaptation(
    where: str, violations: int, windows: int, improvement: float, times: dict[str, float | str]
) -> tuple[float, AdaptationSettings]:
    """Check the arguments of ``Resource.adaptation``.

    Args:
        where: Description of the settings, for errors.
        violations: As in ``AdaptationSettings``.
        windows: As in ``AdaptationSettings``.
        improvement: As in ``AdaptationSettings``.
        times: The other settings and ``window``, by name: seconds, or texts with a unit.

    Returns:
        The length of a quality window in seconds, and the settings.

    Raises:
        ConfigError: A time out of range, or more violations than windows.
    """
    if not 1 <= violations <= windows <= 100:
        raise ConfigError(where, f"{violations} of {windows} windows", "1 <= violations <= windows <= 100")
    seconds = {name: quantity(value, "s", f"{where}, {name}") for name, value in times.items()}
    for name, least in _LEAST.items():
        if not least <= seconds[name] <= _DAY:
            raise ConfigError(where, f"{name} is {seconds[name]:g} s", f"at least {least:g} s, at most a day")
    window = seconds.pop("window")
    seconds["cool_down_max"] = max(seconds["cool_down_max"], seconds["cool_down"])
    return window, AdaptationSettings(violations=violations, windows=windows, improvement=improvement, **seconds)
