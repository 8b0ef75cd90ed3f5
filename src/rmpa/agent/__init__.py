"""The agent: builds the rooms and wires them (design: every module runs one)."""

from __future__ import annotations

from rmpa.agent.agent import Agent, run

__all__ = ["Agent", "run"]
