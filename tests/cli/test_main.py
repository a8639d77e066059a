"""The command line: statuses, one-line errors, whole files or none, and nothing heavy before it is needed."""

from __future__ import annotations

import argparse
import json
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import topomerge
from tests.cli.processes import Run, process
from tests.scenes import two_rooms
from tests.scenes_map import building, same
from topomerge.cli.main import COMMANDS
from topomerge.cli.options import check_cloud_options, collect_reading_options
from topomerge.errors import InputError
from topomerge.io.maps import load_map


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Reading and extracting replaced: what they were given is recorded, and a `result` (map or error) comes out."""
    import topomerge.extraction.extract as extraction
    import topomerge.io.points as points

    seen: dict[str, Any] = {"result": building(2, 2)}

    def read_chunks(path: str, **options: Any) -> str:
        seen["read"] = {"path": path, **options}
        return "chunks"

    def extract(chunks: str, **options: Any) -> Any:
        seen["extract"] = {"chunks": chunks, **options}
        if isinstance(seen["result"], BaseException):
            raise seen["result"]
        return seen["result"]

    monkeypatch.setattr(points, "read_chunks", read_chunks)
    monkeypatch.setattr(extraction, "extract", extract)
    return seen


def test_help_imports_nothing_heavy() -> None:
    code = """
import sys
from topomerge.cli.main import main
for words in (["--help"], ["--version"], ["extract", "--help"], ["info", "--help"], ["extract"]):
    main(words)
heavy = {"numpy", "numba", "scipy", "matplotlib", "rich", "open3d", "torch", "plyfile"} & set(sys.modules)
sys.exit(f"imported {heavy}" if heavy else 0)
"""
    done = process(code=code)
    assert done.returncode == 0, done.stderr


def test_files_are_opened_before_anything_heavy_is_imported(tmp_path: Path) -> None:
    """What is wrong with a name or a file is told before numba compiles and SciPy is imported."""
    (tmp_path / "damaged.tmap").write_text("no map")
    (tmp_path / "empty.ply").touch()
    (tmp_path / "one.ply").write_text("ply")
    code = """
import sys
from topomerge.cli.main import main
for words in (
    "extract none.ply -o a.tmap", "extract empty.ply -o a.tmap", "info none.tmap", "info damaged.tmap",
    "embed damaged.tmap -o a.npy",
    "merge none.ply one.ply -o m", "merge one.ply empty.ply -o m", "merge damaged.tmap one.ply -o m", "match none.tmap one.ply",
    "match damaged.tmap one.ply", "diff damaged.tmap one.ply", "atlas add atlas none.tmap", "atlas find atlas damaged.tmap",
    "locate none.tmap atlas", "export none.tmap --to geojson -o a.geojson", "edit none.tmap --list",
):
    assert main(words.split()) == 1, words
    heavy = {"numba", "scipy", "shapely", "onnxruntime", "matplotlib", "topomerge.kernels"} & set(sys.modules)
    assert not heavy, (words, heavy)
"""
    done = process(code=code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_what_scipy_imports_and_nobody_uses_does_not_run() -> None:
    code = """
import sys
from topomerge.cli.console import postpone_imports
postpone_imports()
import scipy.ndimage, scipy.sparse
assert "numpy.f2py" in sys.modules and not {"numpy.f2py.crackfortran", "unittest"} & set(sys.modules)
import numpy.f2py, numpy.testing
numpy.testing.assert_allclose(1.0, 1.0)
assert callable(numpy.f2py.run_main) and "unittest" in sys.modules
import scipy.spatial
import importlib.util
late = {name for name, module in sys.modules.items() if isinstance(module, importlib.util._LazyModule)}
assert late <= {"numpy.f2py", "numpy.testing"}, late  # no other: threads that use one for the first time at once see half of it
import inspect
assert inspect.getdoc(scipy.spatial.cKDTree) is None  # so SciPy finds no documentation to parse
"""
    done = process(code=code)
    assert done.returncode == 0, done.stderr


NEVER_FOR_ONE_MAP = (
    "matplotlib",
    "sklearn",
    "torch",
    "hydra",
    "open3d",
    "pandas",
    "PIL",
    "scipy.optimize",
    "scipy.stats",
    "rich",
    "http.server",
    "numba.np.polynomial",  # of the compiler, which is set up only to compile
)
ONLY_TO_EXTRACT = (
    "scipy.linalg",
    "scipy.spatial",
    "scipy.ndimage",
    "scipy.sparse",
    "shapely",
    "onnxruntime",
    "topomerge.extraction",
)


@pytest.mark.longer
def test_a_command_imports_only_what_it_uses(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", two_rooms().points())
    code = """
