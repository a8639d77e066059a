"""Writes the smallest plan of each format: two rooms side by side with one door, low x first, the door in the upper half."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

Box = tuple[float, float, float, float]  # x0, y0, x1, y1


def r2v(path: Path, door: float = 40, close: bool = True, seeds: str = "") -> Path:
    """Two rooms of 150 by 150 px, and a door of `door` px whose middle is 40 px below the upper wall."""
    right = 300 if close else 280
    lines = [
        "0 0 300 0",
        "0 150 300 150",
        "0 0 0 150",
        "150 0 150 150",
        f"{right} 20 {right} 130" if not close else "300 0 300 150",
    ]
    rows = [f"{line} wall 1 1" for line in lines]
    rows.append(f"150 {40 - door / 2} 150 {40 + door / 2} door 1 1")
    rows += ["20 60 40 80 bedroom 1 1", "200 60 220 80 kitchen 1 1", *seeds.splitlines()]
    path.write_text("\n".join(row.replace(" ", "\t") for row in rows) + "\n")
    return path


def campus(
    path: Path,
    rooms: Sequence[Box] = ((0, 0, 150, 160), (150, 0, 300, 160)),
    portal: tuple[float, float] = (150, 40),
    centimetres: float = 50,
    labels: Sequence[str] = ("CLASSROOM", "CORRIDOR"),
    outline: Sequence[tuple[float, float]] | None = None,
) -> Path:
    """Two spaces in pixels, y down, 10 px for so many centimetres, and a portal without length between them."""
    spaces = []
    for k, ((x0, y0, x1, y1), label) in enumerate(zip(rooms, labels, strict=True)):
        corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)] if outline is None or k else outline
        points = "".join(f'<point x="{x}" y="{y}"/>' for x, y in corners)
        mark = f'<point x="{portal[0]}" y="{portal[1]}"/>'
        spaces.append(
            f'<space id="s{k}"><labels><type>R</type><label>{label}</label></labels>'
            f"<bounding_polygon>{points}</bounding_polygon><space_representation>"
            f'<linesegment id="p{k}">{mark}{mark}<class>PORTAL</class></linesegment></space_representation>'
            f"<portals><portal><linesegment>p{k}</linesegment><type>EXPLICIT</type>"
            "<target><id>s0</id><id>s1</id></target></portal></portals></space>"
        )
    path.write_text(
        '<?xml version="1.0"?><building id="b"><scale><represented_distance><value>10</value></represented_distance>'
        f"<real_distance><value>{centimetres}</value></real_distance></scale><floor><spaces>{''.join(spaces)}</spaces></floor></building>"
    )
    return path


RMF_LEVEL = """
  {name}:
    elevation: {elevation}
    measurements: {measurements}
    vertices: [[0, 0, 0, ""], [200, 0, 0, ""], [200, 100, 0, ""], [0, 100, 0, ""], [100, 0, 0, ""], [100, 20, 0, ""],
      [100, 40, 0, ""], [100, 100, 0, ""], [150, 50, 0, "kitchen"]]
    walls: [[0, 4], [4, 1], [1, 2], [2, 7], [7, 3], [3, 0], [4, 5], [6, 7]]
    doors: [[5, 6, {{type: [1, hinged]}}]]
