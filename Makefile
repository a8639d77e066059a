# `make demo` and `make test` do everything on a fresh machine with Python 3.11 to 3.13.
PYTHON ?= python3
BIN := .venv/bin
PIP := PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet
# PyPI's torch for Linux brings CUDA, 3 GB. Without: make setup TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=
export TOPOMERGE_DATA ?= $(wildcard ../shared/data)
export MPLBACKEND := Agg
unexport PYTHONDONTWRITEBYTECODE
# One thread a process: as many processes as cores run beside each other.
test test-longer: export OMP_NUM_THREADS := 1
test test-longer: export NUMBA_NUM_THREADS := 1

.PHONY: setup demo test test-longer test-slow lint docs bench results-check sealed weights clean
setup: .venv/ready

.venv/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] <= (3, 13) else "topomerge needs Python 3.11, 3.12 or 3.13, not %s: make PYTHON=python3.12" % sys.version.split()[0])'
	$(PYTHON) -m venv .venv
	$(PIP) --upgrade pip
	$(PIP) --constraint constraints.txt torch==2.13.0 $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX))
	$(PIP) --constraint constraints.txt --editable '.[all,dev]'
	$(BIN)/python -c 'import topomerge.kernels'
	@touch $@

# Under five minutes on two cores: two scans merged; then a small embedder trained, judged on buildings that it never saw, exported.
demo: setup
	rm -rf demo/runs demo/eval
	$(BIN)/topomerge simulate --building office --seed 5 --sensors tls,depth --rooms 8 --overlap 0.7 -o demo
	$(BIN)/topomerge extract demo/a.ply -o demo/a.tmap --json demo/a.json --ply demo/a_rooms.ply --figure demo/a.png --report demo/a.html
	$(BIN)/topomerge merge demo/a.tmap demo/b.ply -o demo/merged
	$(BIN)/python -m topomerge.datasets.pairs.build data=procedural data.name=demo data.pairs=16 'data.rooms=[5,8]' cache=demo/cache jobs=2
	$(BIN)/python train.py data=procedural data.name=demo experiment=gat_scalars cache=demo/cache runs=demo/runs name=small validation= epochs=15 batch=4 logger=none
	$(BIN)/python evaluate.py data=heldout_small data.pairs=6 'data.rooms=[5,8]' 'run=[pretrained,demo/runs/small]' 'only=[engineered,shapedna surface]' 'k=[0,1]' 'context=[mean]' 'methods=[full,assignment]' merge=false cache=demo/cache/evaluation folder=demo/eval jobs=2
	$(BIN)/topomerge export-embedder demo/runs/small -o demo/embedder
	$(BIN)/topomerge merge demo/a.tmap demo/b.ply --descriptor demo/embedder -o demo/merged_learned
	@echo "The map from above: demo/a.png; the merge and why it is believed: demo/merged/report.html"

# Both at once, which makes what they share once only: make test TESTS='not slow'
test: TESTS ?= not slow and not longer
test-longer: TESTS ?= longer and not slow
test test-longer: setup
	$(BIN)/python -m pytest -rs -m '$(TESTS)' -n logical --maxprocesses 4 --dist worksteal

test-slow: setup
	$(BIN)/python -m pytest -m slow

# models/ and datasets/ are installed as topomerge.models and topomerge.datasets: types are checked as installed, outside the checkout.
lint: setup
	$(BIN)/ruff check .
	rm -rf build/lint build/lib && $(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --target build/lint .
	cd build/lint && ../../$(BIN)/mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache -p topomerge

docs: setup
	@$(BIN)/python -c 'import mkdocs, mkdocstrings' 2>/dev/null || $(PIP) --constraint constraints.txt --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "The documentation: build/site/index.html"

# All benchmarks of speed, about half an hour. Rooms, merges and the like are measured by evaluate.py: see docs/evaluation.md.
bench: setup
	$(BIN)/python -m benchmarks.speed

# Names the generated blocks and figures of README and docs that this state of the code did not make; it measures nothing.
results-check: setup
	$(BIN)/python -m topomerge.evaluation.results_check

# Once a release: measures the sealed set and appends to docs/results/sealed.md, about 25 minutes. Nothing else can read it.
sealed: setup
	$(BIN)/python -m topomerge.evaluation.sealed --jobs 2

# All learned parts that ship, in their order; what has ended is left as it is. It says how long is left: hours on two cores.
weights: setup
	$(BIN)/python -m topomerge.training.weights jobs=2

clean:
	rm -rf build demo dist *.egg-info .mypy_cache .pytest_cache .ruff_cache