import sys
from topomerge.cli.main import main
assert main(sys.argv[1:]) == 0
print(*sys.modules)
"""
    extract = process("extract", "a.npy", "-o", "a.tmap", "-q", code=code, cwd=tmp_path)
    assert extract.returncode == 0 and not set(NEVER_FOR_ONE_MAP) & set(extract.stdout.split()), extract.stderr
    assert set(ONLY_TO_EXTRACT) <= set(extract.stdout.split())
    info = process("info", "a.tmap", "--json", code=code, cwd=tmp_path)
    assert info.returncode == 0 and not {*NEVER_FOR_ONE_MAP, *ONLY_TO_EXTRACT} & set(info.stdout.split()), info.stderr


def test_package_is_lazy_and_whole() -> None:
    code = """
import sys, topomerge as tm
assert "numpy" not in sys.modules
assert set(tm.__all__) <= set(dir(tm))
assert tm.InputError.__name__ == "InputError" and "numpy" not in sys.modules
assert callable(tm.load_map) and tm.load_map is sys.modules["topomerge.io.maps"].load_map
"""
    assert process(code=code).stderr == ""
    assert all(getattr(topomerge, name) is not None for name in topomerge.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        topomerge.nothing  # noqa: B018


def test_module_and_version() -> None:
    assert process("--version").stdout == f"topomerge {topomerge.__version__}\n"
    helped = process("--help").stdout
    assert all(command.name in helped for command in COMMANDS) and "exit status" in helped


@pytest.mark.parametrize("command", [command.name for command in COMMANDS])
def test_help_has_an_example(run: Run, command: str) -> None:
    status, out, _ = run(command, "--help")
    assert status == 0 and f"example:\n  topomerge {command} " in out and "exit status" in out


def test_a_stream_that_the_caller_closed_is_no_failure(tmp_path: Path) -> None:
    command = f"{shlex.quote(sys.executable)} -m topomerge"
    for words, status in (("completion bash >&-", 0), ("info nowhere.tmap 2>&-", 1)):
        done = subprocess.run(["sh", "-c", f"{command} {words}"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stdout, done.stderr) == (status, "", "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("words", ["info a.tmap", "completion bash"])
def test_a_full_disk_is_not_the_inputs_fault(tmp_path: Path, words: str) -> None:
    topomerge.save_map(building(2, 2), tmp_path / "a.tmap")
    with Path("/dev/full").open("w") as full:
        started = [sys.executable, "-m", "topomerge", *words.split()]
        done = subprocess.run(started, cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    said = "topomerge: what is printed can't be written (No space left on device)"
    assert done.returncode == 1 and done.stderr.splitlines()[-1] == said and done.stderr.count(said) == 1


def test_presets_are_those_of_extract() -> None:
    from topomerge.extraction.parameters import PRESETS

    (preset,) = (s for c in COMMANDS if c.name == "extract" for f, s in c.arguments if "--preset" in f)
    assert set(preset["choices"]) == set(PRESETS)


@pytest.mark.parametrize(
    "words",
    [
        ["extract"],
        ["extract", "a.ply"],
        ["extract", "a.ply", "-o", "a.tmap", "--voxel-size", "0"],
        ["extract", "a.ply", "-o", "a.tmap", "--voxel-size", "nan"],
        ["extract", "a.ply", "-o", "a.tmap", "--voxel-size", "ten"],
        ["extract", "a.ply", "-o", "a.tmap", "--unit", "miles"],
        ["extract", "a.ply", "-o", "a.tmap", "--prese", "thesis"],
        ["fly"],
    ],
)
def test_wrong_words(run: Run, words: list[str]) -> None:
    status, out, err = run(*words)
    assert status == 1 and out == ""
    assert err.startswith("topomerge") and err.count("\n") == 1 and "--help" in err


@pytest.mark.parametrize("words", [["", "-o", "a.tmap"], ["scan.ply", "-o", ""], ["scan.ply", "-o", "a.tmap", "--json", ""]])
def test_empty_names_are_no_files(run: Run, stages: dict[str, Any], tmp_path: Path, words: list[str]) -> None:
    status, out, err = run("extract", *words)
    assert status == 1 and out == "" and "is empty; give the name of a file" in err and err.count("\n") == 1
    assert err.startswith("topomerge: the name given for ")
    assert not stages.keys() & {"read"} and not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["--up", "-y"], ["--up=-y"]])
def test_values_may_start_with_a_dash(run: Run, stages: dict[str, Any], words: list[str]) -> None:
    assert run("extract", "scan.ply", "-o", "a.tmap", *words)[0] == 0
    assert stages["read"]["up"] == "-y"


def test_a_second_scan_is_for_merge(run: Run) -> None:
    status, _, err = run("extract", "a.ply", "b.ply", "-o", "a.tmap")
    assert status == 1 and "unrecognized arguments: b.ply: extract takes one scan; `topomerge merge` takes several" in err
    assert err.startswith("topomerge extract: ") and err.endswith("(see topomerge extract --help)\n")
    assert "merge`" not in run("extract", "a.ply", "-o", "a.tmap", "--figures", "a.png")[2]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("merge a.tmap b.tmap -o m --descriptor nowhere", "--descriptor: unknown descriptor 'nowhere'"),
        ("merge a.tmap b.tmap -o m --poses surfaces --scale free", "--poses: poses of surfaces are for two maps of one scale"),
        ("merge a.tmap b.tmap -o m --voxel-size 0.2", "--voxel-size: is for clouds, of no use to a .tmap"),
        ("match a.tmap b.tmap --k 1000", "--k: steps of context "),
        ("match a.tmap b.tmap --k 1", "--k: steps of context are for descriptors of single rooms"),
        ("match a.tmap b.tmap --method attention --descriptor feather", "--method attention needs the embedder that ships"),
        ("match a.tmap b.tmap --up y", "--up: is for clouds"),
        ("embed a.tmap -o a.npy --unit mm", "--unit: is for clouds"),
        ("embed a.tmap -o a.npy --descriptor nowhere", "--descriptor: unknown descriptor"),
        ("embed a.tmap -o a.npz", "a.npz: -o writes .npy; end its name with .npy"),
        ("match a.tmap b.tmap --report m.pdf", "m.pdf: --report writes .html; end its name with .html or .htm"),
        ("atlas add new a.tmap --sensor tls", "--sensor: is for clouds"),
        ("merge a.tmap b.tmap -o m --resolution 0.05", "--resolution: is for pictures, PDF and SVG; give such a file"),
        ("merge a.tmap b.tmap -o m --topic /scan", "--topic: is for ROS bags; give such a bag"),
        ("locate house a.tmap --scale 2", "--scale: is for clouds"),
        ("locate a.tmap b.tmap", "a.tmap: is a file; give the folder of an atlas, and before other files"),
        ("serve-locate nowhere", "nowhere: no such folder"),
        ("export a.tmap --to indoorgml -o b.tmap", "b.tmap: --to indoorgml writes .gml; end its name with .gml"),
        ("simulate --building house --landmarks tags,smells -o pair", "--landmarks smells: is none that is simulated"),
        ("view a.tmap -o a.pdf", "a.pdf: -o writes .html"),
        ("simulate --building house --storeys 9 -o pair", "storeys must be 1 to 8"),
    ],
)
def test_what_is_wrong_with_an_option_is_no_files_fault(run: Run, tmp_path: Path, words: str, message: str) -> None:
    for k, name in enumerate(("a.tmap", "b.tmap")):
        topomerge.save_map(building(k + 1), tmp_path / name)
    status, out, err = run(*words.split())
    assert (status, out) == (1, "") and err.startswith(f"topomerge: {message}") and err.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tmap", "b.tmap"]


def test_an_option_that_one_input_can_use_is_fine() -> None:
    args = argparse.Namespace(up="y")
    check_cloud_options(["a.tmap", "b.ply"], args)
    with pytest.raises(InputError, match="^--up: is for clouds"):
        check_cloud_options(["a.tmap", "b.TMAP"], args)


def test_options_of_reading_go_to_the_inputs_that_take_them(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/0.mcap").touch()
    args = argparse.Namespace(up="y", one_frame=True, resolution=0.05, page=1, topic="/scan")
    names = ("a.png", "b.ply", "c.svg", "bag")
    taken = {name: set(collect_reading_options(str(tmp_path / name), args)) - {"up"} for name in names}
    assert taken == {"a.png": {"resolution", "page"}, "b.ply": set(), "c.svg": {"resolution"}, "bag": {"one_frame", "topic"}}


def test_files_may_follow_options(run: Run, tmp_path: Path) -> None:
    for k, name in enumerate("abc"):
        topomerge.save_map(building(k + 1), tmp_path / f"{name}.tmap")
    assert run("find", "a.tmap", "--text", "nothing", "b.tmap", "--name", "none", "c.tmap") == (
        2,
        "not found: text nothing, name none (in 3 maps)\n",
        "",
    )
    status, _, err = run("merge", "a.tmap", "-o", "m", "b.tmap", "--nonsense")
    assert status == 1 and "unrecognized arguments: b.tmap --nonsense" in err


def test_no_words(run: Run) -> None:
    status, _, err = run()
    assert status == 1 and "extract" in err


def test_extract_writes_all_and_prints_the_table(run: Run, stages: dict[str, Any], tmp_path: Path) -> None:
    words = ["--json", "a.json", "--ply", "a_rooms.ply", "--figure", "a.png"]
    status, out, err = run("extract", "scan.ply", "-o", "a.tmap", *words)
    assert status == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "a.png", "a.tmap", "a_rooms.ply"]
    assert same(load_map(tmp_path / "a.tmap"), stages["result"])
    assert json.loads((tmp_path / "a.json").read_text())["format"] == 1
    assert err == "topomerge: warning: only a test\n"
    assert "10 rooms, 2 storeys, 6 doors, 2 openings, 1 stairs" in out
    assert "4       0     14.6      2.90   1498      5  0, 1, 2, 3, 9 (stairs)" in out
    assert "0.25  read and voxelise" in out


def test_defaults_have_one_home(run: Run, stages: dict[str, Any]) -> None:
    assert run("extract", "scan.ply", "-o", "a.tmap", "--quiet")[:2] == (0, "")
    assert stages["read"] == {"path": "scan.ply", "progress": None}
    assert stages["extract"] == {"chunks": "chunks", "name": "scan.ply", "progress": None}


def test_options_reach_their_functions(run: Run, stages: dict[str, Any]) -> None:
    words = "--voxel-size 0.05 --preset thesis --up y --unit mm --scale 2 --resolution 0.03 --extrude 3 --ceiling"
    assert run("extract", "scan.ply", "-o", "a.tmap", *words.split())[0] == 0
    read = {"up": "y", "unit": "mm", "scale": 2.0, "resolution": 0.03, "extrude": 3.0, "ceiling": True}
    assert read.items() <= stages["read"].items()
    assert {"voxel_size": 0.05, "preset": "thesis"}.items() <= stages["extract"].items()


def from_a_signal(signal: BaseException) -> InputError:
    """As it comes out of a reader that was running compiled code."""
    try:
        try:
            raise SystemError("returned a result with an exception set") from signal
        except SystemError as error:
            raise InputError("scan.ply: damaged") from error
    except InputError as error:
        return error


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (InputError("scan.ply: no floor;\n crop it"), 1, "topomerge: scan.ply: no floor; crop it\n"),
        (ValueError("edge must be above 0"), 1, "topomerge: scan.ply: edge must be above 0\n"),
        (MemoryError(), 1, "topomerge: scan.ply: not enough memory; take larger voxels or a part of the input\n"),
        (PermissionError(13, "Permission denied", "scan.ply"), 1, "topomerge: scan.ply: Permission denied\n"),
        (KeyboardInterrupt(), 130, "topomerge: interrupted\n"),
        (SystemExit(143), 143, ""),
        (from_a_signal(SystemExit(143)), 143, ""),
        (from_a_signal(KeyboardInterrupt()), 130, "topomerge: interrupted\n"),
    ],
)
def test_failures(run: Run, stages: dict[str, Any], tmp_path: Path, error: Any, status: int, said: str) -> None:
    stages["result"] = error
    assert run("extract", "scan.ply", "-o", "a.tmap", "--json", "a.json") == (status, "", said)
    assert not list(tmp_path.iterdir())


def test_a_fault_of_ours_asks_for_a_report(run: Run, stages: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    stages["result"] = KeyError("x")
    status, _, err = run("extract", "scan.ply", "-o", "a.tmap")
    assert status == 1 and err.count("\n") == 1 and "scan.ply: unexpected KeyError" in err
    status, _, err = run("extract", "scan.ply", "-o", "a.tmap", "-vv")
    assert status == 1 and "Traceback" in err
    monkeypatch.setenv("TOPOMERGE_DEBUG", "1")
    assert "Traceback" in run("extract", "scan.ply", "-o", "a.tmap")[2]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["-o", "absent/a.tmap"], "absent/a.tmap: can't be written"),
        (["-o", "."], "is a folder"),
        (["-o", "a.tmap", "--json", "a.tmap"], "two outputs"),
        (["-o", "scan.ply"], "is the input"),
        (["-o", "rooms.ply"], "rooms.ply: -o names the map; end its name with .tmap"),
        (["-o", "a.tmap", "--figure", "a.docx"], "unknown kind of figure"),
        (["-o", "a.tmap", "--report", "a.pdf"], "a.pdf: --report writes .html; end its name with .html or .htm"),
        (["-o", "a.tmap", "--ply", "a.las"], "a.las: --ply writes .ply; end its name with .ply"),
        (["-o", "a.tmap", "--ply", "absent/a.ply"], "absent/a.ply: can't be written"),
    ],
)
def test_unwritable_outputs_are_found_first(
    run: Run, stages: dict[str, Any], tmp_path: Path, words: list[str], reason: str
) -> None:
    (tmp_path / "scan.ply").write_text("ply")
    status, _, err = run("extract", "scan.ply", *words)
    assert status == 1 and reason in err and err.count("\n") == 1
    assert "read" not in stages
    assert [p.name for p in tmp_path.iterdir()] == ["scan.ply"]


def test_all_outputs_or_none(run: Run, stages: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(map: Any, path: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(topomerge, "save_figure", full)
    (tmp_path / "a.tmap").write_text("an older one")
    status, _, err = run("extract", "scan.ply", "-o", "a.tmap", "--figure", "a.png")
    assert (status, err) == (1, "topomerge: a.png: can't be written (No space left on device); give another place\n")
    assert [p.name for p in tmp_path.iterdir()] == ["a.tmap"]
    assert (tmp_path / "a.tmap").read_text() == "an older one"


@pytest.mark.longer
def test_a_real_failure_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n")
    done = process("extract", "bad.ply", "-o", "a.tmap", "--json", "a.json", cwd=tmp_path)
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.startswith("topomerge: bad.ply: ") and done.stderr.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["bad.ply"]


def test_sigterm_leaves_nothing(tmp_path: Path) -> None:
    code = """
import sys, time
import topomerge, topomerge.cli.console as console
from topomerge.cli import main
from topomerge.cli.main import main as cli
def slow(args):
    console.write_all([("a.tmap", lambda path: (print("here", flush=True), time.sleep(30)))])
main.COMMANDS[0].__dict__["run"] = slow
sys.argv[1:] = ["extract", "x", "-o", "a.tmap"]
sys.exit(cli())
"""
    started = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert started.stdout is not None and started.stdout.readline() == "here\n"
    started.send_signal(signal.SIGTERM)
    assert started.wait(20) == 143
    started.stdout.close()
    assert not list(tmp_path.iterdir())
