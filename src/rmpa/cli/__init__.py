"""The program `rmpa`: one file a command."""
