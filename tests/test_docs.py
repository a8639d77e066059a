"""Every example of the README and the docs is run, and the site is built without a warning."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pytest

from tests.docs_examples import ROOT, Example, commands, examples, pages
from tests.forked import run_words
from tests.io.walks import house_walk, write_kitti, write_scans
from topomerge import registry
from topomerge.cli.main import COMMANDS, EXIT_STATUSES
from topomerge.cli.main import main as cli

QUICK = ("cli.md",)  # pages whose examples need no scans; those of all others are slow
LONGER = ("extend.md", "training.md")  # run by every change all the same
NEW = r"\*\*One (?:file|YAML)\*\*, `([^`]+)`"  # what a reader of extend.md adds


def mark_of(page: Path) -> list[pytest.MarkDecorator]:
    """Mark the examples of a page by how long they take."""
    return [] if page.name in QUICK else [pytest.mark.longer if page.name in LONGER else pytest.mark.slow]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the examples find in their folder: two scans of an office, a house walk as of SLAM, and the scripts."""
    folder = tmp_path_factory.mktemp("workshop")
    small = ["--building", "office", "--seed", "5", "--rooms", "8", "--overlap", "0.7", "--quiet"]
    assert cli(["simulate", *small, "-o", str(folder / "pair")]) == 0
    for name, other in (("a.ply", "scan.ply"), ("b.ply", "other.ply")):
        shutil.move(folder / "pair" / name, folder / other)
    shutil.rmtree(folder / "pair")
    write_scans(folder / "walk", house_walk())
    write_kitti(folder / "walk" / "poses.txt", house_walk().poses)
    for script in ("train.py", "evaluate.py"):
        shutil.copy(ROOT / script, folder)
    return folder


@contextmanager
def within(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def run_command(command: str) -> subprocess.CompletedProcess[str]:
    """Run a line in a shell, with the `topomerge` and `python` of this environment; in a fork what needs no shell."""
    words = shlex.split(command)
    if words[0] in ("topomerge", "python") and not set(command) & set("|&;<>$*\\`"):
        return run_words(words[words[0] == "python" :], Path.cwd())
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path}
    return subprocess.run(command, shell=True, env=environment, capture_output=True, text=True, timeout=600, check=False)


def run_commands(example: Example, where: str) -> None:
    """Run what is typed."""
    typed = commands(example)
    assert typed, f"{where}: a console block without a prompt ($)"
    for number, command in enumerate(typed, 1):
        done = run_command(command)
        requested = example.status if number == len(typed) else 0
        said = f"{done.stdout[-2000:]}{done.stderr[-2000:]}"
        assert done.returncode == requested, f"{where}: `{command}` gives {done.returncode}\n{said}"


def run_page(page: Path, folder: Path) -> None:
    """Run the blocks of a page one after the other, Python in one namespace."""
    names: dict[str, object] = {"__name__": "example"}
    with within(folder):
        for example in examples(page):
            where = f"{page.name}:{example.line}"
            if example.skipped:
                continue
            if example.kind == "console":
                run_commands(example, where)
            else:
                exec(compile(example.text, where, "exec", dont_inherit=True), names)  # as in a file of its own


