"""``python -m rtgs`` is the same as ``rtgs``."""

import sys

from pipelines.cli import main

sys.exit(main())
