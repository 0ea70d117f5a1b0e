"""``python -m gsfluent``: the same command line as ``gsfluent``."""

import sys

from gsfluent.cli import main

sys.exit(main())
