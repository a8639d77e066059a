"""``python -m topomerge.training run.json [key=value ...]``: train without Hydra, from the config of a run."""

from __future__ import annotations

import json
import sys

from topomerge.datasets.core.builder import run_script


def main(arguments: list[str]) -> int:
    """Train; keys of the top level can be set as JSON after the file."""
    if not arguments or {"-h", "--help"} & set(arguments):
        print(__doc__)
        return 0 if arguments else 1
    from topomerge.training.embedding import fit
    from topomerge.training.settings import convert_to_dict, load_settings, parse_settings

    def work() -> None:
        values = convert_to_dict(load_settings(arguments[0]))
        for word in arguments[1:]:
            key, _, value = word.partition("=")
            values[key.lstrip("-")] = _parse_value(value) if "=" in word else True
        fit(parse_settings(values))

    return run_script("train", work, "go on with resume=true")


def _parse_value(text: str) -> object:
    try:
        return json.loads(text)
    except ValueError:
        return text


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
