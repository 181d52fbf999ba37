"""``python -m rtgs`` is the same as ``rtgs``."""

import sys

from rtgs.cli import main

sys.exit(main())
