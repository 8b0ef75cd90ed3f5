"""The agent that every module runs: builds the rooms and wires them."""

from __future__ import annotations

from rmpa.agent.agent import Agent, run

__all__ = ["Agent", "run"]
