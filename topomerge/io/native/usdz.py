"""USDZ of iPhones and iPads placed: its layers, meshes and pictures as they were, under one more transform.

One file keeps its prims where they stand: the outermost ones get a transform in front of their own, in the root layer, and all
other files of the package stay to the byte. Several files lie in folders of one package, below a new root layer that refers to
all of their root prims. Units and axes may differ. The library (usd-core) is in a process of its own, as in the reader, and
nothing is taken in that is not in the packages. Source: the USDZ specification of Pixar (archives that are not packed, files at
multiples of 64 bytes).
"""

from __future__ import annotations

import posixpath
import re
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io import usdz
from topomerge.io.native import Doubt, Source, Tally
from topomerge.io.piece import ReadOptions, build_damage_error, compute_in_subprocess
from topomerge.types import Array

KIND = usdz.KIND
SECONDS, MEMORY = 120, 4 << 30  # of the processor, and bytes
PLACED = "xformOp:transform:topomerge"  # the transform in front of a prim's own
ORDER, RESET = "xformOpOrder", "!resetXformStack!"
ROOT = "Joined"
PREFIX = "scan_of_"  # of the prims around joined files: no name that RoomPlan gives to a part
SPACING = 0.25  # m between points that tell how a bent map is placed best


@dataclass(frozen=True, eq=False)
class _Package:
    """An opened file: the names in it, of which the first is the root layer; its stage; and (4, 4), which takes places of that
    into metres with z up."""

    path: Path
    names: tuple[str, ...]
    stage: Any
    frame: Array

    def build_transform(self, motion: Array, into: Array) -> Any:
        """Build the transform, of row vectors, that takes places of the stage where a motion in metres takes them."""
        from pxr import Gf

        return Gf.Matrix4d((np.linalg.inv(into) @ motion @ self.frame).T.tolist())


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write one file placed, or several in one.

    Raises:
        InputError: one is damaged, or usd-core is missing.
    """
    del doubt
    if find_spec("pxr") is None:
        raise InputError(f"{sources[0].path}: writing {KIND} needs usd-core: pip install topomerge[usd]")
    for source in sources:
        usdz.check_package(source.path)
    placed = [_fit_rigid(source) for source in sources]
    task = {
        "sources": [{"path": str(s.path), "matrix": m.tolist()} for s, (m, _) in zip(sources, placed, strict=True)],
        "target": str(target),
    }
    counts = compute_in_subprocess("native.usdz", KIND, sources[0].path, task, SECONDS, MEMORY)
    usdz.check_package(target)
    return Tally({name: (before, after) for name, (before, after) in counts.items()}, tuple(w for _, w in placed if w))


def _fit_rigid(source: Source) -> tuple[Array, str]:
    """Return the transform of a file, of a bent map the one that comes nearest to the bent points, and a warning of how near."""
    motion = source.motion
    if motion.warp is None:
        return motion.matrix, ""
    points = np.concatenate([piece.points for piece in usdz.read(source.path, ReadOptions(spacing=SPACING))])
    bent = motion.move_points(points)
    middle, aim = points.mean(axis=0), bent.mean(axis=0)
    u, _, v = np.linalg.svd((bent - aim).T @ (points - middle))
    matrix = np.eye(4)
    matrix[:3, :3] = motion.scale * u @ np.diag((1, 1, np.sign(np.linalg.det(u @ v)))) @ v
    matrix[:3, 3] = aim - matrix[:3, :3] @ middle
    off = float(np.linalg.norm(points @ matrix[:3, :3].T + matrix[:3, 3] - bent, axis=1).max())
    return matrix, f"{source.path}: its map is bent; it is placed as a whole, up to {off:.2f} m beside the bent map"


def compute_in_process(task: Mapping[str, Any]) -> dict[str, tuple[int, int]]:
    """Write the file in this process, which the library may end; return counts of what is in the sources and in the file.

    Raises:
        InputError: a source is damaged.
    """
    from pxr import Usd

    target = Path(task["target"])
    packages = [_open_package(Path(source["path"])) for source in task["sources"]]
    motions = [np.array(source["matrix"]) for source in task["sources"]]
    before: Counter[str] = sum((_count_parts(p.path, p.stage) for p in packages), Counter())
    with tempfile.TemporaryDirectory(dir=target.parent) as name:
        folder = Path(name)
        write = _place_one if len(packages) == 1 else _join_many
        files = write(packages, motions, folder)
        _write_package(folder, files, target)
    packages.clear()
    after = _count_parts(target, Usd.Stage.Open(str(target)))
    return {kind: (before[kind], after[kind]) for kind in ("meshes", "objects")}


def _open_package(path: Path) -> _Package:
    stage = usdz.open_stage(path)
    with zipfile.ZipFile(path) as archive:
        names = tuple(entry.filename for entry in archive.infolist() if not entry.is_dir())
    if len({name.lower() for name in names}) < len(names):
        raise build_damage_error(path, KIND, "two files of one name in it")
    return _Package(path, names, stage, usdz.build_stage_frame(path, stage))


def _count_parts(path: Path, stage: Any) -> Counter[str]:
    """Count meshes, and those that are objects of RoomPlan."""
    from pxr import Usd, UsdGeom

    counts: Counter[str] = Counter()
    for number, prim in enumerate(stage.Traverse(Usd.TraverseInstanceProxies())):
        if number > usdz.MOST_PRIMS:
            raise build_damage_error(path, KIND, f"more than {usdz.MOST_PRIMS:,} prims")
        if prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdGeom.Cube):
            category = usdz.find_category(prim)
            counts["meshes"] += 1
            counts["objects"] += bool(category) and category not in usdz.PLAIN
    return counts


def _place_one(packages: Sequence[_Package], motions: Sequence[Array], folder: Path) -> list[tuple[Path, str]]:
    """Unpack a package and place its outermost prims in its root layer; return its files with their names."""
    from pxr import Sdf

    (package,) = packages
    files = _unpack(package, folder)
    layer = Sdf.Layer.FindOrOpen(str(files[0][0]))
    transform = package.build_transform(motions[0], package.frame)
    for prim, _ in list(_iter_outermost(package)):
        _place_prim(layer, prim, prim.GetPath(), transform)
    layer.Save()
    return files


def _join_many(packages: Sequence[_Package], motions: Sequence[Array], folder: Path) -> list[tuple[Path, str]]:
    """Unpack packages into folders, and write a root layer that refers to them; return all files with their names."""
    from pxr import Gf, Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(folder / f"{ROOT}.usda"))
    first = packages[0].stage
    UsdGeom.SetStageUpAxis(stage, UsdGeom.GetStageUpAxis(first))
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.GetStageMetersPerUnit(first))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, f"/{ROOT}").GetPrim())
    taken: set[str] = set()
    files = [(folder / f"{ROOT}.usda", f"{ROOT}.usda")]
    for package, motion in zip(packages, motions, strict=True):
        name = _choose_name(package.path, taken)
        inside = [(path, f"{name}/{inner}") for path, inner in _unpack(package, folder / name)]
        _anchor_assets(package, folder / name)
        files += inside
        transform = package.build_transform(motion, packages[0].frame)
        group = UsdGeom.Xform.Define(stage, f"/{ROOT}/{name}")
        group.AddTransformOp().Set(Gf.Matrix4d(transform))
        for prim in package.stage.GetPseudoRoot().GetAllChildren():
            if prim.IsDefined() and not prim.IsAbstract():
                child = stage.DefinePrim(group.GetPath().AppendChild(prim.GetName()))
                child.GetReferences().AddReference(f"./{name}/{package.names[0]}", prim.GetPath())
        layer = stage.GetRootLayer()
        for prim, reset in list(_iter_outermost(package)):
            if reset:
                _place_prim(layer, prim, _rebase(prim.GetPath(), group.GetPath()), transform)
        _retarget(package, stage, group.GetPath(), Sdf)
    stage.GetRootLayer().Save()
    return files


def _choose_name(path: Path, taken: set[str]) -> str:
    from pxr import Tf

    stem = PREFIX + Tf.MakeValidIdentifier(re.sub(r"[^A-Za-z0-9]+", "_", path.stem)[:60])
    name = next(n for k in range(1, len(taken) + 2) if (n := stem if k == 1 else f"{stem}_{k}").lower() not in taken)
    taken.add(name.lower())
    return name


def _unpack(package: _Package, folder: Path) -> list[tuple[Path, str]]:
    """Write the files of a package, whose names `usdz.check_package` has checked; return them with these."""
    with zipfile.ZipFile(package.path) as archive:
        try:
            return [(Path(archive.extract(name, folder)), name) for name in package.names]
        except (OSError, zipfile.BadZipFile) as error:
            raise build_damage_error(package.path, KIND, error) from error


def _iter_outermost(package: _Package) -> Iterator[tuple[Any, bool]]:
    """Yield the prims that no prim around them moves, and whether that is so because they say so."""
    from pxr import Usd, UsdGeom

    waiting = [(prim, False) for prim in package.stage.GetPseudoRoot().GetChildren()]
    while waiting:
        prim, moved = waiting.pop()
        shape = UsdGeom.Xformable(prim)
        reset = bool(shape) and shape.GetResetXformStack()
        if shape and (reset or not moved):
            if prim.IsInstanceProxy():
                text = f"{prim.GetName()[:40]!r} stands apart from all around it, in an instance"
                raise InputError(f"{package.path}: {text}, and can't be placed; export it without instances")
            yield prim, reset
        children = prim.GetFilteredChildren(Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
        waiting += [(child, moved or bool(shape)) for child in children]


def _place_prim(layer: Any, prim: Any, path: Any, transform: Any) -> None:
    """Put a transform in front of a prim's own, in a layer that is stronger than all that tell of it."""
    from pxr import Sdf, UsdGeom, Vt

    order = list(UsdGeom.Xformable(prim).GetXformOpOrderAttr().Get() or ())
    if PLACED in order:
        transform = prim.GetAttribute(PLACED).Get() * transform
    else:
        order.insert(order.index(RESET) + 1 if RESET in order else 0, PLACED)
    spec = Sdf.CreatePrimInLayer(layer, path)
    own = spec.attributes.get(PLACED) or Sdf.AttributeSpec(spec, PLACED, Sdf.ValueTypeNames.Matrix4d)
    own.default = transform
    listed = spec.attributes.get(ORDER) or Sdf.AttributeSpec(spec, ORDER, Sdf.ValueTypeNames.TokenArray, Sdf.VariabilityUniform)
    listed.default = Vt.TokenArray(order)


