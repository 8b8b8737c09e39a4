"""Positions in copies of photos: EXIF GPS directory and XMP, as DJI and Pix4D name them.

The pixels and everything else stay byte for byte: a new GPS directory is appended to the EXIF block, so that no offset
in it changes (maker notes have absolute ones). References: EXIF 2.32 (JEITA CP-3451E), TIFF 6.0, XMP part 3 (Adobe),
"Specifications of XMP Camera Tags" (Pix4D)."""

import re
import shutil
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2
from PIL.TiffTags import ASCII, BYTE, RATIONAL

from terrafix.core.errors import SourceError
from terrafix_tools.export.track import Track, TrackPose, photo_path

JPEG, APP0, APP1 = b"\xff\xd8", 0xE0, 0xE1
EXIF_HEAD, XMP_HEAD = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0"
SEGMENT_LIMIT = 0xFFFF - 2  # bytes of a segment besides its length
GPS_POINTER, LONG = 0x8825, 4
ENTRY = 12  # bytes of an entry of a directory
# Tags of the GPS directory
LAT_REF, LAT, LON_REF, LON, ALT_REF, ALT, DATUM, ERROR = 1, 2, 3, 4, 5, 6, 18, 31
MICRO = 1_000_000
XMP_PACKET = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
    '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
)
PIX4D = "http://pix4d.com/camera/1.0"
# What other programs read before the EXIF coordinate (OpenDroneMap, Metashape), with the attribute of a pose. RTK
# deviations are those of a receiver that this position is not from.
STATED = {
    "GpsLatitude": "lat_deg", "GpsLongitude": "lon_deg", "GpsLongtitude": "lon_deg",
    "Latitude": "lat_deg", "Longitude": "lon_deg", "AbsoluteAltitude": "alt_m",
    "RtkStdLat": "sigma_h_m", "RtkStdLon": "sigma_h_m", "RtkStdHgt": "sigma_u_m",
}  # fmt: skip


def write_photos(track: Track, out: Path, photos: Path | None) -> None:
    """Copies the photos that have a position into ``out``. Raises SourceError: a photo is missing or no JPEG."""
    assert photos is not None
    sources = [photo_path(photos, pose.name) for pose in track.poses]
    for path in sources:
        with path.open("rb") as stream:
            if stream.read(2) != JPEG:
                raise SourceError(f"{path}: not a JPEG; positions are written into JPEGs alone, export others as odm")
    out.mkdir(parents=True, exist_ok=True)
    for pose, path in zip(track.poses, sources, strict=True):
        (out / pose.name).write_bytes(tagged(path.read_bytes(), pose, str(path)))
        shutil.copystat(path, out / pose.name)


def tagged(data: bytes, pose: TrackPose, name: str) -> bytes:
    """The bytes of a JPEG with the position of ``pose``. ``name``: for errors. Raises SourceError."""
    head, rest = _segments(data, name)
    exif = next((s for m, s in head if m == APP1 and s.startswith(EXIF_HEAD)), None)
    xmp = next((s for m, s in head if m == APP1 and s.startswith(XMP_HEAD)), None)
    try:
        new_exif = EXIF_HEAD + with_gps((exif or EXIF_HEAD + b"II*\0\x08\0\0\0\0\0\0\0\0\0")[len(EXIF_HEAD) :], pose)
    except (struct.error, IndexError) as error:
        raise SourceError(f"{name}: its EXIF is damaged ({error}); export as odm, pix4d or metashape") from None
    new_xmp = XMP_HEAD + with_xmp((xmp or XMP_HEAD + XMP_PACKET.encode())[len(XMP_HEAD) :].decode("utf-8"), pose)
    if max(len(new_exif), len(new_xmp)) > SEGMENT_LIMIT:
        raise SourceError(f"{name}: no room for the position in its EXIF or XMP; export as odm, pix4d or metashape")
    first = [(m, s) for m, s in head if m == APP0]
    others = [(m, s) for m, s in head if m != APP0 and s is not exif and s is not xmp]
    written = [*first, (APP1, new_exif), (APP1, new_xmp), *others]
    return JPEG + b"".join(struct.pack(">BBH", 0xFF, m, len(s) + 2) + s for m, s in written) + rest


def _segments(data: bytes, name: str) -> tuple[list[tuple[int, bytes]], bytes]:
    """-> (marker, content) of the APP segments at the head of a JPEG, and what follows them."""
    at, found = 2, []
    while data[at : at + 1] == b"\xff" and len(data) >= at + 4 and APP0 <= data[at + 1] <= APP0 + 15:
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if at + 2 + length > len(data):
            raise SourceError(f"{name}: a truncated JPEG; take the photo from the camera's card again")
        found.append((data[at + 1], data[at + 4 : at + 2 + length]))
        at += 2 + length
    return found, data[at:]


