"""Brings resources to life: nodes, tasks, topics."""
