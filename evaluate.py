"""Evaluate descriptors and trained embedders on pairs of maps whose truth is known.

    python evaluate.py data=heldout_small merge=false
    python evaluate.py data=heldout run=runs/x
    python evaluate.py data=real run=runs/x write=docs/results/real-pairs.md section=matching-real

Predictions go to disk first (`runs/eval/<name>/predictions`), then they are scored: a run that was killed goes on where it was.
Keys: configs/evaluate.yaml and configs/data/*.yaml.
"""

from __future__ import annotations

import sys

from topomerge.config import compose
from topomerge.errors import InputError
from topomerge.evaluation.evaluate import evaluate
from topomerge.evaluation.settings import Evaluation


def main(words: list[str]) -> int:
    """Read the settings with Hydra, evaluate, and print the short tables."""
    if {"-h", "--help"} & set(words):
        print(__doc__)
        return 0
    words = [f"run=[{w[4:]}]" if w.startswith("run=") and not w.startswith("run=[") else w for w in words]
    try:
        settings = compose("evaluate", Evaluation, words)
        found = evaluate(settings, lambda text: print(text, file=sys.stderr, flush=True), f"python evaluate.py {' '.join(words)}")
    except InputError as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("evaluate: interrupted; start it again to go on", file=sys.stderr)
        return 130
    print(f"{found.summary}\n\nAll tables and figures: {found.folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
