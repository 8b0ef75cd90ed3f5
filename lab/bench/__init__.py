"""The measurements: ``python -m lab bench``; see ``README.md``."""
