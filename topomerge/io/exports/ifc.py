"""A building model, IFC4: site, building, storeys, spaces, doors, windows, stairs; walls, floors and ceilings as far as seen.

Spaces, floors, ceilings and walls are extruded polygons. An IfcOpeningElement voids the wall that carries a door or a window,
and the door or the window, a box, fills it. An opening without a door is an IfcVirtualElement, stairs and ramps are a plate
from their lower to their upper end. IfcRelSpaceBoundary says which spaces a door joins. The site is placed where the map lies,
so that all else has small coordinates. Source: ISO 16739-1, IFC4 ADD2 TC1.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import shapely

from topomerge.io.atomic import replacing
from topomerge.io.exports.ifc_model import Model
from topomerge.io.listing import room_words
from topomerge.structure.floors import is_flight, room_levels
from topomerge.structure.plan_structure import plan_structure
from topomerge.structure.walls import wall_part
from topomerge.types import ROOM_ODDS, Array, TopometricMap

LEAF_THICKNESS, IFC_SLAB, CEILING_THICKNESS = 0.1, 0.1, 0.05  # m, thickness
IFC_LINTEL = 2.0  # m, of doors without anything seen above
LEAST_VOID = 0.05  # m, height of an opening at least
CUT_THROUGH = 0.05  # m by which the body of an opening stands out of its wall, so that nothing of that stays


def save(map: TopometricMap, path: Path) -> None:
    """Write the model, in metres in the input's frame.

    Raises:
        InputError: the path can't be written.
    """
    model = _Building(map)
    storeys = [model.storey(s) for s in range(len(map.storeys))]
    model.aggregate(model.building, storeys)
    structure, (levels, seen) = plan_structure(map), room_levels(map)
    floors = structure.rooms
    spaces = [model.space(r, floors[r], levels[r], bool(seen[r]), storeys) for r in range(len(map.rooms))]
    for s, storey in enumerate(storeys):
        rooms = np.flatnonzero(map.rooms["storey"] == s).tolist()
        model.aggregate(storey, [spaces[r] for r in rooms])
        rooms = [r for r in rooms if not floors[r].is_empty]
        built = [model.slab(r, floors[r], float(levels[r, 0]), storey) for r in rooms]
        built += [model.ceiling(r, floors[r], float(levels[r, 1]), storey) for r in rooms if seen[r]]
        model.contain(storey, built)
    walls = [model.wall(k, wall, storeys[wall["storey"]]) for k, wall in enumerate(structure.walls)]
    for s, storey in enumerate(storeys):
        model.contain(storey, [walls[k] for k in np.flatnonzero(structure.walls["storey"] == s)])
    openings = {int(opening["edge"]): opening for opening in structure.openings}
    for i, edge in enumerate(map.edges):
        a, b = edge["rooms"].tolist()
        storey = storeys[int(map.rooms["storey"][[a, b]].min())]
        element = model.flight(i, edge, storey) if is_flight(edge) else model.door(i, openings[i], storey)
        if i in openings and (k := int(openings[i]["wall"])) >= 0:
            model.hole(openings[i], structure.walls[k], walls[k], element)
        model.contain(storey, [element])
        model.say_of_edge(i, edge, element)
        for r, other in ((a, b), (b, a)):
            model.bound(i, spaces[r], element, spaces[other].PredefinedType)
    for k, pane in enumerate(structure.windows):
        rooms = [r for r in map.windows["rooms"][k].tolist() if r >= 0]
        storey = storeys[int(map.rooms["storey"][rooms[0]])]
        element = model.window(k, pane, storey)
        if (w := int(pane["wall"])) >= 0:
            model.pane_hole(k, pane, structure.walls[w], walls[w], element)
        model.contain(storey, [element])
        for n, r in enumerate(rooms):
            side = spaces[rooms[1 - n]].PredefinedType if len(rooms) > 1 else "NOTDEFINED"
            model.bound(f"window {k}", spaces[r], element, side)
    with replacing(path) as beside:
        model.file.write(str(beside))


class _Building(Model):
    """A building in the model. Names of methods are what they make."""

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
        side = "EXTERNAL" if "outside" in room_words(room) else "INTERNAL"
        space = self.root("IfcSpace", f"room {r}", CompositionType="ELEMENT", PredefinedType=side, **body)
        quantities = [self.new("IfcQuantityArea", Name="GrossFloorArea", AreaValue=float(room["area"]))]
        if seen:
            quantities.append(self.new("IfcQuantityLength", Name="Height", LengthValue=float(room["height"])))
            quantities.append(self.new("IfcQuantityVolume", Name="GrossVolume", VolumeValue=float(room["volume"])))
        self._define(space, self._set("IfcElementQuantity", "Qto_SpaceBaseQuantities", r, Quantities=quantities))
        facts = {"Completeness": ("IfcReal", float(room["completeness"])), "Glimpsed": ("IfcBoolean", bool(room["glimpsed"]))}
        facts |= {name.title(): ("IfcReal", float(room[name])) for name in ROOM_ODDS}
        properties = [self._fact(name, kind, value) for name, (kind, value) in facts.items()]
        self._define(space, self._set("IfcPropertySet", "Topomerge_Room", r, HasProperties=properties))
        return space

    def _fact(self, name: str, kind: str, value: Any) -> Any:
        return self.new("IfcPropertySingleValue", Name=name, NominalValue=self.file.create_entity(kind, value))

    def _set(self, kind: str, name: str, number: int, **values: Any) -> Any:
        property_set = self.root(kind, f"{name} {number}", **values)
        property_set.Name = name
        return property_set

    def _define(self, product: Any, facts: Any) -> None:
        name = f"{product.GlobalId} {facts.GlobalId}"
        self.root("IfcRelDefinesByProperties", name, RelatedObjects=[product], RelatingPropertyDefinition=facts)

    def slab(self, r: int, floor: Any, z: float, storey: Any) -> Any:
        """The floor of a room."""
        body = self.prisms(floor, z - storey.Elevation - IFC_SLAB, IFC_SLAB)
        at = self.place(storey.ObjectPlacement, 0, 0, 0)
        return self.root("IfcSlab", f"floor {r}", ObjectPlacement=at, Representation=body, PredefinedType="FLOOR")

    def ceiling(self, r: int, floor: Any, z: float, storey: Any) -> Any:
        """The ceiling of a room in which one was seen."""
        body = self.prisms(floor, z - storey.Elevation, CEILING_THICKNESS)
        at = self.place(storey.ObjectPlacement, 0, 0, 0)
        return self.root("IfcCovering", f"ceiling {r}", ObjectPlacement=at, Representation=body, PredefinedType="CEILING")

    def wall(self, k: int, wall: Any, storey: Any) -> Any:
        """A wall with what is known of it."""
        low, high = (float(wall[name]) - storey.Elevation for name in ("low", "high"))
        at = self.place(storey.ObjectPlacement, 0, 0, 0)
        body = {"ObjectPlacement": at, "Representation": self.prisms(shapely.MultiPolygon([wall_part(wall)]), low, high - low)}
        element = self.root("IfcWall", f"wall {k}", PredefinedType="NOTDEFINED", **body)
        facts = [self._fact("FacesSeen", "IfcInteger", int(wall["faces"]))]
        self._define(element, self._set("IfcPropertySet", "Topomerge_Wall", k, HasProperties=facts))
        sizes = {"Length": float(np.hypot(*(wall["end"] - wall["start"])))}
        if wall["faces"] == 2:  # else its thickness is a guess
            sizes["Width"] = float(wall["thickness"])
        quantities = [self.new("IfcQuantityLength", Name=name, LengthValue=value) for name, value in sizes.items()]
        self._define(element, self._set("IfcElementQuantity", "Qto_WallBaseQuantities", k, Quantities=quantities))
        return element

    def hole(self, opening: Any, wall: Any, voided: Any, door: Any) -> None:
        """An opening in a wall; a door fills it."""
        low = float(opening["centre"][2])
        span = low, float(opening["height"]) or IFC_LINTEL
        element = self._void(f"opening {opening['edge']}", wall_part(wall, opening, CUT_THROUGH), wall, span, voided)
        if door.is_a("IfcDoor"):
            self.root("IfcRelFillsElement", element.GlobalId, RelatingOpeningElement=element, RelatedBuildingElement=door)

    def pane_hole(self, k: int, pane: Any, wall: Any, voided: Any, window: Any) -> None:
        """The hole in a wall that a window fills."""
        low = float(pane["centre"][2] + pane["sill"])
        span = low, float(pane["head"] - pane["sill"])
        element = self._void(f"pane {k}", wall_part(wall, pane, CUT_THROUGH), wall, span, voided)
        self.root("IfcRelFillsElement", element.GlobalId, RelatingOpeningElement=element, RelatedBuildingElement=window)

    def _void(self, name: str, outline: Any, wall: Any, span: tuple[float, float], voided: Any) -> Any:
        """A hole in a wall; `span`: where it begins, m in the input's frame, and its height, at most up to the wall's top."""
        low, height = span
        storey_height = float(self.map.storeys["floor"][wall["storey"]])
        top = min(low + height, float(wall["high"]) + CUT_THROUGH)
        low = min(low, top - LEAST_VOID)  # of what begins above the top of its wall, as far as that was seen
        height = top - low
        shape = shapely.MultiPolygon([outline])
        body = {"Representation": self.prisms(shape, low - storey_height, height), "PredefinedType": "OPENING"}
        at = self.place(voided.ObjectPlacement, 0, 0, 0)
        element = self.root("IfcOpeningElement", name, ObjectPlacement=at, **body)
        self.root("IfcRelVoidsElement", element.GlobalId, RelatingBuildingElement=voided, RelatedOpeningElement=element)
        return element

    def door(self, i: int, opening: Any, storey: Any) -> Any:
        """A door as a box in its opening, or an opening without one as a line on the floor."""
        across = float(opening["direction"])
        along = np.array([-np.sin(across), np.cos(across)])
        width, height = float(opening["width"]), float(opening["height"])
        x, y, z = opening["centre"] - (*along * width / 2, 0) - self.shift - (0, 0, storey.Elevation)
        at = self.place(storey.ObjectPlacement, x, y, z, along)
        if opening["kind"] != "door":
            line = self.new("IfcPolyline", Points=[self.point(0, 0, 0), self.point(width, 0, 0)])
            shown = self.shape("FootPrint", "Curve3D", [line])
            return self.root("IfcVirtualElement", f"{opening['kind']} {i}", ObjectPlacement=at, Representation=shown)
        attributes = {"OverallWidth": width, "PredefinedType": "DOOR", "OperationType": "NOTDEFINED"}
        attributes |= {"OverallHeight": height} if height else {}
        body = self._box(width, height or IFC_LINTEL)
        return self.root("IfcDoor", f"door {i}", ObjectPlacement=at, Representation=body, **attributes)

    def say_of_edge(self, i: int, edge: Any, element: Any) -> None:
        """How likely a door, an opening or a flight is one, and whether one could walk through."""
        facts = [self._fact("Confidence", "IfcReal", float(edge["confidence"]))]
        facts += [self._fact(name, "IfcBoolean", bool(edge[name.lower()])) for name in ("Open", "Half")]
        self._define(element, self._set("IfcPropertySet", f"Topomerge_{str(edge['kind']).title()}", i, HasProperties=facts))

    def _box(self, width: float, height: float) -> Any:
        """What fills an opening or stands before a wall, along x from 0, y to both sides."""
        middle = self.new("IfcAxis2Placement2D", Location=self.point(width / 2, 0))
        box = self.new("IfcRectangleProfileDef", ProfileType="AREA", Position=middle, XDim=width, YDim=LEAF_THICKNESS)
        up = self.new("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
        solid = self.new("IfcExtrudedAreaSolid", SweptArea=box, ExtrudedDirection=up, Depth=height)
        return self.shape("Body", "SweptSolid", [solid])

    def window(self, k: int, pane: Any, storey: Any) -> Any:
        """A window as a box in its opening, on its sill, and what was seen of it."""
        across, width, height = float(pane["direction"]), float(pane["width"]), float(pane["head"] - pane["sill"])
        along = np.array([-np.sin(across), np.cos(across)])
        x, y, z = pane["centre"] - (*along * width / 2, 0) - self.shift + (0, 0, pane["sill"] - storey.Elevation)
        sizes = {"OverallWidth": width, "OverallHeight": height, "PredefinedType": "WINDOW"}
        body = {"ObjectPlacement": self.place(storey.ObjectPlacement, x, y, z, along), "Representation": self._box(width, height)}
        element = self.root("IfcWindow", f"window {k}", PartitioningType="NOTDEFINED", **sizes, **body)
        seen = self.map.windows[k]
        facts = [self._fact("Confidence", "IfcReal", float(seen["confidence"]))]
        facts += [self._fact(f"{end.title()}Seen", "IfcBoolean", bool(np.isfinite(seen[end]))) for end in ("sill", "head")]
        self._define(element, self._set("IfcPropertySet", "Topomerge_Window", k, HasProperties=facts))
        return element

    def flight(self, i: int, edge: Any, storey: Any) -> Any:
        """Stairs or a ramp, as a sloping plate."""
        low, high = (edge[end] - self.shift - (0, 0, storey.Elevation) for end in ("lower", "upper"))
        views = [self.view("Axis", "Curve3D", [self.new("IfcPolyline", Points=[self.point(*low), self.point(*high)])])]
        run = float(np.hypot(*(high - low)[:2]))
        if run > LEAF_THICKNESS:
            views.append(self.view("Body", "SweptSolid", [self._plate(low, high, run, float(edge["width"]))]))
        kind = "IfcRamp" if edge["kind"] == "ramp" else "IfcStair"
        at = self.place(storey.ObjectPlacement, 0, 0, 0)
        shape = self.new("IfcProductDefinitionShape", Representations=views)
        return self.root(kind, f"{edge['kind']} {i}", ObjectPlacement=at, Representation=shape, PredefinedType="NOTDEFINED")

    def _plate(self, low: Array, high: Array, run: float, width: float) -> Any:
        """A parallelogram that stands upright along the flight, drawn out sideways."""
        ahead = (high - low)[:2] / run
        aside = np.array([ahead[1], -ahead[0]])
        x, y = low[:2] - aside * width / 2
        across, along = (self.new("IfcDirection", DirectionRatios=[*v.tolist(), 0.0]) for v in (aside, ahead))
        where = self.new("IfcAxis2Placement3D", Location=self.point(x, y, low[2]), Axis=across, RefDirection=along)
        rise = float(high[2] - low[2])
        corners = [self.point(*c) for c in ((0, -IFC_SLAB), (run, rise - IFC_SLAB), (run, rise), (0, 0))]
        ring = self.new("IfcPolyline", Points=[*corners, corners[0]])
        profile = self.new("IfcArbitraryClosedProfileDef", ProfileType="AREA", OuterCurve=ring)
        out = self.new("IfcDirection", DirectionRatios=[0.0, 0.0, 1.0])
        swept = {"SweptArea": profile, "Position": where, "ExtrudedDirection": out, "Depth": width or 1.0}
        return self.new("IfcExtrudedAreaSolid", **swept)

    def bound(self, i: int | str, space: Any, element: Any, side: str = "INTERNAL") -> None:
        """A space is bounded by an element, which leads out of it, to a space on the other side that is INTERNAL or EXTERNAL."""
        attributes = {"RelatingSpace": space, "RelatedBuildingElement": element, "InternalOrExternalBoundary": side}
        kind = "VIRTUAL" if element.is_a("IfcVirtualElement") else "PHYSICAL"
        self.root("IfcRelSpaceBoundary", f"{i} {space.GlobalId}", PhysicalOrVirtualBoundary=kind, **attributes)
