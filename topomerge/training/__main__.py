"""``python -m topomerge.training run.json [key=value ...]``: train without Hydra, from the config of a run."""

from __future__ import annotations

import json
import sys

from topomerge.datasets.core.script import exit_status


def main(words: list[str]) -> int:
    """Train; keys of the top level can be set as JSON after the file."""
    if not words or {"-h", "--help"} & set(words):
        print(__doc__)
        return 0 if words else 1
    from topomerge.training.embedding import fit
    from topomerge.training.settings import from_dict, from_file, to_dict

    def work() -> None:
        values = to_dict(from_file(words[0]))
        for word in words[1:]:
            key, _, value = word.partition("=")
            values[key.lstrip("-")] = _value(value) if "=" in word else True
        fit(from_dict(values))

    return exit_status("train", work, "go on with resume=true")


def _value(text: str) -> object:
    try:
        return json.loads(text)
    except ValueError:
        return text


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
