"""The experiments by name. Each is imported when it is asked for."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from lab.experiments.model import Experiment

# By name, in the report's order: the module, whose ``EXPERIMENT`` it is, and what it finds out in a few words.
EXPERIMENTS: Final[Mapping[str, tuple[str, str]]] = {
    "control": ("lab.experiments.control", "rates and control delay at 10 Hz (Figs. 8 and 9, Table 1)"),
    "rates": ("lab.experiments.rates", "latency against rate (Fig. 10)"),
    "payload": ("lab.experiments.payload", "latency against payload (Fig. 11)"),
    "failure": ("lab.experiments.failure", "what is lost when a host or a cable fails"),
    "scaling": ("lab.experiments.scaling", "what 2 to 32 modules cost"),
    "images": ("lab.experiments.images", "commands beside images on one cable"),
}


def find_experiment(name: str) -> Experiment:
    """Import one experiment.

    Raises:
        ConfigError: There is none of this name.
    """
    if name not in EXPERIMENTS:
        near = did_you_mean(name, EXPERIMENTS)
        hint = f"did you mean {near}?" if near else f"there are {', '.join(EXPERIMENTS)}"
        raise ConfigError(name, "no such experiment", hint)
    found: Experiment = importlib.import_module(EXPERIMENTS[name][0]).EXPERIMENT
    return found
