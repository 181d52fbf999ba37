"""``python -m rtgs`` is the same as ``rtgs``."""

import sys

from pipelines.cli.main import main

sys.exit(main())
