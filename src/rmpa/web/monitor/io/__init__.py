"""What the monitor reads and does: snapshots, Smart Resources, the log, and the answers to questions of pages."""
