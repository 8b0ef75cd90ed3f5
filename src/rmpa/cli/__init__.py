"""The program `rmpa`: one file a command."""

from rmpa.runtime.interpreter import search_python_path_last

search_python_path_last()  # before the first library is imported
