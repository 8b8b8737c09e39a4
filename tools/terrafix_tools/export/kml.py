"""KML and KMZ for Google Earth (OGC 12-007r2; gx: of developers.google.com/kml/documentation/kmlreference).

Points, a line and, where times are known, a gx:Track, which Google Earth plays. Written with ElementTree: GDAL's driver
writes no gx:Track and takes no styles from pyogrio."""

import zipfile
from io import BytesIO
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent, register_namespace

from terrafix_tools.export.track import Track, TrackPose

KML, GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
# aabbggrr of the points by source of the position; of smoothed positions, and of sources that are not here, the last
COLOURS = {
    "satellite_anchored": "ff50b000",
    "visual_propagated": "ff00a5ff",
    "dead_reckoned": "ff3c3cdc",
    "smoothed": "ffd07010",
}
ICON = "http://maps.google.com/mapfiles/kml/shapes/placemark_circle.png"


def write_kml(track: Track, out: Path, _photos: Path | None) -> None:
    _document(track).write(out, encoding="utf-8", xml_declaration=True)


def write_kmz(track: Track, out: Path, _photos: Path | None) -> None:
    document = BytesIO()
    _document(track).write(document, encoding="utf-8", xml_declaration=True)
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", document.getvalue())


def _document(track: Track) -> "ElementTree[Element]":
    register_namespace("", KML)
    register_namespace("gx", GX)
    root = Element(_kml("kml"))
    document = SubElement(root, _kml("Document"))
    _text(document, "name", track.name)
    for name, colour in COLOURS.items():
        style = SubElement(document, _kml("Style"), id=name)
        icon = SubElement(style, _kml("IconStyle"))
        _text(icon, "color", colour)
        _text(icon, "scale", "0.4")
        _text(SubElement(icon, _kml("Icon")), "href", ICON)
        _text(SubElement(style, _kml("LabelStyle")), "scale", "0")
    line_style = SubElement(SubElement(document, _kml("Style"), id="line"), _kml("LineStyle"))
    _text(line_style, "color", COLOURS["smoothed"])
    _text(line_style, "width", "3")
    points = _folder(document, "frames")
    for pose in track.poses:
        _point(points, pose)
    _line(_folder(document, "track"), track)
    if all(pose.time_utc for pose in track.poses):
        _timed(_folder(document, "timed track"), track)
    indent(root)
    return ElementTree(root)


def _point(folder: Element, pose: TrackPose) -> None:
    mark = SubElement(folder, _kml("Placemark"))
    _text(mark, "name", pose.name)
    if pose.time_utc:
        _text(SubElement(mark, _kml("TimeStamp")), "when", pose.time_utc)
    label = pose.row.source_label if pose.which == "immediate" else ""
    _text(mark, "styleUrl", f"#{label if label in COLOURS else 'smoothed'}")
    data = SubElement(mark, _kml("ExtendedData"))
    for name in ("t_s", "lat_deg", "lon_deg", "alt_amsl_m", "agl_m", "sigma_e_m", "sigma_n_m", "yaw_deg"):
        value = getattr(pose.row, name)
        if value is not None:
            _text(SubElement(data, _kml("Data"), name=name), "value", f"{value:.8g}")
    for name, text in (("which", pose.which), ("source_label", pose.row.source_label)):
        _text(SubElement(data, _kml("Data"), name=name), "value", text)
    shape = SubElement(mark, _kml("Point"))
    _text(shape, "altitudeMode", _mode(pose))
    _text(shape, "coordinates", _coordinates(pose, ","))


def _line(folder: Element, track: Track) -> None:
    mark = SubElement(folder, _kml("Placemark"))
    _text(mark, "name", track.name)
    _text(mark, "styleUrl", "#line")
    shape = SubElement(mark, _kml("LineString"))
    _text(shape, "altitudeMode", _mode(track.poses[0]))
    _text(shape, "coordinates", " ".join(_coordinates(pose, ",") for pose in track.poses))


def _timed(folder: Element, track: Track) -> None:
    mark = SubElement(folder, _kml("Placemark"))
    _text(mark, "name", track.name)
    _text(mark, "styleUrl", "#line")
    shape = SubElement(mark, f"{{{GX}}}Track")
    _text(shape, "altitudeMode", _mode(track.poses[0]))
    for pose in track.poses:
        _text(shape, "when", pose.time_utc or "")
    for pose in track.poses:
        SubElement(shape, f"{{{GX}}}coord").text = _coordinates(pose, " ")


def _mode(pose: TrackPose) -> str:
    return "absolute" if pose.row.alt_amsl_m is not None else "relativeToGround"


def _coordinates(pose: TrackPose, separator: str) -> str:
    height_m = pose.row.alt_amsl_m if pose.row.alt_amsl_m is not None else pose.row.agl_m or 0.0
    return separator.join((f"{pose.lon_deg:.8f}", f"{pose.lat_deg:.8f}", f"{height_m:.3f}"))


def _folder(document: Element, name: str) -> Element:
    folder = SubElement(document, _kml("Folder"))
    _text(folder, "name", name)
    return folder


def _kml(tag: str) -> str:
    return f"{{{KML}}}{tag}"


def _text(parent: Element, tag: str, text: str) -> None:
    SubElement(parent, _kml(tag)).text = text
