"""Changes as files: JSON, GeoJSON, and BCF for those who work with building models."""

from __future__ import annotations

import uuid
import zipfile
from pathlib import Path
from typing import Any, cast

import numpy as np

from topomerge.archive import convert_to_plain, replace_on_success
from topomerge.changes.compare import Change, Changes
from topomerge.errors import InputError
from topomerge.io.exports import replace_forbidden
from topomerge.io.exports.geojson import format_collection, round_positions
from topomerge.io.listing import format_columns, format_json
from topomerge.types import Array

CHANGES_FORMAT = 1
STAMP = "1970-01-01T00:00:00Z"  # the same changes give the same bytes
ZIP_DATE = (1980, 1, 1, 0, 0, 0)
CAMERA_BACK, CAMERA_UP, TARGET_UP = 4.0, 2.5, 1.2  # m from what a camera looks at
AUTHOR, STATUS = "topomerge", "Open"


def describe_change(change: Change) -> str:
    """Describe a change in words: what, how large, how sure."""
    size = f"{change.extent:.2f} m" if change.element != "room" else f"{change.extent**2:.1f} m²"
    if change.element == "element":
        size = f"{100 * change.evidence.get('shift', 0.0):+.1f} cm" if change.kind == "element elsewhere" else size
    about = f" ({change.name})" if change.name else ""
    return f"{change.kind}{about}, {size}, probability {change.probability:.2f}"


def format_changes(changes: Changes) -> str:
    """Return the tables that `topomerge diff` prints, without a line break at the end."""
    counts = changes.count_kinds()
    text = ", ".join(f"{n} {kind}" for kind, n in counts.items()) or "nothing has changed that both maps could see"
    seen = ", ".join(f"{v:.0f} m² of storey {k}" for k, v in sorted(changes.compared.items()))
    lines = [f"{text}; both maps saw {seen}"]
    if changes.changes:
        columns = ("change", "storey", "size m", "x m", "y m", "probability", "what")
        lines += ["", *format_columns(columns, [_list_cells(c) for c in changes.changes])]
    states = [row.state for row in changes.elements]
    if states:
        message = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
        lines += ["", f"{len(states)} elements of the model: {message}"]
    return "\n".join(lines)


def _list_cells(change: Change) -> tuple[str, ...]:
    shift = change.evidence.get("shift")
    about = change.name + (f", {100 * shift:+.1f} cm along its normal" if shift is not None else "")
    sides = [
        f"{change.element} {', '.join(map(str, n))} of {side}" for n, side in ((change.old, "old"), (change.new, "new")) if n
    ]
    x, y = change.place[:2].tolist()
    numbers = (f"{change.extent:.2f}", f"{x:.2f}", f"{y:.2f}", f"{change.probability:.2f}")
    return (change.kind, str(change.storey), *numbers, " ".join((about or ", ".join(sides)).split()))


def serialise_changes(changes: Changes) -> dict[str, Any]:
    """Serialise changes as plain values; places are metres in the frame of the old map."""
    sides = {
        name: {"source": m.source, "rooms": len(m.rooms), "storeys": len(m.storeys)}
        for name, m in (("old", changes.old), ("new", changes.new))
    }
    listing = {
        "format": CHANGES_FORMAT,
        **sides,
        "transform": changes.placement.pose.matrix,
        "slack_m": None if np.isnan(changes.slack) else round(changes.slack, 3),
        "compared_m2": {str(k): round(v, 1) for k, v in sorted(changes.compared.items())},
        "counts": changes.count_kinds(),
        "changes": [_serialise_change(c) for c in changes.changes],
        "elements": [row.serialise() for row in changes.elements],
    }
    plain: dict[str, Any] = convert_to_plain(listing)
    return plain


def _serialise_change(change: Change) -> dict[str, Any]:
    row: dict[str, Any] = {
        "kind": change.kind,
        "storey": change.storey,
        "place": np.round(change.place, 3),
        "shape": np.round(change.shape, 3),
        "extent_m": change.extent,
        "probability": change.probability,
        "evidence": change.evidence,
        "old": list(change.old),
        "new": list(change.new),
    }
    if change.from_place is not None:
        row["from"] = np.round(change.from_place, 3)
    return row | ({"guid": change.guid, "name": change.name} if change.guid else {})


def save_geojson(changes: Changes, path: str | Path) -> None:
    """Write one feature a change, as an outline or a line, in metres in the frame of the old map (`crs` is null).

    Raises:
        InputError: the path can't be written.
    """
    about = {"coordinates": "metres in the frame of the old map, z up; not longitude and latitude"}
    about |= {"old": changes.old.source, "new": changes.new.source}
    features = []
    for k, change in enumerate(changes.changes):
        row = convert_to_plain(_serialise_change(change))
        properties = {name: value for name, value in row.items() if name not in ("shape", "place")}
        features.append({"type": "Feature", "id": f"change {k}", "geometry": _build_geometry(change), "properties": properties})
    with replace_on_success(path) as temporary:
        text = format_collection({"type": "FeatureCollection", "crs": None, "topomerge": about}, features)
        temporary.write_text(text, encoding="utf-8", errors="replace")


