"""The agent, seen from outside: snapshots and the control socket."""
