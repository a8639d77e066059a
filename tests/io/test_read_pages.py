"""PDF and SVG plans: a page as a picture, its texts as they are, its scale; hostile files. No network parses the picture here."""

from __future__ import annotations

import re
import sys
from ctypes import cast, create_string_buffer
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pypdfium2")
pytest.importorskip("resvg_py")

from pypdfium2 import PdfDocument, PdfMatrix, PdfPage, raw

import topomerge as tm
from tests.cases import list_longer
from tests.io.cad_plans import OUTER, ROOMS, parse_dark_lines
from topomerge.errors import InputError
from topomerge.io import drawing, pdf, svg
from topomerge.io.drawing import ParsedDrawing
from topomerge.io.piece import ReadOptions
from topomerge.io.written_lengths import PictureText, find_stated_scale
from topomerge.types import Landmarks

POINTS_A_METRE = 72 / 0.0254 / 100  # of a drawing 1:100
HALL = (20.0, 30.0)  # points, where the lower left corner of the flat lies on the page
A4 = (842.0, 595.0)


@pytest.fixture(autouse=True)
def parser(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Dark pixels are walls and what they enclose is floor; the list takes the pictures that are parsed, half as large."""
    sides = [(svg, name) for name in ("SHORTEST_SIDE", "SHORTEST_READ", "LONGEST_SIDE")]
    for module, name in ((pdf, "FINEST_DOTS"), (pdf, "LONGEST_SIDE"), *sides):
        monkeypatch.setattr(module, name, getattr(module, name) // 2)
    seen: list[np.ndarray] = []

    def parse(picture: np.ndarray, resolution: float | None = None) -> ParsedDrawing:
        seen.append(picture)
        return parse_dark_lines(picture)

    monkeypatch.setattr(drawing, "parse_drawing", parse)
    monkeypatch.setattr(drawing, "load_text_reader", lambda **_: None)
    return seen


def write_pdf(path: Path, pages: list[str], kids: int = 1, more: str = "", size: tuple[float, float] = A4) -> Path:
    """Write a PDF file of pages with these contents; `kids`: how often each is listed; `more`: entries of each page."""
    listed = " ".join(f"{4 + 2 * k} 0 R" for k in range(len(pages)) for _ in range(kids))
    objects = ["<</Type/Catalog/Pages 2 0 R>>", f"<</Type/Pages/Kids[{listed}]/Count {len(pages) * kids}>>"]
    objects.append("<</Type/Font/Subtype/Type1/BaseFont/Helvetica>>")
    for k, content in enumerate(pages):
        box = f"/MediaBox[0 0 {size[0]:g} {size[1]:g}]/Resources<</Font<</F 3 0 R>>>>"
        objects.append(f"<</Type/Page/Parent 2 0 R{box}/Contents {5 + 2 * k} 0 R{more}>>")
        objects.append(f"<</Length {len(content)}>>stream\n{content}\nendstream")
    out, starts = b"%PDF-1.4\n", []
    for number, text in enumerate(objects, 1):
        starts.append(len(out))
        out += f"{number} 0 obj\n{text}\nendobj\n".encode()
    table = "".join(f"{start:010} 00000 n \n" for start in starts)
    tail = f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}trailer<</Size {len(objects) + 1}/Root 1 0 R>>\n"
    path.write_bytes(out + f"{tail}startxref\n{len(out)}\n%%EOF\n".encode())
    return path


def draw_flat(texts: list[str], scale: str = "") -> str:
    """The contents of a page with the flat 1:100, its rooms without doors, each with its name and one of the texts."""
    k = POINTS_A_METRE
    parts = [f"{HALL[0]} {HALL[1]} {OUTER[0] * k:.3f} {OUTER[1] * k:.3f} re"]
    parts += [f"{HALL[0] + x * k:.3f} {HALL[1] + y * k:.3f} {w * k:.3f} {h * k:.3f} re" for x, y, w, h in ROOMS.values()]
    parts.append("f*")  # holes are rooms
    for (name, (x, y, _, h)), text in zip(ROOMS.items(), texts, strict=True):
        left, middle = HALL[0] + (x + 0.3) * k, HALL[1] + (y + h / 2) * k
        parts.append(f"BT /F 8 Tf {left:.2f} {middle:.2f} Td ({name}) Tj 0 -12 Td ({text}) Tj ET")
    return "\n".join([*parts, f"BT /F 9 Tf 600 40 Td ({scale}) Tj ET" if scale else ""])


AREAS = [f"{w * h:.2f} m2" for _, _, w, h in ROOMS.values()]


def read(module: ModuleType, path: Path, **options: object) -> tuple[np.ndarray, Landmarks, tuple[str, ...]]:
    """(n, 2) points of the floor, m, landmarks and warnings."""
    first, floor, *_ = module.read_in_process(path, ReadOptions(**options))  # type: ignore[arg-type]
    return floor.points[:, :2], first.landmarks, first.warnings


@pytest.mark.longer
@pytest.mark.parametrize(
    ("texts", "scale", "turned"),
    [(["-"] * 4, "Plan 1:100", 0), (AREAS, "1 : 50", 90)],
    ids=["scale", "both"],
)
def test_a_page_with_a_plan(tmp_path: Path, texts: list[str], scale: str, turned: int, parser: list[np.ndarray]) -> None:
    """The scale is what is written in rooms or beside the plan; where both disagree (a plan printed smaller), the rooms'."""
    path = write_pdf(tmp_path / "a.pdf", [draw_flat(texts, scale)], more=f"/Rotate {turned}")
    floor, names, warnings = read(pdf, path)
    extent = np.ptp(floor, axis=0)[:: -1 if turned else 1]
    np.testing.assert_allclose(extent, np.array(OUTER) - 0.4, rtol=0.02)
    assert sorted(names.get_values()) == sorted(ROOMS)
    middle = {name: (x + 0.8, y + h / 2) for name, (x, y, w, h) in ROOMS.items()}
    true = np.array([middle[name] for name in names.get_values()])
    places = names.table["position"][:, :2] - floor.min(axis=0) + 0.2
    if turned:  # clockwise: what was the lower left is the upper left
        places = np.stack([OUTER[0] - places[:, 1], places[:, 0]], axis=1)
    np.testing.assert_allclose(places, true, atol=0.6)
    assert any(("'1:100'" if scale.endswith("100") else "m2") in warning for warning in warnings)
    assert max(parser[0].shape) < pdf.LONGEST_SIDE and (parser[0].mean(axis=2)[-200:, -300:] == 255).all()  # no letters on it


@pytest.mark.longer
def test_resolution_is_what_the_user_says(tmp_path: Path) -> None:
    path = write_pdf(tmp_path / "a.pdf", [draw_flat(AREAS)])
    floor, _, _ = read(pdf, path, resolution=0.1)
    pixels = (np.array(OUTER) - 0.4) * POINTS_A_METRE * pdf.FINEST_DOTS / 72
    np.testing.assert_allclose(np.ptp(floor, axis=0), pixels * 0.1, rtol=0.02)


@pytest.mark.longer
def test_pages(tmp_path: Path) -> None:
    plan = draw_flat(AREAS)
    two = write_pdf(tmp_path / "two.pdf", ["", plan, plan])
    assert len(read(pdf, two, page=3)[0]) > 1000
    cases = {
        (two, None): "has 3 pages; name the one with the plan by --page, such as --page 2",
        (two, 1): "there is nothing on page 1",
        (two, 4): "--page 4 is none of them",
        (write_pdf(tmp_path / "empty.pdf", [""]), None): "there is nothing in it",
        (write_pdf(tmp_path / "many.pdf", [""], kids=100_000), None): "nothing on its first 100 pages",
        (write_pdf(tmp_path / "huge.pdf", ["0 0 5 5 re f"], size=(1.0, 1.0)), None): "has a size of 1 x 1 points",
        (write_pdf(tmp_path / "cat.pdf", ["300 300 50 50 re f"]), None): "no walls around a room",
    }
    for (path, number), says in cases.items():
        with pytest.raises(InputError, match=says) as refusal:
            read(pdf, path, page=number)
        assert path.name in str(refusal.value) and "\n" not in str(refusal.value)
    assert len(read(pdf, write_pdf(tmp_path / "one.pdf", ["", plan, ""]))[0]) > 1000


@pytest.mark.longer
def test_a_huge_page_has_bounded_pixels(tmp_path: Path, parser: list[np.ndarray]) -> None:
    path = write_pdf(tmp_path / "a.pdf", [draw_flat(AREAS)], size=(14_400.0, 10_000.0))
    read(pdf, path)
    assert max(parser[0].shape) == pdf.LONGEST_SIDE


def open_page(path: Path) -> PdfPage:
    return PdfDocument(path)[0]


def write_form(path: Path) -> Path:
    """Write the first page of a PDF file as a form on a page of another, half as large, as programs that place plans do."""
    with PdfDocument(path) as source, PdfDocument.new() as target:
        page = target.new_page(*source[0].get_size())
        form = source.page_as_xobject(0, target).as_pageobject()
        form.transform(PdfMatrix().scale(0.5, 0.5))
        page.insert_obj(form)
        page.gen_content()
        target.save(path.with_name("form.pdf"))
    return path.with_name("form.pdf")


def write_scan(path: Path, picture: np.ndarray, stamp: str, mode: int = raw.FPDF_TEXTRENDERMODE_FILL) -> Path:
    """Write a PDF page of a picture (h, w, 3) with a text over it."""
    Image.fromarray(picture).save(path, resolution=pdf.FINEST_DOTS)
    with PdfDocument(path.read_bytes()) as document:
        page = document[0]
        text = raw.FPDFPageObj_NewTextObj(document, b"Helvetica", 12)
        raw.FPDFText_SetText(text, cast(create_string_buffer(f"{stamp}\0".encode("utf-16-le")), raw.FPDF_WIDESTRING))
        raw.FPDFTextObj_SetTextRenderMode(text, mode)
        raw.FPDFPageObj_Transform(text, 1, 0, 0, 1, 600, 40)
        raw.FPDFPage_InsertObject(page, text)
        page.gen_content()
        document.save(path)
    return path


def test_letters_in_a_form_are_not_drawn(tmp_path: Path) -> None:
    """A plan that was placed on a sheet, as it is in most title blocks, is a form: its names are texts all the same."""
    path = write_form(write_pdf(tmp_path / "a.pdf", ["BT /F 20 Tf 100 200 Td (Hall) Tj ET"]))
    picture, texts, _ = pdf.draw_page(path, open_page(path))
    assert [text.text for text in texts] == ["Hall"] and (picture == 255).all()


def test_a_text_in_parts_is_one(tmp_path: Path) -> None:
    """Letters of another font, each word, each letter is written alone: `Office` was `O`, `ffi` and `ce`."""
    letters = "BT /F 8 Tf 100 300 Td (O) Tj /F 8 Tf (ffi) Tj (ce) Tj 0 -10 Td (12.5 m) Tj 4 Ts /F 5 Tf (2) Tj ET"
    upright = "BT /F 8 Tf 0 1 -1 0 300 300 Tm (Living) Tj ( r) Tj (oom) Tj ET"
    apart = "BT /F 8 Tf 400 300 Td (Bath) Tj 28 0 Td (Store) Tj 0 30 Td (WC) Tj ET"
    for turned in (0, 90):
        path = write_pdf(tmp_path / "a.pdf", ["\n".join((letters, upright, apart))], more=f"/Rotate {turned}")
        texts = pdf.find_page_texts(open_page(path), 1.0)
        assert sorted(text.text for text in texts) == ["12.5 m 2", "Bath", "Living room", "Office", "Store", "WC"]


@pytest.mark.longer
def test_a_scan_with_a_stamp_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A text over a scanned plan is not all that is written on it."""
    plan = write_pdf(tmp_path / "plan.pdf", [draw_flat(AREAS)])
    picture, written, _ = pdf.draw_page(plan, open_page(plan))
    path = write_scan(tmp_path / "scan.pdf", picture, "APPROVED")
    assert pdf.is_scanned(open_page(path)) and pdf.is_scanned(open_page(write_form(path)))
    Image.fromarray(picture).save(tmp_path / "plain.pdf", resolution=pdf.FINEST_DOTS)

    def read_picture(image: np.ndarray) -> list[tuple[np.ndarray, str, float]]:
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 4
        return [(square + text.place, text.text, 0.9) for text in written]

    monkeypatch.setattr(drawing, "load_text_reader", lambda **_: read_picture)
    for scan in (path, tmp_path / "plain.pdf"):
        floor, names, warnings = read(pdf, scan)
        np.testing.assert_allclose(np.ptp(floor, axis=0), np.array(OUTER) - 0.4, rtol=0.02)
        assert sorted(names.get_values()) == sorted(ROOMS) and any("m2" in warning for warning in warnings)


def test_a_scan_whose_texts_are_known_is_not_read_again(tmp_path: Path) -> None:
    """Those that a program recognised lie invisible over the picture; a plan without a picture is no scan."""
    page = np.full((400, 900, 3), 255, np.uint8)
    assert not pdf.is_scanned(open_page(write_scan(tmp_path / "a.pdf", page, "Hall", raw.FPDF_TEXTRENDERMODE_INVISIBLE)))
    assert not pdf.is_scanned(open_page(write_pdf(tmp_path / "b.pdf", [draw_flat(AREAS)])))


def test_scales_that_are_stated() -> None:
    def state(*texts: str) -> float | None:
        return find_stated_scale([PictureText(text, (0, 0), 1, 1) for text in texts])

    assert state("M 1:100", "1 : 100 (A3)") == 100 and state("scale 1:50") == 50
    assert state("Ech. 1/200") == state("Maßstab 1/200") == 200 and state("1/200", "on 1/12") is None
    assert state('SCALE: 1/8" = 1\'-0"') == 96 and state("3/16''=1'") == 64 and state("1\" = 10'") == 120
    assert state("0\" = 1'", "1/0\" = 1'") is None
    assert state("1:100", "1:20") is None and state("at 11:45", "1:5", "1:1:100", "3 m") is None


def write_svg(
    path: Path, body: str = "", head: str = "", size: str = 'width="297mm" height="210mm" viewBox="0 0 29.7 21"'
) -> Path:
    """Write the flat 1:100 in centimetres of paper, y down."""
    rooms = "".join(f"M{x + 1} {20 - y}h{w}v{-h}h{-w}z" for x, y, w, h in [*ROOMS.values(), (0, 0, *OUTER)])
    texts = "".join(
        f'<text x="{x + 1.3}" y="{20 - y - h / 2}" style="font-size:0.3px">{name}'
        f'<tspan x="{x + 1.3}" dy="0.4">{w * h:.2f} m²</tspan></text>'
        for name, (x, y, w, h) in ROOMS.items()
    )
    same = "translate(3,2) scale(2) translate(-1.5 -1) scale(.5,0.5)"
    plan = f'<g transform="{same}"><path fill-rule="evenodd" d="{rooms}"/>{texts}</g>'
    links = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    path.write_text(f'<?xml version="1.0"?>{head}<svg {links} {size}>{plan}{body}</svg>', encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "size",
    [
        'width="297mm" height="210mm" viewBox="0 0 29.7 21"',
        *list_longer('viewBox="0 0 29.7 21"', 'width="600" height="900" viewBox="0 0 29.7 21"'),
    ],
)
def test_a_drawing_in_svg(tmp_path: Path, size: str, parser: list[np.ndarray]) -> None:
    floor, names, warnings = read(svg, write_svg(tmp_path / "a.svg", size=size))
    np.testing.assert_allclose(np.ptp(floor, axis=0), np.array(OUTER) - 0.4, rtol=0.02)
    assert sorted(names.get_values()) == sorted(ROOMS)
    true = np.array([(x + 0.7, y + h / 2) for x, y, w, h in (ROOMS[name] for name in names.get_values())])
    np.testing.assert_allclose(names.table["position"][:, :2] - floor.min(axis=0) + 0.2, true, atol=0.4)
    assert any("m²" in warning for warning in warnings) and max(parser[0].shape) >= svg.SHORTEST_SIDE - 1


def test_letters_that_are_outlines_in_svg(tmp_path: Path, parser: list[np.ndarray]) -> None:
    """They are read on the picture, which is drawn finer for them."""
    path = write_svg(tmp_path / "a.svg")
    path.write_text(re.sub("<text.*?</text>", "", path.read_text(encoding="utf-8"), flags=re.DOTALL), encoding="utf-8")
    read(svg, path, resolution=0.01)
    assert abs(max(parser[0].shape) - svg.SHORTEST_READ) <= 1


def test_svg_states_its_scale(tmp_path: Path) -> None:
    path = write_svg(tmp_path / "a.svg", '<text x="20" y="20">1:100</text>')
    path.write_text(path.read_text(encoding="utf-8").replace(" m²", ""), encoding="utf-8")
    floor, _, warnings = read(svg, path)
    np.testing.assert_allclose(np.ptp(floor, axis=0), np.array(OUTER) - 0.4, rtol=0.01)
    assert any("'1:100'" in warning for warning in warnings)


@pytest.mark.longer
def test_what_lies_outside_of_an_svg_is_not_read(tmp_path: Path, parser: list[np.ndarray]) -> None:
    Image.new("L", (50, 50)).save(tmp_path / "black.png")
    plain = write_svg(tmp_path / "a.svg")
    read(svg, plain)
    addresses = (tmp_path / "black.png", (tmp_path / "black.png").as_uri(), "http://127.0.0.1:9/x.png", "black.png")
    body = "".join(
        f'<image {name}="{address}" x="0" y="0" width="10" height="10"/><use {name}="{address}#a"/>'
        for address in addresses for name in ("href", "xlink:href")
    )  # fmt: skip
    imports = "".join(f"<style>@import url({address});</style>" for address in addresses)
    read(svg, write_svg(tmp_path / "b.svg", body + imports, "".join(f'<?xml-stylesheet href="{a}"?>' for a in addresses)))
    np.testing.assert_array_equal(parser[-1], parser[0])


LAUGHS = (
    '<!DOCTYPE svg [<!ENTITY a "ha">'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True))
    + "]>"
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (f'{LAUGHS}<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9">&j;</svg>', "declares entities"),
        ('<!DOCTYPE svg SYSTEM ">" [<!ENTITY a SYSTEM "file:///etc/passwd">]><svg>&a;</svg>', "declares entities"),
        ("<svg" + "><g" * 5000 + "/>" + "</g>" * 4999 + "</svg>", "deep in each other"),
        ("<html></html>", "is XML, but no SVG"),
        ("<svg", "damaged, or not an SVG file"),
        ('<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0h9"/></svg>', "neither width and height nor a viewBox"),
        ('<svg xmlns="http://www.w3.org/2000/svg" width="1e6" height="1"/>', "has a size of"),
        ('<svg xmlns="http://www.w3.org/2000/svg" width="90" height="90"/>', "there is nothing in it"),
        ('<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><path d="M1 1h2v2z"/></svg>', "no walls around a room"),
    ],
)  # fmt: skip
def test_what_is_no_plan_in_svg(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "a.svg"
    for encoding in ("utf-8", "utf-16"):
        path.write_bytes(text.encode(encoding))
        with pytest.raises(InputError, match=says) as refusal:
            read(svg, path)
        assert "a.svg" in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_bomb_of_uses(tmp_path: Path) -> None:
    """10^9 copies of one line: the process that draws them comes to an end, or never starts with them."""
    groups = "".join(f'<g id="g{k + 1}">' + f'<use href="#g{k}"/>' * 10 + "</g>" for k in range(9))
    path = tmp_path / "a.svg"
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" width="90" height="90"><path id="g0" d="M0 0h9"/>{groups}</svg>')
    with pytest.raises(InputError) as refusal:
        tm.read_points(path)
    assert "a.svg" in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.longer
@pytest.mark.usefixtures("fresh_readers")
def test_in_a_process_of_its_own(tmp_path: Path) -> None:
    """What the child refuses is told in one line by the parent."""
    write_pdf(tmp_path / "a.pdf", [""])
    (tmp_path / "a.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg" width="90" height="90"/>')
    for name in ("a.pdf", "a.svg"):
        with pytest.raises(InputError, match="there is nothing in it"):
            tm.read_points(tmp_path / name)


def test_a_damaged_page_and_options_of_no_use(tmp_path: Path) -> None:
    (tmp_path / "a.pdf").write_bytes(b"%PDF-1.4")
    (tmp_path / "a.svg").write_text("<svg/>")
    (tmp_path / "b.pdf").write_bytes(b"%PDF-1.4\nbut nothing more")
    with pytest.raises(InputError, match="damaged, or not a PDF"):
        tm.read_points(tmp_path / "b.pdf")
    with pytest.raises(InputError, match="--page is of no use to an SVG drawing"):
        tm.read_points(tmp_path / "a.svg", page=2)
    with pytest.raises(InputError, match="--page 0 can't be used"):
        tm.read_points(tmp_path / "a.pdf", page=0)


@pytest.mark.parametrize(("library", "extra"), [("ezdxf", "dxf"), ("pypdfium2", "pdf"), ("resvg_py", "svg")])
def test_a_missing_library_names_the_extra(tmp_path: Path, library: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / f"a.{extra}").write_text("x")
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=rf"needs {library}: pip install topomerge\[{extra}\]"):
        tm.read_points(tmp_path / f"a.{extra}")