def _build_geometry(change: Change) -> dict[str, Any]:
    points = np.column_stack([change.shape, np.full(len(change.shape), change.place[2])])
    if len(points) == 2:
        return {"type": "LineString", "coordinates": round_positions(points)}
    x, y = change.shape.T
    if float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) < 0:  # RFC 7946: the outer ring runs counter-clockwise
        points = points[::-1]
    return {"type": "Polygon", "coordinates": [round_positions(np.concatenate([points, points[:1]]))]}


def save_bcf(changes: Changes, path: str | Path) -> None:
    """Write a BCF 3.0 file: one topic a change, with a camera that looks at it; elements of a model are selected by their GUID.

    Raises:
        InputError: the package ``bcf-client`` is missing, or the path can't be written.
    """
    try:
        import bcf.v3.model as model
        from bcf.v3.bcfxml import BcfXml
        from bcf.v3.topic import TopicHandler
        from bcf.v3.visinfo import VisualizationInfoHandler
        from xsdata.models.datatype import XmlDateTime
    except ImportError as error:
        raise InputError("--bcf: needs the Python package bcf-client: pip install 'topomerge[bcf]'") from error
    kinds = sorted({change.kind for change in changes.changes}) or ["change"]
    extensions = model.Extensions(
        topic_types=model.ExtensionsTopicTypes(topic_type=kinds),
        topic_statuses=model.ExtensionsTopicStatuses(topic_status=[STATUS]),
        users=model.ExtensionsUsers(user=[AUTHOR]),
    )
    names = replace_forbidden(f"{changes.old.title} to {changes.new.title}")
    file = BcfXml.create_new(names, extensions)
    assert file.project is not None
    file.project.project_id = _make_guid("project", names)
    for k, change in enumerate(changes.changes):
        text = replace_forbidden(describe_change(change))
        guid = _make_guid("topic", str(k), names, text, str(change.place.tolist()))
        message = "; ".join(f"{name} {value:g}" for name, value in change.evidence.items())
        topic = model.Topic(
            title=text, description=replace_forbidden(f"Probability {change.probability:.2f}. {message}"), creation_author=AUTHOR,
            creation_date=XmlDateTime.from_string(STAMP), guid=guid, topic_type=change.kind, topic_status=STATUS, index=k,
        )  # fmt: skip
        handler = TopicHandler(topic_dir=cast(Any, Path(guid)))  # of which only the name is used
        handler.markup = model.Markup(topic=topic)
        view = VisualizationInfoHandler.create_from_point_and_guids(change.place, *([change.guid] if change.guid else []))
        view.visualization_info.guid = _make_guid("view", guid)
        view.visualization_info.perspective_camera = _build_camera(model, change)
        handler.add_visinfo_handler(view)
        file.topics[guid] = handler
    with replace_on_success(path) as temporary:
        file.save(temporary)
        _fix_dates(temporary)


def _make_guid(*parts: str) -> str:
    return str(uuid.uuid5(uuid.NAMESPACE_URL, ":".join(("topomerge", *parts))))


def _build_camera(model: Any, change: Change) -> Any:
    """Return a camera that stands back from a change, across its longer side, and looks down at it."""
    span = np.ptp(change.shape, axis=0) if len(change.shape) > 2 else change.shape[1] - change.shape[0]
    along = np.array([1.0, 0.0]) if len(change.shape) > 2 and span[0] >= span[1] else np.array([0.0, 1.0])
    if len(change.shape) == 2 and np.hypot(*span) > 0:
        along = span / np.hypot(*span)
    target = change.place + (0, 0, TARGET_UP)
    back = np.array([-along[1], along[0], 0.0]) * (CAMERA_BACK + change.extent) + (0, 0, CAMERA_UP)
    way = -back / np.linalg.norm(back)
    right = np.cross(way, (0, 0, 1.0))
    up = np.cross(right / np.linalg.norm(right), way)

    def build(kind: Any, v: Array) -> Any:
        x, y, z = v.tolist()
        return kind(x=x, y=y, z=z)

    return model.PerspectiveCamera(
        camera_view_point=build(model.Point, target + back),
        camera_direction=build(model.Direction, way),
        camera_up_vector=build(model.Direction, up),
        field_of_view=60.0,
        aspect_ratio=1.5,
    )


def _fix_dates(path: Path) -> None:
    """Write an archive anew with one date for all its files."""
    with zipfile.ZipFile(path) as archive:
        files = [(name, archive.read(name)) for name in archive.namelist()]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files:
            archive.writestr(zipfile.ZipInfo(name, ZIP_DATE), data, zipfile.ZIP_DEFLATED)


def save_json(changes: Changes, path: str | Path) -> None:
    """Write `serialise_changes` as JSON.

    Raises:
        InputError: the path can't be written.
    """
    with replace_on_success(path) as temporary:
        temporary.write_text(format_json(serialise_changes(changes)), encoding="utf-8", errors="replace")