@pytest.mark.parametrize("page", [pytest.param(p, id=p.name, marks=mark_of(p)) for p in pages()])
def test_examples(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    for own in [v for v in vars(registry).values() if isinstance(v, registry.Registry)]:  # what a page adds goes with it
        monkeypatch.setattr(own, "_registered", dict(own._registered))
    if page.name not in QUICK:
        shutil.copytree(request.getfixturevalue("workshop"), tmp_path, dirs_exist_ok=True)
        (tmp_path / "cache").symlink_to(request.getfixturevalue("own_cache"))
    run_page(page, tmp_path)


def find_fault(example: Example, page: Path) -> str:
    """What of an example's Python cannot be read, or nothing."""
    try:
        compile(example.text, f"{page.name}:{example.line}", "exec")
    except SyntaxError as error:
        return f"{page.name}:{example.line}: {error}"
    return ""


@pytest.mark.parametrize("page", [pytest.param(p, id=p.name) for p in pages()])
def test_python_examples_can_be_read(page: Path) -> None:
    assert not [fault for example in examples(page) if example.kind == "python" and (fault := find_fault(example, page))]


def test_every_command_in_the_docs_exists() -> None:
    """Also those that are not run: the command and its options are known to the parser."""
    known = {c.name: {f for flags, _ in c.arguments for f in flags} for c in COMMANDS}
    seen = set()
    for page in pages():
        for example in examples(page):
            for command in commands(example) if example.kind == "console" else ():
                for words in re.findall(r"(?:^|&& |\| )topomerge ([^|&>#]*)", command):
                    name, *rest = words.split()
                    seen.add(name)
                    flags = {w.partition("=")[0] for w in rest if w.startswith("-")} - {"-v", "--help", "-h"}
                    assert name.startswith("-") or flags <= known[name], f"{page.name}:{example.line}: {command}"
    assert {"extract", "merge", "atlas"} <= seen


def test_links_and_pictures_lead_somewhere() -> None:
    """MkDocs says nothing of a picture that is missing."""
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")):
        prose = re.sub(r"(?s)```.*?```|`[^`]*`", "", page.read_text(encoding="utf-8"))
        for target in re.findall(r"\]\(([^)\s#]+)[^)]*\)", prose):
            assert "://" in target or (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_exit_statuses_are_told_alike() -> None:
    page = (ROOT / "docs" / "cli.md").read_text()
    statuses = re.findall(r"(?m)^  (\d+) ", EXIT_STATUSES)
    assert {"0", "1", "2"} <= set(statuses)
    for status in statuses:
        assert f"| {status} |" in page


@cache
def named_in(path: Path) -> set[str]:
    """Functions and classes of a file, and `Class.method`."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{n.name}" for n in node.body if isinstance(n, ast.FunctionDef)}
    return found


def resolve(name: str) -> object:
    """Import what a name with dots stands for.

    Raises:
        ImportError, AttributeError: there is no such thing.
    """
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:k]))
        except ModuleNotFoundError as error:
            if error.name and not name.startswith(error.name):
                raise
            continue
        for part in parts[k:]:
            found = getattr(found, part)
        return found
    raise ImportError(name)


def test_everything_that_the_page_of_python_names_is_there() -> None:
    text = (ROOT / "docs" / "api.md").read_text()
    named = re.findall(r"(?m)^::: ([\w.]+)", text) + re.findall(r"`((?:topomerge|tm)\.\w[\w.]*)", text)
    assert len(named) > 20
    for name in named:
        try:
            resolve(re.sub(r"^tm\b", "topomerge", name))
        except (ImportError, AttributeError) as error:
            pytest.fail(f"docs/api.md: {name}: {error}")


def test_every_file_that_a_page_names_is_there() -> None:
    """Also with the name of what stands in it, `file.py:name` and ``X` of `file.py``; and modules that ``python -m`` starts.
    Records of decisions may name what went."""
    new = set(re.findall(NEW, (ROOT / "docs" / "extend.md").read_text()))
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")):
        text, where = page.read_text(encoding="utf-8"), page.relative_to(ROOT)
        for module in re.findall(r"python -m ((?:topomerge|benchmarks)[\w.]*)", text):
            assert importlib.util.find_spec(module.rstrip(".")), f"{where}: {module} is not there"
        if page.parent.name == "adr":
            continue
        for path, name in re.findall(
            r"`((?:topomerge|models|datasets|configs|tests|benchmarks|docs|ros)/[\w./-]*)(?::([\w.]+))?`", text
        ):
            assert path in new or (ROOT / path).exists(), f"{where}: {path} is not there"
            assert not name or name in named_in(ROOT / path), f"{where}: {path} has no {name}"
        for name, path in re.findall(r"in `(\w+)`\s+of\s+`([\w/]+\.py)`", text):
            assert hasattr(importlib.import_module(source_name(path)), name), f"{where}: {path} has no {name}"


def source_name(path: str) -> str:
    """Name the module of a file as it is installed."""
    name = path.removesuffix(".py").replace("/", ".")
    return name if name.startswith("topomerge") else f"topomerge.{name}"


@pytest.mark.longer
def test_the_files_of_extend_work_as_they_stand(tmp_path: Path) -> None:
    """Each file that the page adds is imported by itself, its YAML is taken, and its task trains, from a folder of one's own."""
    pytest.importorskip("hydra")
    text = (ROOT / "docs" / "extend.md").read_text()
    added = re.findall(r"\*\*One YAML\*\*, `configs/(\w+)/(\w+)\.yaml`.*?```yaml\n(.*?)```", text, re.DOTALL)
    assert len(added) == text.count("```yaml") == 9
    for group, name, block in added:
        (tmp_path / "configs" / group).mkdir(parents=True, exist_ok=True)
        (tmp_path / "configs" / group / f"{name}.yaml").write_text(block)
    files = re.findall(r"\*\*One file\*\*, `(?:\w+/)*(\w+)\.py`.*?```python\n(.*?)```", text, re.DOTALL)
    for name, block in files:
        (tmp_path / f"{name}.py").write_text(block)
    plugins = ["extent", "patches", "transformer", "alignment", "descent", "small_first", "lines", "area", "twins"]
    assert sorted(name for name, _ in files) == sorted([*plugins, "outline", "mine"])
    script = (
        "import importlib; from topomerge.training.tasks import compose_settings as c, train\n"
        "from topomerge.training.settings import check\n"
        f"for name in {[name for name, _ in files]}: importlib.import_module(name)\n"
        f"s = c(['plugins=[{','.join(plugins)}]', 'geometry=extent', 'node=transformer', 'loss=alignment',"
        " 'experiment=descent', 'data=twins', 'path=.']); check(s)\n"
        "print(s.network.geometry.parts, s.network.node.kind, s.loss.options, s.optimizer, s.schedule, s.data)\n"
        f"s = c(['plugins=[{','.join(plugins)}]', 'geometry=patches', 'experiment=small_first', 'data=twins', 'path=.'])\n"
        "print(s.network.geometry.parts, s.network.turns, s.sampler)\n"
        "train(c(['plugins=[area,lines]', 'task=area', 'experiment=told', 'epochs=1']), print)"
    )
    (tmp_path / "tried.py").write_text(script)
    done = run_words(["tried.py"], tmp_path)
    assert done.stdout.startswith("['extent'] transformer {'spread': 0.5} nadam halved twins\n"), done.stderr
    assert "\n['scalars', 'surroundings:patches'] 4 small_first\nepoch 1/1 " in done.stdout
    assert " rectangles/s" in done.stdout and (tmp_path / "runs" / "area" / "lines.txt").is_file()


def test_every_formula_has_its_function() -> None:
    named = re.findall(r"`((?:topomerge|models|datasets)/[\w/]+\.py):([\w.]+)`", (ROOT / "docs" / "method.md").read_text())
    assert len(named) > 60
    for path, name in named:
        assert name in named_in(ROOT / path), f"docs/method.md: {path} has no {name}"


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    assert (tmp_path / "site" / "method.html").exists()
