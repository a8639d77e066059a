"""A building model, IFC4: project, site, building, storeys, spaces, doors, stairs, and walls and floors as far as they were seen.

Spaces, floors and walls are extruded polygons; a door is a box of its clear opening, an opening without a door an
IfcVirtualElement, stairs and ramps an axis from their lower to their upper end. IfcRelSpaceBoundary says which spaces a door
joins. The site is placed where the map lies, so that all else has small coordinates. Source: ISO 16739-1, IFC4 ADD2 TC1.
"""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from topomerge.io.atomic import replacing
from topomerge.io.exports.floors import cell_polygons, floor_polygons, is_flight, room_levels
from topomerge.io.exports.markup import text
from topomerge.io.exports.occupancy import storey_occupancy
from topomerge.types import Array, TopometricMap

LEAF, SLAB = 0.1, 0.1  # m, thickness
LINTEL, HEIGHT = 2.0, 2.5  # m, of doors and storeys without anything seen above
LEAST_WALL = 0.03  # m2 seen from above: smaller pieces are legs of tables
STAMP = "1970-01-01T00:00:00"  # the same map gives the same bytes


def save(map: TopometricMap, path: Path) -> None:
    """Write the model, in metres in the input's frame.

    Raises:
        InputError: the path can't be written.
    """
    model = _Model(map)
    storeys = [model.storey(s) for s in range(len(map.storeys))]
    model.aggregate(model.building, storeys)
    floors, (levels, seen) = floor_polygons(map), room_levels(map)
    spaces = [model.space(r, floors[r], levels[r], bool(seen[r]), storeys) for r in range(len(map.rooms))]
    for s, storey in enumerate(storeys):
        here = np.flatnonzero(map.rooms["storey"] == s).tolist()
        model.aggregate(storey, [spaces[r] for r in here])
        built = [model.slab(r, floors[r], float(levels[r, 0]), storey) for r in here if not floors[r].is_empty]
        model.contain(storey, [*built, *model.walls(s, storey)])
    for i, edge in enumerate(map.edges):
        a, b = edge["rooms"].tolist()
        storey = storeys[int(map.rooms["storey"][[a, b]].min())]
        element = model.flight(i, edge, storey) if is_flight(edge) else model.door(i, edge, storey)
        model.contain(storey, [element])
        for r in (a, b):
            model.bound(i, spaces[r], element)
    with replacing(path) as beside:
        model.file.write(str(beside))


