"""Small files of every format that is read: the walls of a box of 4 x 3 x 2.5 m."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

OCTOMAP_HEADER = b"# Octomap OcTree binary file\n# a comment\n#\nid OcTree\nsize %d\nres 0.1\ndata\n"


def box_points(count: int = 600, seed: int = 0) -> np.ndarray:
    """(count, 3) points on the six sides of the box, float32 values."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.integers(0, 2, count)
    return (points * (4, 3, 2.5)).astype(np.float32)


def box_colors(count: int = 600, seed: int = 1) -> np.ndarray:
    """(count, 3) uint8."""
    return np.random.default_rng(seed).integers(0, 256, (count, 3)).astype(np.uint8)


def write_ply(path: Path, points: np.ndarray, colors: np.ndarray | None, *, text: bool, order: str, kind: str) -> None:
    from plyfile import PlyData, PlyElement

    names = [("x", kind), ("nx", "f4"), ("y", kind), ("z", kind)]
    names += [] if colors is None else [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.zeros(len(points), names)
    for i, name in enumerate("xyz"):
        rows[name] = points[:, i]
    for i, name in enumerate(("red", "green", "blue") if colors is not None else ()):
        rows[name] = colors[:, i]
    PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order=order).write(str(path))


def write_pcd(path: Path, points: np.ndarray, colors: np.ndarray, *, ascii: bool, compressed: bool) -> None:
    try:
        import open3d
    except ImportError:  # no wheel for this Python loads on a bare machine
        _write_pcd_plainly(path, points, colors, ascii, compressed)
        return
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(float)))
    cloud.colors = open3d.utility.Vector3dVector(colors / 255.0)
    open3d.io.write_point_cloud(str(path), cloud, write_ascii=ascii, compressed=compressed)


