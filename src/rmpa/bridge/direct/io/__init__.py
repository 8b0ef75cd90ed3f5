"""What direct transport asks of nodes and of the kernel."""
