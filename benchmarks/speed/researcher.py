"""A researcher's list, from nothing to a merge with an embedder of one's own: `python -m benchmarks.speed.researcher [PAGE]`.

It types each line in a new folder and prints the seconds of processor and by the clock; with a page, it writes the block
`researcher` there. Sets and trainings are as small as they run: how long a real one takes follows from rooms a second
(`training.py`).
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

from benchmarks.speed.bench import run_timed
from topomerge.evaluation.documents import ROOT, build_stamp, write_blocks, write_table

COMMAND = "python -m benchmarks.speed.researcher"
MODULES = (
    "topomerge.training.tasks",
    "topomerge.training.embedding",
    "topomerge.training.search",
    "topomerge.training.finetuning",
)
OWN_PARTS = '''
"""A node encoder, a loss and a set of pairs of one's own."""
import json
from pathlib import Path

from torch_geometric.nn import TransformerConv

from topomerge.registry import DATASETS, LOSSES, NODES


@NODES.register("transformer")
def build_transformer(settings, channels):
    return TransformerConv(channels, channels // settings.heads, settings.heads, edge_dim=settings.width)


@LOSSES.register("alignment")
def score_alignment(settings, batch):
    alike, same = batch.embedding @ batch.embedding.T, batch.truth.same
    partner = (alike * same).sum(dim=1) / same.sum(dim=1).clamp(min=1)
    return 1 - partner + settings.options["spread"] * alike.mean(dim=1), same.any(dim=1)


@DATASETS.register("twins")
def list_twins(folder: Path) -> dict:
    captures = [{"name": f.stem, "file": f.name, "building": f.stem[:-2]} for f in sorted(Path(folder).glob("*.tmap"))]
    truths = {f.stem: json.loads(f.read_text())["T_ab"] for f in sorted(Path(folder).glob("*.json"))}
    return {"captures": captures, "pairs": [{"a": f"{n}_a", "b": f"{n}_b", "transform": t} for n, t in truths.items()]}
'''
OWN_CONFIGS = {
    "node/transformer.yaml": "# @package network.node\nkind: transformer\nlayers: 1\nedges: true\n",
    "loss/alignment.yaml": "kind: alignment\noptions: {spread: 0.5}\n",
    "data/twins.yaml": "name: twins\n",
}
FROM_MERGES = "dataset from-merges"
TRAIN = "train.py data=procedural data.name=list validation= epochs=2 batch=4 logger=none"
# What is done, and the words behind `python`.
STEPS = (
    (
        "build a set of 12 pairs",
        "-m topomerge.datasets.pairs.build data=procedural data.name=list data.pairs=12 data.rooms=[4,6] jobs=1",
    ),
    ("train, two epochs", f"{TRAIN} experiment=gat_scalars name=first"),
    ("a sweep of two runs", f"{TRAIN} -m experiment=gat_scalars node=none,gat name=sweep"),
    (
        "a search of three trials",
        f"{TRAIN} experiment=gat_scalars search=optuna search.space.rate=[1e-4,1e-2,log] search.trials=3 name=tune",
    ),
    ("a node encoder and a loss of one's own", f"{TRAIN} plugins=[own_parts] node=transformer loss=alignment name=own_node"),
    ("check own pairs", "-m topomerge dataset check pairs/"),
    ("own pairs, with truth", "train.py data=folder path=pairs/ experiment=gat_scalars epochs=2 batch=2 logger=none name=own"),
    ("evaluate on the pairs left out", "evaluate.py data=folder path=pairs/ run=runs/own merge=false"),
    (
        "a set in a format of one's own",
        "train.py plugins=[own_parts] data=twins path=pairs/ experiment=gat_scalars epochs=1 batch=2 logger=none name=twins",
    ),
    ("own pairs, without truth", f"-m topomerge {FROM_MERGES} pairs/ -q -o found/"),
    ("fine-tune what ships", "-m topomerge finetune pairs/ -q -o tuned/ --epochs 1 --batch 2 --keep"),
    ("export", "-m topomerge export-embedder runs/own_node -o embedder/"),
    ("merge with it", "-m topomerge merge pairs/h3_a.tmap pairs/h3_b.tmap --descriptor embedder/ -q -o merged"),
)


def main(page: str = "", most: int = len(STEPS)) -> None:
    """Print a table of the first `most` steps; write it into a page."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        rows = []
        for what, words in STEPS[:most]:
            processor, clock = time_step(words, folder)
            rows.append([what, f"`{words}`", f"{processor:.0f}", f"{clock:.0f}"])
            print(f"# {what}: {processor:.1f} s of processor, {clock:.1f} s", flush=True)
    table = write_table(["what", "typed behind `python`", "s of processor", "s by the clock"], rows)
    print(table)
    if page:
        write_blocks(Path(page), {"researcher": table}, build_stamp(f"{COMMAND} {page}", MODULES))


def prepare(folder: Path) -> None:
    """Write parts of one's own, three houses of two maps each, and how these lie to each other."""
    (folder / "own_parts.py").write_text(OWN_PARTS)
    for file, text in OWN_CONFIGS.items():
        (folder / "configs" / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / "configs" / file).write_text(text)
    for script in ("train.py", "evaluate.py"):
        (folder / script).symlink_to(ROOT / script)
    captures, pairs = [], []
    for seed in (3, 4, 5):
        run(f"-m topomerge simulate --building house --seed {seed} --rooms 4 --overlap 0.7 -q -o h{seed}", folder)
        for side in "ab":
            (folder / "pairs").mkdir(exist_ok=True)
            run(f"-m topomerge extract h{seed}/{side}.ply -q -o pairs/h{seed}_{side}.tmap", folder)
            captures.append({"file": f"h{seed}_{side}.tmap", "building": f"h{seed}"})
        truth = json.loads((folder / f"h{seed}/truth.json").read_text())
        (folder / f"pairs/h{seed}.json").write_text(json.dumps(truth))
        pairs.append({"a": f"h{seed}_a", "b": f"h{seed}_b", "transform": truth["T_ab"]})
    (folder / "pairs/pairs.yaml").write_text(yaml.safe_dump({"captures": captures, "pairs": pairs}))


def time_step(words: str, folder: Path) -> tuple[float, float]:
    """Run a step; seconds of processor, of all its processes, and by the clock."""
    _, clock, processor = run_timed(lambda: run(words, folder), resource.RUSAGE_CHILDREN)
    return processor, clock


def run(words: str, folder: Path) -> None:
    """Run `python WORDS` in a folder.

    Raises:
        SystemExit: it failed. That nothing helped or merged (2), or that no pair is sure enough (1), is an answer.
    """
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run(
        [sys.executable, *words.split()], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    refused = 2 if words.startswith(("-m topomerge finetune", "-m topomerge merge")) else 1 if FROM_MERGES in words else 0
    if done.returncode not in (0, refused):
        raise SystemExit(f"python {words}: {done.stdout[-500:]}{done.stderr[-1500:]}")


if __name__ == "__main__":
    main(*sys.argv[1:2])