def _write_pcd_plainly(path: Path, points: np.ndarray, colors: np.ndarray, ascii: bool, compressed: bool) -> None:
    """The same without Open3D; what is compressed holds runs of bytes only, no repetitions."""
    packed = (colors.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(axis=1).astype(np.uint32).view(np.float32)
    rows = np.column_stack([points.astype(np.float32), packed])
    kind = "ascii" if ascii else "binary_compressed" if compressed else "binary"
    header = "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    header += f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA {kind}\n"
    if ascii:
        body = "".join(" ".join(f"{v:.9g}" for v in row) + "\n" for row in rows).encode()
    elif compressed:
        raw = rows.T.tobytes()
        runs = b"".join(bytes([len(raw[i : i + 32]) - 1]) + raw[i : i + 32] for i in range(0, len(raw), 32))
        body = np.array([len(runs), len(raw)], "<u4").tobytes() + runs
    else:
        body = rows.tobytes()
    path.write_bytes(header.encode() + body)


def write_las(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [1e-4] * 3, np.floor(points.min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.asarray(points, float).T
    las.red, las.green, las.blue = colors.astype(np.uint16).T * 257
    las.write(str(path))


def write_e57(path: Path, scans: list[tuple[np.ndarray, np.ndarray, np.ndarray]], colors: np.ndarray) -> None:
    """Scans as (points in the scanner's frame, quaternion w x y z, translation)."""
    import pye57

    file = pye57.E57(str(path), mode="w")
    for points, quaternion, translation in scans:
        data = {f"cartesian{a}": np.array(points[:, i], float) for i, a in enumerate("XYZ")}
        data |= {f"color{c}": np.array(colors[:, i]) for i, c in enumerate(("Red", "Green", "Blue"))}
        file.write_scan_raw(data, rotation=quaternion, translation=translation)
    file.close()


def write_ifc(path: Path, slab: bool = False) -> None:
    """Two rooms of 4 x 3 m side by side, one above the first; a wall with a door leaf standing in it; millimetres.

    No room has a floor, unless a slab lies under the lower two.
    """
    import ifcopenshell
    from ifcopenshell import guid

    model = ifcopenshell.file(schema="IFC4")
    make = model.create_entity
    unit = make("IfcSIUnit", UnitType="LENGTHUNIT", Prefix="MILLI", Name="METRE")
    origin = make("IfcAxis2Placement3D", make("IfcCartesianPoint", (0.0, 0.0, 0.0)))
    context = make("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, origin)
    units = make("IfcUnitAssignment", [unit])
    project = make("IfcProject", guid.new(), RepresentationContexts=[context], UnitsInContext=units)

    def body(outline: list[tuple[float, float]], z: float, height: float) -> object:
        points = [make("IfcCartesianPoint", (float(x), float(y))) for x, y in [*outline, outline[0]]]
        profile = make("IfcArbitraryClosedProfileDef", "AREA", None, make("IfcPolyline", points))
        place = make("IfcAxis2Placement3D", make("IfcCartesianPoint", (0.0, 0.0, float(z))))
        solid = make("IfcExtrudedAreaSolid", profile, place, make("IfcDirection", (0.0, 0.0, 1.0)), float(height))
        shape = make("IfcShapeRepresentation", context, "Body", "SweptSolid", [solid])
        return make("IfcProductDefinitionShape", None, None, [shape])

    def product(kind: str, name: str, outline: list[tuple[float, float]], z: float, height: float, **more: object) -> object:
        place = make("IfcLocalPlacement", None, origin)
        return make(kind, guid.new(), Name=name, ObjectPlacement=place, Representation=body(outline, z, height), **more)

    def rectangle(x: float, y: float, dx: float, dy: float) -> list[tuple[float, float]]:
        return [(x, y), (x + dx, y), (x + dx, y + dy), (x, y + dy)]

    upper, lower = (make("IfcBuildingStorey", guid.new(), Name=n) for n in ("upper", "lower"))
    make("IfcRelAggregates", guid.new(), RelatingObject=project, RelatedObjects=[upper, lower])
    shape_l = [(4200, 0), (8200, 0), (8200, 1500), (6200, 1500), (6200, 3000), (4200, 3000)]
    office = product("IfcSpace", "1", rectangle(0, 0, 4000, 3000), 0, 2500, LongName="Office")
    hall = product("IfcSpace", "2", shape_l, 0, 2500, LongName="Hall")
    attic = product("IfcSpace", "3", rectangle(0, 0, 4000, 3000), 2800, 2000, LongName="Attic")
    make("IfcRelAggregates", guid.new(), RelatingObject=lower, RelatedObjects=[office, hall])
    make("IfcRelAggregates", guid.new(), RelatingObject=upper, RelatedObjects=[attic])
    product("IfcWall", "wall", rectangle(4000, 0, 200, 3000), 0, 2500)
    if slab:
        product("IfcSlab", "slab", rectangle(0, 0, 8200, 3000), -200, 200)
    product("IfcDoor", "door", rectangle(4000, 4000, 200, 900), 0, 2000)
    model.write(str(path))


def write_octomap(path: Path, nodes: bytes, count: int) -> None:
    path.write_bytes(OCTOMAP_HEADER % count + nodes)


FULL_OCTOMAP_HEADER = b"# Octomap OcTree file\n# a comment\nid OcTree\nsize 18\nres 0.1\ndata\n"


def full_node(odds: float, children: int, more: bytes = b"") -> bytes:
    """A node of a full OctoMap: log-odds, perhaps a colour, and a bit for each child that follows."""
    return struct.pack("<f", odds) + more + bytes([children])


def octomap_node(states: list[int]) -> bytes:
    """Two bytes of the states (0 unknown, 1 free, 2 occupied, 3 inner) of eight children."""
    return sum(s << (2 * i) for i, s in enumerate(states)).to_bytes(2, "little")


def write_plan(path: Path) -> None:
    """A map_server yaml and its pgm of 40 x 30 pixels: a free room with walls around it, unknown outside."""
    pixels = np.full((30, 40), 205, np.uint8)
    pixels[5:25, 5:35] = 0
    pixels[6:24, 6:34] = 254
    path.with_suffix(".pgm").write_bytes(b"P5\n40 30\n255\n" + pixels.tobytes())
    path.write_text(
        f"image: {path.stem}.pgm\nresolution: 0.1\norigin: [-2.0, -1.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def write_all(folder: Path) -> dict[str, Path]:
    """Name -> a small file of every format, in a folder."""
    import trimesh

    points, colors = box_points(), box_colors()
    names = (
        "ascii.ply little.ply big.ply mesh.ply ascii.pcd binary.pcd packed.pcd table.xyz table.csv array.npz array.npy "
        "cloud.las cloud.laz cloud.e57 mesh.obj mesh.stl mesh.glb mesh.gltf tree.bt model.ifc plan.yaml"
    )
    found = {name: folder / name for name in names.split()}
    write_ply(found["ascii.ply"], points, colors, text=True, order="=", kind="f4")
    write_ply(found["little.ply"], points, colors, text=False, order="<", kind="f4")
    write_ply(found["big.ply"], points, colors, text=False, order=">", kind="f8")
    write_pcd(found["ascii.pcd"], points, colors, ascii=True, compressed=False)
    write_pcd(found["binary.pcd"], points, colors, ascii=False, compressed=False)
    write_pcd(found["packed.pcd"], points, colors, ascii=False, compressed=True)
    np.savetxt(found["table.xyz"], points, fmt="%.6f")
    np.savetxt(found["table.csv"], np.hstack([points, colors]), fmt="%.6f", delimiter=",", header="x,y,z,r,g,b", comments="")
    np.savez_compressed(found["array.npz"], points=points, colors=colors)
    np.save(found["array.npy"], points)
    write_las(found["cloud.las"], points, colors)
    write_las(found["cloud.laz"], points, colors)
    turned = np.array([np.cos(0.4), 0, 0, np.sin(0.4)])
    write_e57(found["cloud.e57"], [(points, turned, np.array([1.0, 2.0, 0.5]))] * 2, colors)
    box = trimesh.creation.box((4, 3, 2.5))
    for suffix in ("ply", "obj", "stl", "glb"):
        box.export(str(found[f"mesh.{suffix}"]))
    (folder / "gltf").mkdir()
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(box), embed_buffers=True).items():
        found["mesh.gltf"].with_name("mesh.gltf" if name.endswith(".gltf") else name).write_bytes(data)
    leaf = octomap_node([2, 2, 2, 1, 1, 0, 0, 2])
    path_down = octomap_node([3, 0, 0, 0, 0, 0, 0, 0])
    write_octomap(found["tree.bt"], path_down * 15 + leaf, 22)
    write_ifc(found["model.ifc"])
    write_plan(found["plan.yaml"])
    return found