def _rebase(path: Any, group: Any) -> Any:
    """Return where a path of a file stands in the joined one."""
    return path.ReplacePrefix(path.absoluteRootPath, group) if path.IsAbsolutePath() else path


def _retarget(package: _Package, stage: Any, group: Any, sdf: Any) -> None:
    """State anew what prims name below other root prims, as materials: references to a prim do not carry that."""
    from pxr import Usd

    roots = [prim for prim in package.stage.GetPseudoRoot().GetAllChildren() if prim.IsDefined() and not prim.IsAbstract()]
    if len(roots) < 2:
        return
    for prim in package.stage.Traverse(Usd.PrimDefaultPredicate):
        top = prim.GetPath().GetPrefixes()[0]
        named = [(r, r.GetTargets()) for r in prim.GetRelationships()]
        named += [(a, a.GetConnections()) for a in prim.GetAttributes() if a.HasAuthoredConnections()]
        for item, targets in named:
            if all(target.HasPrefix(top) for target in targets):
                continue
            spec = sdf.CreatePrimInLayer(stage.GetRootLayer(), _rebase(prim.GetPath(), group))
            fresh = [_rebase(target, group) for target in targets]
            if isinstance(item, Usd.Relationship):
                sdf.RelationshipSpec(spec, item.GetName(), item.IsCustom()).targetPathList.explicitItems = fresh
            else:
                attribute = sdf.AttributeSpec(spec, item.GetName(), item.GetTypeName(), item.GetVariability(), item.IsCustom())
                attribute.connectionPathList.explicitItems = fresh


