"""``python -m rmpa``: the program ``rmpa``, where its script is not on PATH."""

import sys

from rmpa.cli.main import main

sys.exit(main())
