"""`python -m topomerge` is `topomerge`."""

import sys

from topomerge.cli import main

if __name__ == "__main__":
    sys.exit(main())
