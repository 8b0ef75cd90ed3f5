"""The settings: one declaration each, read from file, environment and options."""
