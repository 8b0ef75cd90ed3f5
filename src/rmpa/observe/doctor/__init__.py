"""What ``rmpa doctor`` reads of a machine, and what that means."""
