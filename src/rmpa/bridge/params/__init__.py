"""Parameters across modules: what may be read, set and followed, and how it crosses."""
