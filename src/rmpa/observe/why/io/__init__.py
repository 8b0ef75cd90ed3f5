"""Gathers what ``rmpa why`` judges: from this agent's rooms, and from the other agent."""
