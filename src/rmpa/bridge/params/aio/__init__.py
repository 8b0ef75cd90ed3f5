"""Questions answered, owners followed, the local core read and written."""
