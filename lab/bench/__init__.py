"""The measurements: ``python -m bench``; see ``README.md``."""
