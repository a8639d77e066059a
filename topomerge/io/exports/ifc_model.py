"""What every IFC file needs: units, contexts, placements, relations and extruded polygons, without anything of a building."""

from __future__ import annotations

import uuid
from typing import Any

import numpy as np

from topomerge.io.exports.markup import text
from topomerge.types import Array, TopometricMap

STAMP = "1970-01-01T00:00:00"  # the same map gives the same bytes


class Model:
    """A file with a project, a site and a building. Names of methods are what they make.

    Attributes:
        map: the map that it is made of.
        file: the model of ifcopenshell.
        shift: (3,) m, where the site stands in the input's frame; all else counts from there.
        site, building: entities.
    """

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
        si_units = [self.new("IfcSIUnit", UnitType=unit, Name=name) for unit, name in units.items()]
        self.units = self.new("IfcUnitAssignment", Units=si_units)
        world = self.new("IfcAxis2Placement3D", Location=self.point(0, 0, 0))
        attributes = {"ContextType": "Model", "CoordinateSpaceDimension": 3, "Precision": 1e-5, "WorldCoordinateSystem": world}
        self.context = self.new("IfcGeometricRepresentationContext", **attributes)
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

    def aggregate(self, parent: Any, parts: list[Any]) -> None:
        """Parts belong to a whole."""
        if parts:
            self.root("IfcRelAggregates", parent.GlobalId, RelatingObject=parent, RelatedObjects=parts)

    def contain(self, storey: Any, elements: list[Any]) -> None:
        """Elements stand on a storey."""
        if elements:
            name = f"{storey.GlobalId} {elements[0].GlobalId}"
            self.root("IfcRelContainedInSpatialStructure", name, RelatingStructure=storey, RelatedElements=elements)

    def view(self, name: str, kind: str, items: list[Any]) -> Any:
        """A body, an axis or a footprint."""
        attributes = {"RepresentationIdentifier": name, "RepresentationType": kind, "Items": items}
        return self.new("IfcShapeRepresentation", ContextOfItems=self.views[name], **attributes)

    def shape(self, name: str, kind: str, items: list[Any]) -> Any:
        """What a product looks like; None where there is nothing to show."""
        return self.new("IfcProductDefinitionShape", Representations=[self.view(name, kind, items)]) if items else None

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
