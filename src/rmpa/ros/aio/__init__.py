"""The former place of ``rmpa.ros.Node``."""