"""


def rmf(
    path: Path, measurements: str = "[[0, 1, {distance: [3, 10.0]}]]", levels: int = 1, system: str = "reference_image"
) -> Path:
    """Levels of 10 by 5 m, a wall in the middle with a door of 1 m whose middle is 1.5 m below the upper wall."""
    text = f"name: test\ncoordinate_system: {system}\nlevels:"
    text += "".join(RMF_LEVEL.format(name=f"L{k + 1}", elevation=3.5 * k, measurements=measurements) for k in range(levels))
    stops = ", ".join(f"L{k + 1}: [d]" for k in range(levels))
    if levels > 1:
        text += "lifts:\n  lift: {x: 180, y: 80, yaw: 0.0, width: 1.4, depth: 1.4, reference_floor_name: L1,\n"
        text += f"    doors: {{d: {{x: 0, y: 0.8, width: 0.9}}}}, level_doors: {{{stops}}}}}\n"
    path.write_text(text)
    return path


def mall(folder: Path, width: float = 30.0, info: bool = True) -> Path:
    """A floor of 30 by 20 m whose left 10 m are a shop; the rest is hall."""
    folder.mkdir(exist_ok=True)
    origin, metre = np.array([120.1, 30.3]), 1 / 111_320.0

    def feature(box: Box, name: str) -> dict[str, object]:
        x0, y0, x1, y1 = box
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        degrees = origin + corners * metre / [np.cos(np.radians(origin[1])), 1]
        return {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [degrees.tolist()]},
            "properties": {"name": name},
        }

    features = [feature((0, 0, 30, 20), "F1"), feature((0, 0, 10, 20), "adidas"), feature((20, 5, 22, 7), "feikaifangquyu")]
    (folder / "geojson_map.json").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    if info:
        (folder / "floor_info.json").write_text(json.dumps({"map_info": {"width": width, "height": 20.0}}))
    return folder / "geojson_map.json"


def amrl(path: Path, size: float = 1.0) -> Path:
    """Walls around 10 by 5 m and one in the middle with a gap of 0.9 m whose middle is 1.5 m below the upper wall."""
    lines = [(0, 0, 10, 0), (10, 0, 10, 5), (10, 5, 0, 5), (0, 5, 0, 0), (5, 0, 5, 3.05), (5, 3.95, 5, 5)]
    scaled = np.array(lines) * size
    path.write_text(json.dumps([{"p0": {"x": a, "y": b}, "p1": {"x": c, "y": d}} for a, b, c, d in scaled.tolist()]))
    return path


def bwi(folder: Path, doors: bool = True, resolution: float = 0.05) -> Path:
    """Rooms of 100 by 100 px side by side; map, names, polygons and a door of 1 m in the upper half."""
    folder.mkdir(exist_ok=True)
    grid = Image.new("L", (240, 140), 0)
    draw = ImageDraw.Draw(grid)
    draw.rectangle((20, 20, 117, 119), fill=254)
    draw.rectangle((122, 20, 219, 119), fill=254)
    grid.save(folder / f"{folder.name}.png")
    (folder / f"{folder.name}.yaml").write_text(
        f"image: {folder.name}.pgm\nresolution: {resolution}\norigin: [-1.0, -2.0, 0.0]\n"
    )
    (folder / "locations.yaml").write_text(
        "data: locations.pgm\nlocations: [lab, hall]\npolygons:\n"
        "- [20, 20, 119, 20, 119, 119, 20, 119, 20, 20]\n- [121, 20, 220, 20, 220, 119, 121, 119, 121, 20]\n"
    )
    if doors:
        (folder / "doors.yaml").write_text(
            "- approach:\n  - from: lab\n    point: [4, 3, 0]\n  - from: hall\n    point: [6, 3, 0]\n"
            "  door_corner_pt_1: [5.0, 3.0]\n  door_corner_pt_2: [5.0, 2.0]\n  name: d\n"
        )
    return folder / "locations.yaml"


def ipa(folder: Path) -> Path:
    """Two free rooms of 100 by 100 px with a doorway of 20 px in the upper half; the truth has a line there."""
    scan, truth = Image.new("L", (240, 140), 0), Image.new("RGB", (240, 140))
    for image, white in ((scan, 255), (truth, (255, 255, 255))):
        draw = ImageDraw.Draw(image)
        draw.rectangle((20, 20, 118, 119), fill=white)
        draw.rectangle((122, 20, 220, 119), fill=white)
    ImageDraw.Draw(scan).rectangle((118, 40, 122, 59), fill=255)
    scan.save(folder / "flat.png")
    truth.save(folder / "flat_gt_segmentation.png")
    return folder / "flat_gt_segmentation.png"


def valetudo(folder: Path, rooms: int = 2) -> Path:
    """A row of rooms of 4 m by 3 m in pixels of 5 cm, walls of 0.1 m, doors of 0.9 m."""
    layers, walls = [], []
    for k in range(rooms):
        first = 200 + 82 * k
        layers.append({"type": "segment", "compressedPixels": [n for r in range(100, 160) for n in (first, r, 80)]})
        walls += [n for r in range(100, 160) if k == rooms - 1 or not 120 <= r < 138 for n in (first + 80, r, 2)]
        layers[-1]["compressedPixels"] += [n for r in range(120, 138) if k < rooms - 1 for n in (first + 80, r, 2)]
    walls += [n for r in (98, 99, 160, 161) for n in (198, r, 82 * rooms + 2)] + [n for r in range(100, 160) for n in (198, r, 2)]
    layers.append({"type": "wall", "compressedPixels": walls})
    path = folder / "home.json"
    path.write_text(json.dumps({"__class": "ValetudoMap", "pixelSize": 5, "layers": layers}))
    return path


def ifc(path: Path, spaces: int = 2) -> Path:
    """Spaces of 5 by 4 m, 0.2 m apart, and between the first two a door of 1 m around y = 3."""
    import ifcopenshell
    import ifcopenshell.guid

    model = ifcopenshell.file(schema="IFC4")
    new = model.create_entity

    def box(x0: float, y0: float, x1: float, y1: float, height: float) -> object:
        corners = [new("IfcCartesianPoint", p) for p in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))]
        profile = new("IfcArbitraryClosedProfileDef", "AREA", None, new("IfcPolyline", corners))
        solid = new("IfcExtrudedAreaSolid", profile, place, new("IfcDirection", (0.0, 0.0, 1.0)), height)
        shape = new("IfcShapeRepresentation", context, "Body", "SweptSolid", [solid])
        return new("IfcProductDefinitionShape", None, None, [shape])

    def element(kind: str, name: str, shape: object = None) -> object:
        return new(
            kind, ifcopenshell.guid.new(), Name=name, ObjectPlacement=new("IfcLocalPlacement", None, place), Representation=shape
        )

    place = new("IfcAxis2Placement3D", new("IfcCartesianPoint", (0.0, 0.0, 0.0)))
    context = new("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, place)
    units = new("IfcUnitAssignment", [new("IfcSIUnit", None, "LENGTHUNIT", None, "METRE")])
    new("IfcProject", ifcopenshell.guid.new(), Name="test", RepresentationContexts=[context], UnitsInContext=units)
    storey = element("IfcBuildingStorey", "Ground")
    rooms = [element("IfcSpace", f"Office {k}", box(5.2 * k, 0.0, 5.2 * k + 5, 4.0, 2.6)) for k in range(spaces)]
    if rooms:
        new("IfcRelAggregates", ifcopenshell.guid.new(), RelatingObject=storey, RelatedObjects=rooms)
    element("IfcDoor", "door", box(5.0, 2.5, 5.2, 3.5, 2.1))
    model.write(str(path))
    return path
