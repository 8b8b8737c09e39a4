"""Capabilities of a WMTS server: URL templates of one layer's tiles in Web Mercator (OGC 07-057r7, version 1.0.0)."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from urllib.parse import quote

from terrafix.core.errors import MapError
from terrafix_tools.mapping.sources.tiles.grid import MAX_ZOOM, tile_span_m
from terrafix_tools.mapping.sources.tiles.url_template import UrlTemplate

WMTS = "{http://www.opengis.net/wmts/1.0}"
OWS = "{http://www.opengis.net/ows/1.1}"
LINK = "{http://www.w3.org/1999/xlink}href"
PIXEL_M = 0.28e-3  # pixel size of the standard's display, to which scale denominators refer (clause 6.1)
FORMATS = ("image/jpeg", "image/jpg", "image/png", "image/webp")  # in this order of preference
WORLD_CORNER_M = -20_037_508.34


@dataclass(frozen=True)
class WmtsLayer:
    template: UrlTemplate
    zooms: tuple[int, ...]
    tile_px: int


def read_capabilities(data: bytes, name: str, url: str) -> WmtsLayer:
    """The layer ``name`` of a GetCapabilities document. Raises MapError: no such layer, not in Web Mercator."""
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise MapError(f"{url}: no WMTS capabilities ({error}); check the address") from None
    layers = {_text(layer, OWS + "Identifier"): layer for layer in root.iter(WMTS + "Layer")}
    if name not in layers:
        known = ", ".join(sorted(layers)[:20]) or "none"
        raise MapError(f"{url}: has no layer '{name}'; it has: {known}")
    layer = layers[name]
    sets = {_text(s, OWS + "Identifier"): s for s in root.iterfind(f"{WMTS}Contents/{WMTS}TileMatrixSet")}
    for link in layer.iter(WMTS + "TileMatrixSetLink"):
        set_name = _text(link, WMTS + "TileMatrixSet")
        if set_name in sets and _is_mercator(sets[set_name]):
            matrices, tile_px = _matrices(sets[set_name])
            if matrices:
                text = _template(root, layer, name, set_name, url)
                return WmtsLayer(UrlTemplate(text, matrices), tuple(sorted(matrices)), tile_px)
    raise MapError(f"{url}: layer '{name}' is not offered in Web Mercator (EPSG:3857); use another layer or server")


def _template(root: ElementTree.Element, layer: ElementTree.Element, name: str, set_name: str, url: str) -> str:
    """URL template: RESTful if the server supports it, else the key-value form of GetTile."""
    styles = [_text(s, OWS + "Identifier") for s in layer.iter(WMTS + "Style") if s.get("isDefault") == "true"]
    style = styles[0] if styles else _text(layer.find(f".//{WMTS}Style"), OWS + "Identifier")
    formats = [f.text or "" for f in layer.iter(WMTS + "Format")]
    offered = [f for f in FORMATS if f in formats]
    if not offered:
        raise MapError(f"{url}: layer '{name}' is offered as {', '.join(formats)} only; JPEG, PNG or WebP is needed")
    resources = {
        r.get("format"): r.get("template", "")
        for r in layer.iter(WMTS + "ResourceURL")
        if r.get("resourceType") == "tile"
    }
    for kind in offered:
        if kind in resources:
            text = re.sub(r"\{style\}", quote(style), resources[kind], flags=re.I)
            text = re.sub(r"\{tilematrixset\}", quote(set_name), text, flags=re.I)
            for dimension in layer.iter(WMTS + "Dimension"):
                default = _text(dimension, WMTS + "Default")
                text = text.replace("{" + _text(dimension, OWS + "Identifier") + "}", quote(default))
            return text
    operation = root.find(f".//{OWS}Operation[@name='GetTile']//{OWS}Get")
    base = operation.get(LINK, "") if operation is not None else ""
    base = base or url.split("?")[0]
    joint = "" if base.endswith(("?", "&")) else "&" if "?" in base else "?"
    return (
        f"{base}{joint}SERVICE=WMTS&REQUEST=GetTile&VERSION=1.0.0&LAYER={quote(name)}&STYLE={quote(style)}"
        f"&FORMAT={quote(offered[0])}&TILEMATRIXSET={quote(set_name)}&TILEMATRIX={{z}}&TILEROW={{y}}&TILECOL={{x}}"
    )


def _is_mercator(matrix_set: ElementTree.Element) -> bool:
    return re.search(r"EPSG:.*:(3857|900913)$", _text(matrix_set, OWS + "SupportedCRS")) is not None


def _matrices(matrix_set: ElementTree.Element) -> tuple[dict[int, str], int]:
    """Zoom -> name of the matrices that are tiles of the whole world, by corner and pixel size; side of the tiles."""
    found: dict[int, str] = {}
    side_px = 0
    for matrix in matrix_set.iter(WMTS + "TileMatrix"):
        try:
            width_px = int(_text(matrix, WMTS + "TileWidth"))
            pixel_m = float(_text(matrix, WMTS + "ScaleDenominator")) * PIXEL_M
            corner_m = float(_text(matrix, WMTS + "TopLeftCorner").split()[0])
        except (ValueError, IndexError):
            continue
        span_m = pixel_m * width_px
        zoom = next((z for z in range(MAX_ZOOM + 1) if abs(tile_span_m(z) / span_m - 1.0) < 1e-4), None)
        if zoom is None or abs(corner_m - WORLD_CORNER_M) > 1.0 or (side_px and width_px != side_px):
            continue
        side_px = width_px
        found[zoom] = _text(matrix, OWS + "Identifier")
    return found, side_px


def _text(element: ElementTree.Element | None, path: str) -> str:
    found = element.find(path) if element is not None else None
    return (found.text or "").strip() if found is not None else ""
