"""The agent seen from outside: snapshot, health, ``rmpa why``, ``rmpa doctor`` and the control socket."""
