"""References of STEP files: circles are refused, long chains and paired boundaries of spaces are not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from topomerge.errors import InputError
from topomerge.io import ifc, read_points


def step_file(path: Path, *statements: str) -> Path:
    header = "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\nFILE_NAME('','',(''),(''),'','','');\n"
    header += "FILE_SCHEMA(('IFC4'));\nENDSEC;\n"
    path.write_text(header + "DATA;\n" + "".join(f"{s};\n" for s in statements) + "ENDSEC;\nEND-ISO-10303-21;\n")
    return path


def chain(length: int) -> list[str]:
    """Placements, each relative to the one before."""
    points = ["#1=IFCCARTESIANPOINT((0.,0.,1.))", "#2=IFCAXIS2PLACEMENT3D(#1,$,$)", "#3=IFCLOCALPLACEMENT($,#2)"]
    return points + [f"#{i}=IFCLOCALPLACEMENT(#{i - 1},#2)" for i in range(4, length + 1)]


def boundary(number: int, other: int) -> str:
    return f"#{number}=IFCRELSPACEBOUNDARY2NDLEVEL('{number}',$,$,$,#1,#1,$,.PHYSICAL.,.INTERNAL.,$,#{other})"


def is_refused(path: Path) -> bool:
    try:
        ifc.check_references(path)
    except InputError:
        return True
    return False


def test_a_chain_of_a_thousand_passes(tmp_path: Path) -> None:
    assert not is_refused(step_file(tmp_path / "a.ifc", *chain(1000), "#1001=IFCNOTE('#1001')"))
    assert is_refused(step_file(tmp_path / "b.ifc", *chain(1000), "#1001=IFCNOTE(#1001)"))


@pytest.mark.longer
def test_a_model_with_such_a_chain_is_read(samples: dict[str, Path], tmp_path: Path) -> None:
    """The whole model stands on it: its lowest placement is the last of the chain."""
    pytest.importorskip("ifcopenshell")
    first = 1_000_000
    text = samples["model.ifc"].read_text()
    links = [f"#{first}=IFCCARTESIANPOINT((0.,0.,0.));", f"#{first + 1}=IFCAXIS2PLACEMENT3D(#{first},$,$);"]
    links += [f"#{first + 2}=IFCLOCALPLACEMENT($,#{first + 1});"]
    links += [f"#{i}=IFCLOCALPLACEMENT(#{i - 1},#{first + 1});" for i in range(first + 3, first + 1003)]
    assert "IFCLOCALPLACEMENT($," in text
    text = text.replace("IFCLOCALPLACEMENT($,", f"IFCLOCALPLACEMENT(#{first + 1002},")
    (tmp_path / "a.ifc").write_text(text.replace("DATA;\n", "DATA;\n" + "\n".join(links) + "\n", 1))
    expected = read_points(samples["model.ifc"], spacing=0.5).points
    assert read_points(tmp_path / "a.ifc", spacing=0.5).points.shape == expected.shape


def test_boundaries_of_spaces_may_name_each_other(tmp_path: Path) -> None:
    assert not is_refused(step_file(tmp_path / "a.ifc", *chain(3), boundary(4, 5), boundary(5, 4)))
    assert is_refused(step_file(tmp_path / "b.ifc", *chain(3), "#4=IFCNOTE(#5)", "#5=IFCNOTE(#4)"))


@pytest.mark.parametrize(
    ("statements", "says"),
    [
        (["#4=IFCLOCALPLACEMENT(#4,#2)"], "1 entities refer to themselves"),
        (
            ["#4=IFCLOCALPLACEMENT(#5,#2)", "#5=IFCLOCALPLACEMENT(#4,#2)", "#6=IFCLOCALPLACEMENT(#5,#2)"],
            "2 entities refer to themselves",
        ),
        (["#4=IFCRELSPACEBOUNDARY2NDLEVEL('',$,$,$,#5,$,$,.PHYSICAL.,.INTERNAL.,$,$)", "#5=IFCSPACE(#4)"], "2 entities refer"),
        (["/* #9 */ #4=IFCLOCALPLACEMENT(#5,#2)", f"#5=IFCLOCALPLACEMENT(#{10**30},#4)"], "2 entities refer"),
    ],
)
def test_circles_are_refused(tmp_path: Path, statements: list[str], says: str) -> None:
    path = step_file(tmp_path / "a.ifc", *chain(3), *statements)
    with pytest.raises(InputError, match=says) as caught:
        ifc.check_references(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_what_could_end_the_library_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nested deeper than 5,000") as caught:
        ifc.check_references(step_file(tmp_path / "a.ifc", *chain(6000)))
    assert "themselves" not in str(caught.value)


@pytest.mark.parametrize(("module", "absent"), [("e57", ("numba", "scipy")), ("ifc", ("scipy.sparse",))])
def test_a_process_that_reads_imports_what_its_format_needs(module: str, absent: tuple[str, ...]) -> None:
    code = f"import sys, topomerge.io.piece, topomerge.io.{module}; print([n for n in {absent} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


def test_the_library_is_imported_without_its_grammars() -> None:
    pytest.importorskip("ifcopenshell")
    code = "import sys; from topomerge.io import ifc; ifc._import_library().open; print('lark' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (0, "False\n"), done.stderr


@pytest.mark.parametrize(("cores", "threads"), [(None, 1), (1, 1), (2, 1), (3, 3), (64, 4)])
def test_bodies_are_made_by_one_thread_where_two_gain_nothing(
    monkeypatch: pytest.MonkeyPatch, cores: int | None, threads: int
) -> None:
    geom, requested = pytest.importorskip("ifcopenshell.geom"), []

    def refuse(_settings: object, _model: object, count: int, **_: object) -> None:
        requested.append(count)
        raise RuntimeError

    monkeypatch.setattr(geom, "iterator", refuse)
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    assert not list(ifc._iter_shapes_by_kernel(None, [], "opencascade")) and requested == [threads]
