"""Runs resources: nodes, tasks, control loop, life cycle, store."""
