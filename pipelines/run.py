"""``python -m pipelines.run`` is the same as ``rtgs run``."""

import sys

from pipelines.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["run", *sys.argv[1:]]))
