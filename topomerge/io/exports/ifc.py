"""Export a map as a building model (IFC)."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from topomerge.archive import replace_on_success
from topomerge.io.exports import replace_forbidden
from topomerge.io.listing import describe_room
from topomerge.structure.floors import is_flight, measure_room_levels
from topomerge.structure.plan_structure import build_plan_structure
from topomerge.structure.walls import build_wall_polygon
from topomerge.types import LANDMARK_KINDS, ROOM_ODDS, Array, TopometricMap, find_room_names

STAMP = "1970-01-01T00:00:00"  # the same map gives the same bytes


class Model:
    """A file with a project, a site and a building. Names of methods are what they make.

    Attributes:
        map, names: the map that it is made of, and the names of its rooms.
        file: the model of ifcopenshell.
        shift: (3,) m, where the site stands in the input's frame; all else counts from there.
        site, building: entities.
    """

    def __init__(self, map: TopometricMap) -> None:
        import ifcopenshell

        self.map, self.names = map, find_room_names(map.landmarks, len(map.rooms))
        self.file = ifcopenshell.file(schema="IFC4")
        head = self.file.header
        head.file_name.time_stamp, head.file_name.name = STAMP, "topomerge"
        head.file_name.preprocessor_version = head.file_name.originating_system = "topomerge"
        low = map.rooms["lo"].min(axis=0) if len(map.rooms) else map.grid.origin
        self.shift = np.floor(low / 100) * 100 if np.abs(low[:2]).max() > 1000 else np.zeros(3)
        self.shift[2] = 0.0
        self._create_context()
        self._create_project()

    def create(self, kind: str, **values: Any) -> Any:
        """Create an entity."""
        return self.file.create_entity(kind, **values)

    def create_rooted(self, kind: str, name: str, **values: Any) -> Any:
        """Create an entity with a global id, made of its kind and name, which must be unique together."""
        import ifcopenshell.guid

        id = ifcopenshell.guid.compress(uuid.uuid5(uuid.NAMESPACE_URL, f"topomerge:{kind}:{name}").hex)
        return self.create(kind, GlobalId=id, **({} if kind.startswith("IfcRel") else {"Name": name}), **values)

    def _create_context(self) -> None:
        units = {"LENGTHUNIT": "METRE", "AREAUNIT": "SQUARE_METRE", "VOLUMEUNIT": "CUBIC_METRE", "PLANEANGLEUNIT": "RADIAN"}
        si_units = [self.create("IfcSIUnit", UnitType=unit, Name=name) for unit, name in units.items()]
        self.units = self.create("IfcUnitAssignment", Units=si_units)
        world = self.create("IfcAxis2Placement3D", Location=self.create_point(0, 0, 0))
        attributes = {"ContextType": "Model", "CoordinateSpaceDimension": 3, "Precision": 1e-5, "WorldCoordinateSystem": world}
        self.context = self.create("IfcGeometricRepresentationContext", **attributes)
        self.views = {
            name: self.create(
                "IfcGeometricRepresentationSubContext",
                ContextIdentifier=name,
                ContextType="Model",
                ParentContext=self.context,
                TargetView=view,
            )
            for name, view in (("Body", "MODEL_VIEW"), ("Axis", "GRAPH_VIEW"), ("FootPrint", "PLAN_VIEW"))
        }

    def _create_project(self) -> None:
        self.project = self.create_rooted(
            "IfcProject", "map", LongName=replace_forbidden(self.map.source)[:255], UnitsInContext=self.units
        )
        self.project.RepresentationContexts = [self.context]
        site = self.create_placement(None, *self.shift)
        self.site = self.create_rooted("IfcSite", "site", ObjectPlacement=site, CompositionType="ELEMENT")
        building = self.create_placement(site, 0, 0, 0)
        self.building = self.create_rooted("IfcBuilding", "building", ObjectPlacement=building, CompositionType="ELEMENT")
        self.aggregate(self.project, [self.site])
        self.aggregate(self.site, [self.building])

    def create_point(self, *values: float) -> Any:
        """Create a point of two or three coordinates."""
        return self.create("IfcCartesianPoint", Coordinates=[float(v) for v in values])

    def create_placement(self, parent: Any, x: float, y: float, z: float, along: Any = None) -> Any:
        """Create a placement in that of `parent`, its x axis along a direction (2,)."""
        axes: dict[str, Any] = {"Location": self.create_point(x, y, z)}
        if along is not None:
            axes["Axis"] = self.create("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
            axes["RefDirection"] = self.create("IfcDirection", DirectionRatios=[float(along[0]), float(along[1]), 0.0])
        where = self.create("IfcAxis2Placement3D", **axes)
        return self.create("IfcLocalPlacement", PlacementRelTo=parent, RelativePlacement=where)

    def aggregate(self, parent: Any, parts: list[Any]) -> None:
        """Add the relation of parts to the whole that they belong to."""
        if parts:
            self.create_rooted("IfcRelAggregates", parent.GlobalId, RelatingObject=parent, RelatedObjects=parts)

    def contain(self, storey: Any, elements: list[Any]) -> None:
        """Add the relation of elements to the storey that they stand on."""
        if elements:
            name = f"{storey.GlobalId} {elements[0].GlobalId}"
            self.create_rooted("IfcRelContainedInSpatialStructure", name, RelatingStructure=storey, RelatedElements=elements)

    def create_representation(self, name: str, kind: str, items: list[Any]) -> Any:
        """Create a body, an axis or a footprint."""
        attributes = {"RepresentationIdentifier": name, "RepresentationType": kind, "Items": items}
        return self.create("IfcShapeRepresentation", ContextOfItems=self.views[name], **attributes)

    def create_shape(self, name: str, kind: str, items: list[Any]) -> Any:
        """Create the shape of a product; None where there is nothing to show."""
        return (
            self.create("IfcProductDefinitionShape", Representations=[self.create_representation(name, kind, items)])
            if items
            else None
        )

    def extrude_polygons(self, floor: Any, low: float, height: float) -> Any:
        """Extrude polygons of the input's frame up from `low`, which counts from their storey."""
        up = self.create("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
        items = []
        for part in floor.geoms:
            outer, *inner = (self._create_polyline(np.asarray(ring.coords)) for ring in (part.exterior, *part.interiors))
            kind = "IfcArbitraryProfileDefWithVoids" if inner else "IfcArbitraryClosedProfileDef"
            holes = {"InnerCurves": inner} if inner else {}
            profile = self.create(kind, ProfileType="AREA", OuterCurve=outer, **holes)
            at = self.create("IfcAxis2Placement3D", Location=self.create_point(0, 0, low))
            swept = {"SweptArea": profile, "Position": at, "ExtrudedDirection": up, "Depth": float(height)}
            items.append(self.create("IfcExtrudedAreaSolid", **swept))
        return self.create_shape("Body", "SweptSolid", items)

    def _create_polyline(self, ring: Array) -> Any:
        corners = [self.create_point(*corner) for corner in np.round(ring[:-1] - self.shift[:2], 5).tolist()]
        return self.create("IfcPolyline", Points=[*corners, corners[0]])


LEAF_THICKNESS, IFC_SLAB, CEILING_THICKNESS = 0.1, 0.1, 0.05  # m, thickness
IFC_LINTEL = 2.0  # m, of doors without anything seen above
LEAST_VOID = 0.05  # m, height of an opening at least
CUT_THROUGH = 0.05  # m by which the body of an opening stands out of its wall, so that nothing of that stays


def save(map: TopometricMap, path: Path) -> None:
    """Write the model, in metres in the input's frame.

    Raises:
        InputError: the path can't be written.
    """
    model = _BuildingModel(map)
    storeys = [model.add_storey(s) for s in range(len(map.storeys))]
    model.aggregate(model.building, storeys)
    structure, (levels, seen) = build_plan_structure(map), measure_room_levels(map)
    floors = structure.rooms
    spaces = [model.add_space(r, floors[r], levels[r], bool(seen[r]), storeys) for r in range(len(map.rooms))]
    for s, storey in enumerate(storeys):
        rooms = np.flatnonzero(map.rooms["storey"] == s).tolist()
        model.aggregate(storey, [spaces[r] for r in rooms])
        rooms = [r for r in rooms if not floors[r].is_empty]
        built = [model.add_slab(r, floors[r], float(levels[r, 0]), storey) for r in rooms]
        built += [model.add_ceiling(r, floors[r], float(levels[r, 1]), storey) for r in rooms if seen[r]]
        model.contain(storey, built)
    walls = [model.add_wall(k, wall, storeys[wall["storey"]]) for k, wall in enumerate(structure.walls)]
    for s, storey in enumerate(storeys):
        model.contain(storey, [walls[k] for k in np.flatnonzero(structure.walls["storey"] == s)])
    openings = {int(opening["edge"]): opening for opening in structure.openings}
    for i, edge in enumerate(map.edges):
        a, b = edge["rooms"].tolist()
        storey = storeys[int(map.rooms["storey"][[a, b]].min())]
        element = model.add_flight(i, edge, storey) if is_flight(edge) else model.add_door(i, openings[i], storey)
        if i in openings and (k := int(openings[i]["wall"])) >= 0:
            model.add_opening(openings[i], structure.walls[k], walls[k], element)
        model.contain(storey, [element])
        model.add_edge_properties(i, edge, element)
        for r, other in ((a, b), (b, a)):
            model.add_boundary(i, spaces[r], element, spaces[other].PredefinedType)
    for k, pane in enumerate(structure.windows):
        rooms = [r for r in map.windows["rooms"][k].tolist() if r >= 0]
        storey = storeys[int(map.rooms["storey"][rooms[0]])]
        element = model.add_window(k, pane, storey)
        if (w := int(pane["wall"])) >= 0:
            model.add_window_opening(k, pane, structure.walls[w], walls[w], element)
        model.contain(storey, [element])
        for n, r in enumerate(rooms):
            side = spaces[rooms[1 - n]].PredefinedType if len(rooms) > 1 else "NOTDEFINED"
            model.add_boundary(f"window {k}", spaces[r], element, side)
    for storey in range(len(storeys)):
        model.contain(storeys[storey], [model.add_annotation(k, storeys[storey]) for k in model.list_annotated(storey)])
    with replace_on_success(path) as temporary:
        model.file.write(str(temporary))


class _BuildingModel(Model):
    """A building in the model. Names of methods are what they make."""

    def add_storey(self, s: int) -> Any:
        """Return a storey, placed at its floor."""
        z = float(self.map.storeys["floor"][s])
        at = self.create_placement(self.building.ObjectPlacement, 0, 0, z)
        return self.create_rooted("IfcBuildingStorey", f"storey {s}", ObjectPlacement=at, CompositionType="ELEMENT", Elevation=z)

    def add_space(self, r: int, floor: Any, level: Array, seen: bool, storeys: list[Any]) -> Any:
        """Return a room with its quantities."""
        room = self.map.rooms[r]
        storey = storeys[room["storey"]]
        low, high = (level - storey.Elevation).tolist()
        body = {
            "ObjectPlacement": self.create_placement(storey.ObjectPlacement, 0, 0, 0),
            "Representation": self.extrude_polygons(floor, low, high - low),
        }
        side = "EXTERNAL" if "outside" in describe_room(room) else "INTERNAL"
        if self.names[r]:
            body["LongName"] = replace_forbidden(self.names[r])
        space = self.create_rooted("IfcSpace", f"room {r}", CompositionType="ELEMENT", PredefinedType=side, **body)
        quantities = [self.create("IfcQuantityArea", Name="GrossFloorArea", AreaValue=float(room["area"]))]
        if seen:
            quantities.append(self.create("IfcQuantityLength", Name="Height", LengthValue=float(room["height"])))
            quantities.append(self.create("IfcQuantityVolume", Name="GrossVolume", VolumeValue=float(room["volume"])))
        self._define(space, self._set("IfcElementQuantity", "Qto_SpaceBaseQuantities", r, Quantities=quantities))
        values = {"Completeness": ("IfcReal", float(room["completeness"])), "Glimpsed": ("IfcBoolean", bool(room["glimpsed"]))}
        values |= {name.title(): ("IfcReal", float(room[name])) for name in ROOM_ODDS}
        properties = [self._create_property(name, kind, value) for name, (kind, value) in values.items()]
        self._define(space, self._set("IfcPropertySet", "Topomerge_Room", r, HasProperties=properties))
        return space

    def _create_property(self, name: str, kind: str, value: Any) -> Any:
        return self.create("IfcPropertySingleValue", Name=name, NominalValue=self.file.create_entity(kind, value))

    def _set(self, kind: str, name: str, number: int, **values: Any) -> Any:
        property_set = self.create_rooted(kind, f"{name} {number}", **values)
        property_set.Name = name
        return property_set

    def _define(self, product: Any, properties: Any) -> None:
        name = f"{product.GlobalId} {properties.GlobalId}"
        self.create_rooted("IfcRelDefinesByProperties", name, RelatedObjects=[product], RelatingPropertyDefinition=properties)

    def add_slab(self, r: int, floor: Any, z: float, storey: Any) -> Any:
        """Return the floor of a room."""
        body = self.extrude_polygons(floor, z - storey.Elevation - IFC_SLAB, IFC_SLAB)
        at = self.create_placement(storey.ObjectPlacement, 0, 0, 0)
        return self.create_rooted("IfcSlab", f"floor {r}", ObjectPlacement=at, Representation=body, PredefinedType="FLOOR")

    def add_ceiling(self, r: int, floor: Any, z: float, storey: Any) -> Any:
        """Return the ceiling of a room in which one was seen."""
        body = self.extrude_polygons(floor, z - storey.Elevation, CEILING_THICKNESS)
        at = self.create_placement(storey.ObjectPlacement, 0, 0, 0)
        return self.create_rooted(
            "IfcCovering", f"ceiling {r}", ObjectPlacement=at, Representation=body, PredefinedType="CEILING"
        )

    def add_wall(self, k: int, wall: Any, storey: Any) -> Any:
        """Return a wall with what is known of it."""
        low, high = (float(wall[name]) - storey.Elevation for name in ("low", "high"))
        at = self.create_placement(storey.ObjectPlacement, 0, 0, 0)
        body = {
            "ObjectPlacement": at,
            "Representation": self.extrude_polygons(shapely.MultiPolygon([build_wall_polygon(wall)]), low, high - low),
        }
        element = self.create_rooted("IfcWall", f"wall {k}", PredefinedType="NOTDEFINED", **body)
        properties = [self._create_property("FacesSeen", "IfcInteger", int(wall["faces"]))]
        self._define(element, self._set("IfcPropertySet", "Topomerge_Wall", k, HasProperties=properties))
        sizes = {"Length": float(np.hypot(*(wall["end"] - wall["start"])))}
        if wall["faces"] == 2:  # else its thickness is a guess
            sizes["Width"] = float(wall["thickness"])
        quantities = [self.create("IfcQuantityLength", Name=name, LengthValue=value) for name, value in sizes.items()]
        self._define(element, self._set("IfcElementQuantity", "Qto_WallBaseQuantities", k, Quantities=quantities))
        return element

    def add_opening(self, opening: Any, wall: Any, voided: Any, door: Any) -> None:
        """Add an opening to a wall, which a door fills."""
        low = float(opening["centre"][2])
        span = low, float(opening["height"]) or IFC_LINTEL
        element = self._cut_wall(f"opening {opening['edge']}", build_wall_polygon(wall, opening, CUT_THROUGH), wall, span, voided)
        if door.is_a("IfcDoor"):
            self.create_rooted(
                "IfcRelFillsElement", element.GlobalId, RelatingOpeningElement=element, RelatedBuildingElement=door
            )

    def add_window_opening(self, k: int, pane: Any, wall: Any, voided: Any, window: Any) -> None:
        """Add the hole in a wall that a window fills."""
        low = float(pane["centre"][2] + pane["sill"])
        span = low, float(pane["head"] - pane["sill"])
        element = self._cut_wall(f"pane {k}", build_wall_polygon(wall, pane, CUT_THROUGH), wall, span, voided)
        self.create_rooted("IfcRelFillsElement", element.GlobalId, RelatingOpeningElement=element, RelatedBuildingElement=window)

    def _cut_wall(self, name: str, outline: Any, wall: Any, span: tuple[float, float], voided: Any) -> Any:
        """Cut a hole into a wall; `span`: where it begins, m in the input's frame, and its height, at most up to the wall's
        top."""
        low, height = span
        storey_height = float(self.map.storeys["floor"][wall["storey"]])
        top = min(low + height, float(wall["high"]) + CUT_THROUGH)
        low = min(low, top - LEAST_VOID)  # of what begins above the top of its wall, as far as that was seen
        height = top - low
        shape = shapely.MultiPolygon([outline])
        body = {"Representation": self.extrude_polygons(shape, low - storey_height, height), "PredefinedType": "OPENING"}
        at = self.create_placement(voided.ObjectPlacement, 0, 0, 0)
        element = self.create_rooted("IfcOpeningElement", name, ObjectPlacement=at, **body)
        self.create_rooted("IfcRelVoidsElement", element.GlobalId, RelatingBuildingElement=voided, RelatedOpeningElement=element)
        return element

    def add_door(self, i: int, opening: Any, storey: Any) -> Any:
        """Return a door as a box in its opening, or an opening without one as a line on the floor."""
        across = float(opening["direction"])
        along = np.array([-np.sin(across), np.cos(across)])
        width, height = float(opening["width"]), float(opening["height"])
        x, y, z = opening["centre"] - (*along * width / 2, 0) - self.shift - (0, 0, storey.Elevation)
        at = self.create_placement(storey.ObjectPlacement, x, y, z, along)
        if opening["kind"] != "door":
            line = self.create("IfcPolyline", Points=[self.create_point(0, 0, 0), self.create_point(width, 0, 0)])
            shown = self.create_shape("FootPrint", "Curve3D", [line])
            return self.create_rooted("IfcVirtualElement", f"{opening['kind']} {i}", ObjectPlacement=at, Representation=shown)
        attributes = {"OverallWidth": width, "PredefinedType": "DOOR", "OperationType": "NOTDEFINED"}
        attributes |= {"OverallHeight": height} if height else {}
        body = self._create_box(width, height or IFC_LINTEL)
        return self.create_rooted("IfcDoor", f"door {i}", ObjectPlacement=at, Representation=body, **attributes)

    def add_edge_properties(self, i: int, edge: Any, element: Any) -> None:
        """Tell how likely a door, an opening or a flight is one, and whether one could walk through."""
        properties = [self._create_property("Confidence", "IfcReal", float(edge["confidence"]))]
        properties += [self._create_property(name, "IfcBoolean", bool(edge[name.lower()])) for name in ("Open", "Half")]
        self._define(element, self._set("IfcPropertySet", f"Topomerge_{str(edge['kind']).title()}", i, HasProperties=properties))

    def _create_box(self, width: float, height: float) -> Any:
        """Create the box of a leaf or pane, which fills an opening or stands before a wall: along x from 0, y to both sides."""
        middle = self.create("IfcAxis2Placement2D", Location=self.create_point(width / 2, 0))
        box = self.create("IfcRectangleProfileDef", ProfileType="AREA", Position=middle, XDim=width, YDim=LEAF_THICKNESS)
        up = self.create("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
        solid = self.create("IfcExtrudedAreaSolid", SweptArea=box, ExtrudedDirection=up, Depth=height)
        return self.create_shape("Body", "SweptSolid", [solid])

    def add_window(self, k: int, pane: Any, storey: Any) -> Any:
        """Return a window as a box in its opening, on its sill, and what was seen of it."""
        across, width, height = float(pane["direction"]), float(pane["width"]), float(pane["head"] - pane["sill"])
        along = np.array([-np.sin(across), np.cos(across)])
        x, y, z = pane["centre"] - (*along * width / 2, 0) - self.shift + (0, 0, pane["sill"] - storey.Elevation)
        sizes = {"OverallWidth": width, "OverallHeight": height, "PredefinedType": "WINDOW"}
        body = {
            "ObjectPlacement": self.create_placement(storey.ObjectPlacement, x, y, z, along),
            "Representation": self._create_box(width, height),
        }
        element = self.create_rooted("IfcWindow", f"window {k}", PartitioningType="NOTDEFINED", **sizes, **body)
        seen = self.map.windows[k]
        properties = [self._create_property("Confidence", "IfcReal", float(seen["confidence"]))]
        properties += [
            self._create_property(f"{end.title()}Seen", "IfcBoolean", bool(np.isfinite(seen[end]))) for end in ("sill", "head")
        ]
        self._define(element, self._set("IfcPropertySet", "Topomerge_Window", k, HasProperties=properties))
        return element

    def add_flight(self, i: int, edge: Any, storey: Any) -> Any:
        """Add stairs or a ramp, as a sloping plate."""
        low, high = (edge[end] - self.shift - (0, 0, storey.Elevation) for end in ("lower", "upper"))
        views = [
            self.create_representation(
                "Axis", "Curve3D", [self.create("IfcPolyline", Points=[self.create_point(*low), self.create_point(*high)])]
            )
        ]
        run = float(np.hypot(*(high - low)[:2]))
        if run > LEAF_THICKNESS:
            views.append(
                self.create_representation("Body", "SweptSolid", [self._create_plate(low, high, run, float(edge["width"]))])
            )
        kind = "IfcRamp" if edge["kind"] == "ramp" else "IfcStair"
        at = self.create_placement(storey.ObjectPlacement, 0, 0, 0)
        shape = self.create("IfcProductDefinitionShape", Representations=views)
        return self.create_rooted(
            kind, f"{edge['kind']} {i}", ObjectPlacement=at, Representation=shape, PredefinedType="NOTDEFINED"
        )

    def _create_plate(self, low: Array, high: Array, run: float, width: float) -> Any:
        """Create a parallelogram that stands upright along the flight, drawn out sideways."""
        ahead = (high - low)[:2] / run
        aside = np.array([ahead[1], -ahead[0]])
        x, y = low[:2] - aside * width / 2
        across, along = (self.create("IfcDirection", DirectionRatios=[*v.tolist(), 0.0]) for v in (aside, ahead))
        where = self.create("IfcAxis2Placement3D", Location=self.create_point(x, y, low[2]), Axis=across, RefDirection=along)
        rise = float(high[2] - low[2])
        corners = [self.create_point(*c) for c in ((0, -IFC_SLAB), (run, rise - IFC_SLAB), (run, rise), (0, 0))]
        ring = self.create("IfcPolyline", Points=[*corners, corners[0]])
        profile = self.create("IfcArbitraryClosedProfileDef", ProfileType="AREA", OuterCurve=ring)
        out = self.create("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
        swept = {"SweptArea": profile, "Position": where, "ExtrudedDirection": out, "Depth": width or 1.0}
        return self.create("IfcExtrudedAreaSolid", **swept)

    def list_annotated(self, s: int) -> list[int]:
        """List the signs, tags and objects of a storey whose place is known."""
        landmarks = self.map.landmarks
        known = np.isfinite(landmarks.table["position"]).all(axis=1) & (landmarks.table["storey"] == s)
        return np.flatnonzero(known & landmarks.is_kind("text", "tag", "object")).tolist()  # type: ignore[no-any-return]

    def add_annotation(self, k: int, storey: Any) -> Any:
        """Return a sign, a tag or an object: its text as the name, its kind as the type."""
        row = self.map.landmarks.table[k]
        at = self.create_placement(storey.ObjectPlacement, *(row["position"] - self.shift - (0, 0, storey.Elevation)))
        note = self.create_rooted("IfcAnnotation", f"landmark {k}", ObjectPlacement=at, ObjectType=LANDMARK_KINDS[row["kind"]])
        note.Name = replace_forbidden(self.map.landmarks.values[row["value"]])
        return note

    def add_boundary(self, i: int | str, space: Any, element: Any, side: str = "INTERNAL") -> None:
        """Bound a space by an element, which leads out of it, to a space on the other side that is INTERNAL or EXTERNAL."""
        attributes = {"RelatingSpace": space, "RelatedBuildingElement": element, "InternalOrExternalBoundary": side}
        kind = "VIRTUAL" if element.is_a("IfcVirtualElement") else "PHYSICAL"
        self.create_rooted("IfcRelSpaceBoundary", f"{i} {space.GlobalId}", PhysicalOrVirtualBoundary=kind, **attributes)
