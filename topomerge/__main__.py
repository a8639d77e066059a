"""`python -m topomerge` is `topomerge`."""

import sys

from topomerge.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
