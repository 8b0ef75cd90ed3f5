"""What is wrong with this machine: facts are looked up in ``aio``, and judged here."""