def _anchor_assets(package: _Package, folder: Path) -> None:
    """Name by their place beside a layer what it names by its place in the package, which lies in a folder now."""
    from pxr import Sdf, UsdUtils

    names = set(package.names)
    for name in package.names:
        if not name.lower().endswith(usdz.LAYERS[:3]):
            continue
        beside = posixpath.dirname(name)
        layer = Sdf.Layer.FindOrOpen(str(folder / name))
        changed: list[str] = []

        def anchor(asset: str, beside: str = beside, changed: list[str] = changed) -> str:
            if not asset or posixpath.normpath(posixpath.join(beside, asset)) in names or posixpath.normpath(asset) not in names:
                return asset
            changed.append(asset)
            fresh = posixpath.relpath(posixpath.normpath(asset), beside or ".")
            return fresh if fresh.startswith(".") else f"./{fresh}"

        if layer is not None:
            UsdUtils.ModifyAssetPaths(layer, anchor)
            if changed:
                layer.Save()


def _write_package(folder: Path, files: Sequence[tuple[Path, str]], target: Path) -> None:
    from pxr import Sdf

    with Sdf.ZipFileWriter.CreateNew(str(target)) as writer:
        for path, name in files:
            if not writer.AddFile(str(path), name):
                raise InputError(f"{target}: {name[:60]!r} can't be written into it; check the space on the disk")