class _Model:
    """The file and what everything in it shares. Names of methods are what they make."""

    def __init__(self, map: TopometricMap) -> None:
        import ifcopenshell

        self.map = map
        self.file = ifcopenshell.file(schema="IFC4")
        head = self.file.header
        head.file_name.time_stamp, head.file_name.name = STAMP, "topomerge"
        head.file_name.preprocessor_version = head.file_name.originating_system = "topomerge"
        low = map.rooms["lo"].min(axis=0) if len(map.rooms) else map.grid.origin
        self.shift = np.floor(low / 100) * 100 if np.abs(low[:2]).max() > 1000 else np.zeros(3)
        self.shift[2] = 0.0
        self._context()
        self._frame()

    def new(self, kind: str, **values: Any) -> Any:
        """An entity."""
        return self.file.create_entity(kind, **values)

    def root(self, kind: str, name: str, **values: Any) -> Any:
        """An entity with a global id, made of its kind and name, which must be unique together."""
        import ifcopenshell.guid

        id = ifcopenshell.guid.compress(uuid.uuid5(uuid.NAMESPACE_URL, f"topomerge:{kind}:{name}").hex)
        return self.new(kind, GlobalId=id, **({} if kind.startswith("IfcRel") else {"Name": name}), **values)

    def _context(self) -> None:
        units = {"LENGTHUNIT": "METRE", "AREAUNIT": "SQUARE_METRE", "VOLUMEUNIT": "CUBIC_METRE", "PLANEANGLEUNIT": "RADIAN"}
        made = [self.new("IfcSIUnit", UnitType=unit, Name=name) for unit, name in units.items()]
        self.units = self.new("IfcUnitAssignment", Units=made)
        world = self.new("IfcAxis2Placement3D", Location=self.point(0, 0, 0))
        whole = {"ContextType": "Model", "CoordinateSpaceDimension": 3, "Precision": 1e-5, "WorldCoordinateSystem": world}
        self.context = self.new("IfcGeometricRepresentationContext", **whole)
        self.views = {
            name: self.new(
                "IfcGeometricRepresentationSubContext",
                ContextIdentifier=name,
                ContextType="Model",
                ParentContext=self.context,
                TargetView=view,
            )
            for name, view in (("Body", "MODEL_VIEW"), ("Axis", "GRAPH_VIEW"), ("FootPrint", "PLAN_VIEW"))
        }

    def _frame(self) -> None:
        self.project = self.root("IfcProject", "map", LongName=text(self.map.source)[:255], UnitsInContext=self.units)
        self.project.RepresentationContexts = [self.context]
        site = self.place(None, *self.shift)
        self.site = self.root("IfcSite", "site", ObjectPlacement=site, CompositionType="ELEMENT")
        building = self.place(site, 0, 0, 0)
        self.building = self.root("IfcBuilding", "building", ObjectPlacement=building, CompositionType="ELEMENT")
        self.aggregate(self.project, [self.site])
        self.aggregate(self.site, [self.building])

    def point(self, *values: float) -> Any:
        """A point of two or three coordinates."""
        return self.new("IfcCartesianPoint", Coordinates=[float(v) for v in values])

    def place(self, parent: Any, x: float, y: float, z: float, along: Any = None) -> Any:
        """A placement in that of `parent`, its x axis along a direction (2,)."""
        axes: dict[str, Any] = {"Location": self.point(x, y, z)}
        if along is not None:
            axes["Axis"] = self.new("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
            axes["RefDirection"] = self.new("IfcDirection", DirectionRatios=[float(along[0]), float(along[1]), 0.0])
        where = self.new("IfcAxis2Placement3D", **axes)
        return self.new("IfcLocalPlacement", PlacementRelTo=parent, RelativePlacement=where)

    def aggregate(self, whole: Any, parts: list[Any]) -> None:
        """Parts belong to a whole."""
        if parts:
            self.root("IfcRelAggregates", whole.GlobalId, RelatingObject=whole, RelatedObjects=parts)

    def contain(self, storey: Any, elements: list[Any]) -> None:
        """Elements stand on a storey."""
        if elements:
            name = f"{storey.GlobalId} {elements[0].GlobalId}"
            self.root("IfcRelContainedInSpatialStructure", name, RelatingStructure=storey, RelatedElements=elements)

    def shape(self, view: str, kind: str, items: list[Any]) -> Any:
        """What a product looks like; None where there is nothing to show."""
        if not items:
            return None
        body = self.new(
            "IfcShapeRepresentation",
            ContextOfItems=self.views[view],
            RepresentationIdentifier=view,
            RepresentationType=kind,
            Items=items,
        )
        return self.new("IfcProductDefinitionShape", Representations=[body])

    def prisms(self, floor: Any, low: float, height: float) -> Any:
        """Polygons of the input's frame drawn up from `low`, which counts from their storey."""
        up = self.new("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
        items = []
        for part in floor.geoms:
            outer, *inner = (self._ring(np.asarray(ring.coords)) for ring in (part.exterior, *part.interiors))
            kind = "IfcArbitraryProfileDefWithVoids" if inner else "IfcArbitraryClosedProfileDef"
            holes = {"InnerCurves": inner} if inner else {}
            profile = self.new(kind, ProfileType="AREA", OuterCurve=outer, **holes)
            at = self.new("IfcAxis2Placement3D", Location=self.point(0, 0, low))
            swept = {"SweptArea": profile, "Position": at, "ExtrudedDirection": up, "Depth": float(height)}
            items.append(self.new("IfcExtrudedAreaSolid", **swept))
        return self.shape("Body", "SweptSolid", items)

    def _ring(self, ring: Array) -> Any:
        corners = [self.point(*corner) for corner in np.round(ring[:-1] - self.shift[:2], 5).tolist()]
        return self.new("IfcPolyline", Points=[*corners, corners[0]])

    def storey(self, s: int) -> Any:
        """A storey, placed at its floor."""
        z = float(self.map.storeys["floor"][s])
        at = self.place(self.building.ObjectPlacement, 0, 0, z)
        return self.root("IfcBuildingStorey", f"storey {s}", ObjectPlacement=at, CompositionType="ELEMENT", Elevation=z)

    def space(self, r: int, floor: Any, level: Array, seen: bool, storeys: list[Any]) -> Any:
        """A room with its quantities."""
        room = self.map.rooms[r]
        storey = storeys[room["storey"]]
        low, high = (level - storey.Elevation).tolist()
        body = {
            "ObjectPlacement": self.place(storey.ObjectPlacement, 0, 0, 0),
            "Representation": self.prisms(floor, low, high - low),
        }
        space = self.root("IfcSpace", f"room {r}", CompositionType="ELEMENT", PredefinedType="INTERNAL", **body)
        quantities = [self.new("IfcQuantityArea", Name="GrossFloorArea", AreaValue=float(room["area"]))]
        if seen:
            quantities.append(self.new("IfcQuantityLength", Name="Height", LengthValue=float(room["height"])))
            quantities.append(self.new("IfcQuantityVolume", Name="GrossVolume", VolumeValue=float(room["volume"])))
        self._define(space, self._set("IfcElementQuantity", "Qto_SpaceBaseQuantities", r, Quantities=quantities))
        known = {"Completeness": ("IfcReal", float(room["completeness"])), "Glimpsed": ("IfcBoolean", bool(room["glimpsed"]))}
        facts = [self._fact(name, kind, value) for name, (kind, value) in known.items()]
        self._define(space, self._set("IfcPropertySet", "Topomerge_Room", r, HasProperties=facts))
        return space

    def _fact(self, name: str, kind: str, value: Any) -> Any:
        return self.new("IfcPropertySingleValue", Name=name, NominalValue=self.file.create_entity(kind, value))

    def _set(self, kind: str, name: str, number: int, **values: Any) -> Any:
        made = self.root(kind, f"{name} {number}", **values)
        made.Name = name
        return made

    def _define(self, product: Any, facts: Any) -> None:
        name = f"{product.GlobalId} {facts.GlobalId}"
        self.root("IfcRelDefinesByProperties", name, RelatedObjects=[product], RelatingPropertyDefinition=facts)

    def slab(self, r: int, floor: Any, z: float, storey: Any) -> Any:
        """The floor of a room."""
        body = self.prisms(floor, z - storey.Elevation - SLAB, SLAB)
        at = self.place(storey.ObjectPlacement, 0, 0, 0)
        return self.root("IfcSlab", f"floor {r}", ObjectPlacement=at, Representation=body, PredefinedType="FLOOR")

    def walls(self, s: int, storey: Any) -> list[Any]:
        """What was seen of the walls of a storey, a wall for each connected piece, as high as the storey."""
        plan, table = storey_occupancy(self.map, s), self.map.storeys[s]
        height = float(table["ceiling"] - table["floor"])
        height = height if height > 0 else HEIGHT  # nan: not seen
        pieces = cell_polygons(plan.wall, plan.low, plan.size, LEAST_WALL)
        found = []
        for k, piece in enumerate(pieces.geoms):
            body = {"Representation": self.prisms(shapely.MultiPolygon([piece]), 0.0, height), "PredefinedType": "NOTDEFINED"}
            at = self.place(storey.ObjectPlacement, 0, 0, 0)
            found.append(self.root("IfcWall", f"wall {s}.{k}", ObjectPlacement=at, **body))
        return found

    def door(self, i: int, edge: Any, storey: Any) -> Any:
        """A door as a box in its opening, or an opening without one as a line on the floor."""
        across = float(edge["direction"])
        along = np.array([-np.sin(across), np.cos(across)])
        width, height = float(edge["width"]), float(edge["height"])
        x, y, z = edge["centre"] - (*along * width / 2, 0) - self.shift - (0, 0, storey.Elevation)
        at = self.place(storey.ObjectPlacement, x, y, z, along)
        if edge["kind"] != "door":
            line = self.new("IfcPolyline", Points=[self.point(0, 0, 0), self.point(width, 0, 0)])
            shown = self.shape("FootPrint", "Curve3D", [line])
            return self.root("IfcVirtualElement", f"{edge['kind']} {i}", ObjectPlacement=at, Representation=shown)
        middle = self.new("IfcAxis2Placement2D", Location=self.point(width / 2, 0))
        box = self.new("IfcRectangleProfileDef", ProfileType="AREA", Position=middle, XDim=width, YDim=LEAF)
        up = self.new("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
        solid = self.new("IfcExtrudedAreaSolid", SweptArea=box, ExtrudedDirection=up, Depth=height or LINTEL)
        known = {"OverallWidth": width, "PredefinedType": "DOOR", "OperationType": "NOTDEFINED"}
        known |= {"OverallHeight": height} if height else {}
        body = self.shape("Body", "SweptSolid", [solid])
        return self.root("IfcDoor", f"door {i}", ObjectPlacement=at, Representation=body, **known)

    def flight(self, i: int, edge: Any, storey: Any) -> Any:
        """Stairs or a ramp."""
        low, high = (self.point(*(edge[end] - self.shift - (0, 0, storey.Elevation))) for end in ("lower", "upper"))
        axis = self.shape("Axis", "Curve3D", [self.new("IfcPolyline", Points=[low, high])])
        kind = "IfcRamp" if edge["kind"] == "ramp" else "IfcStair"
        at = self.place(storey.ObjectPlacement, 0, 0, 0)
        return self.root(kind, f"{edge['kind']} {i}", ObjectPlacement=at, Representation=axis, PredefinedType="NOTDEFINED")

    def bound(self, i: int, space: Any, element: Any) -> None:
        """A space is bounded by an element, which leads out of it."""
        known = {"RelatingSpace": space, "RelatedBuildingElement": element, "InternalOrExternalBoundary": "INTERNAL"}
        kind = "VIRTUAL" if element.is_a("IfcVirtualElement") else "PHYSICAL"
        self.root("IfcRelSpaceBoundary", f"{i} {space.GlobalId}", PhysicalOrVirtualBoundary=kind, **known)