def with_gps(tiff: bytes, pose: TrackPose) -> bytes:
    """An EXIF block (TIFF) whose GPS directory is that of ``pose``; the first directory is written anew at the end if
    it has no entry for it. Raises struct.error, IndexError."""
    order = {b"II": "<", b"MM": ">"}[tiff[:2]] if tiff[:2] in (b"II", b"MM") else ""
    if not order:
        raise struct.error("no byte order")
    (at,) = struct.unpack_from(order + "I", tiff, 4)
    (count,) = struct.unpack_from(order + "H", tiff, at)
    entries = [tiff[at + 2 + ENTRY * i : at + 2 + ENTRY * (i + 1)] for i in range(count)]
    following = tiff[at + 2 + ENTRY * count : at + 6 + ENTRY * count].ljust(4, b"\0")
    tags = [struct.unpack_from(order + "H", entry)[0] for entry in entries]
    body = tiff + b"\0" * (len(tiff) % 2)
    gps_at = len(body)
    body += _gps_directory(order, pose).tobytes(gps_at)
    pointer = struct.pack(order + "HHII", GPS_POINTER, LONG, 1, gps_at)
    if GPS_POINTER in tags:
        place = at + 2 + ENTRY * tags.index(GPS_POINTER)
        return body[:place] + pointer + body[place + ENTRY :]
    body += b"\0" * (len(body) % 2)
    entries.insert(sum(tag < GPS_POINTER for tag in tags), pointer)
    directory = struct.pack(order + "H", len(entries)) + b"".join(entries) + following
    return body[:4] + struct.pack(order + "I", len(body)) + body[8:] + directory


def _gps_directory(order: str, pose: TrackPose) -> ImageFileDirectory_v2:
    gps = ImageFileDirectory_v2(b"II*\0\0\0\0\0" if order == "<" else b"MM\0*\0\0\0\0")
    values: dict[int, tuple[int, Any]] = {
        0: (BYTE, b"\2\3\0\0"),
        LAT_REF: (ASCII, "N" if pose.lat_deg >= 0 else "S"),
        LAT: (RATIONAL, _degrees(pose.lat_deg)),
        LON_REF: (ASCII, "E" if pose.lon_deg >= 0 else "W"),
        LON: (RATIONAL, _degrees(pose.lon_deg)),
        DATUM: (ASCII, "WGS-84"),
    }
    if pose.row.alt_amsl_m is not None:
        values[ALT_REF] = (BYTE, b"\0" if pose.row.alt_amsl_m >= 0 else b"\1")
        values[ALT] = (RATIONAL, _rational(abs(pose.row.alt_amsl_m), 1000))
    if pose.sigma_h_m is not None:
        values[ERROR] = (RATIONAL, _rational(pose.sigma_h_m, 1000))
    for tag, (kind, value) in values.items():
        gps.tagtype[tag] = kind
        gps[tag] = value
    return gps


def _degrees(angle: float) -> tuple[IFDRational, ...]:
    """Degrees, minutes, seconds to a millionth of a second (0.03 mm)."""
    whole = round(abs(angle) * 3600 * MICRO)
    minutes, micro_seconds = divmod(whole, 60 * MICRO)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(micro_seconds, MICRO)


def _rational(value: float, denominator: int) -> IFDRational:
    fraction = Fraction(round(value * denominator), denominator)
    return IFDRational(fraction.numerator, fraction.denominator)


def with_xmp(packet: str, pose: TrackPose) -> bytes:
    """An XMP packet with the accuracies as Pix4D names them; coordinates that it has already are replaced. The angles
    stay those of the camera."""
    for key, attribute in STATED.items():
        value = getattr(pose, attribute)
        text = "" if value is None else f"{value:+.8f}" if attribute.endswith("deg") else f"{value:.3f}"
        if text:
            packet = re.sub(rf'(\bdrone-dji:{key}\s*=\s*["\'])[^"\']*', rf"\g<1>{text}", packet)
            packet = re.sub(rf"(<drone-dji:{key}>)[^<]*", rf"\g<1>{text}", packet)
    packet = re.sub(r'\s[\w.-]+:GPS(?:XY|Z)Accuracy\s*=\s*(?:"[^"]*"|\'[^\']*\')', "", packet)
    packet = re.sub(r"<([\w.-]+:GPS(?:XY|Z)Accuracy)>[^<]*</\1>", "", packet)
    sigmas = {"GPSXYAccuracy": pose.sigma_h_m, "GPSZAccuracy": pose.sigma_u_m}
    stated = "".join(f' Camera:{key}="{value:.3f}"' for key, value in sigmas.items() if value is not None)
    added = f'<rdf:Description rdf:about="" xmlns:Camera="{PIX4D}"{stated}/></rdf:RDF>'
    return packet.replace("</rdf:RDF>", added, 1).encode("utf-8")
