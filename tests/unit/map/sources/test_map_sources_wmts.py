"""WMTS servers, with requests according to their capabilities."""

from pathlib import Path

import pytest

import map_servers
from map_servers import Reply, Request, serving
from terrafix.core.errors import MapError
from terrafix_tools.mapping.area.files import read_area
from terrafix_tools.mapping.sources.spec import SourceSpec
from terrafix_tools.mapping.sources.tiles.job import TileJob
from terrafix_tools.mapping.sources.tiles.wmts import read_capabilities

WORLD = map_servers.pyramid(3, 4, zoom=16)


CAPABILITIES = """<?xml version="1.0"?>
<Capabilities xmlns="http://www.opengis.net/wmts/1.0" xmlns:ows="http://www.opengis.net/ows/1.1"
 xmlns:xlink="http://www.w3.org/1999/xlink" version="1.0.0">
 <ows:OperationsMetadata><ows:Operation name="GetTile"><ows:DCP><ows:HTTP>
  <ows:Get xlink:href="{url}/kvp?"/></ows:HTTP></ows:DCP></ows:Operation></ows:OperationsMetadata>
 <Contents>
  <Layer><ows:Title>Ortho</ows:Title><ows:Identifier>ortho</ows:Identifier>
   <Style isDefault="true"><ows:Identifier>day</ows:Identifier></Style><Format>image/png</Format>
   <TileMatrixSetLink><TileMatrixSet>national</TileMatrixSet></TileMatrixSetLink>
   <TileMatrixSetLink><TileMatrixSet>google</TileMatrixSet></TileMatrixSetLink>{resource}</Layer>
  <Layer><ows:Identifier>national only</ows:Identifier><Style><ows:Identifier>s</ows:Identifier></Style>
   <Format>image/png</Format><TileMatrixSetLink><TileMatrixSet>national</TileMatrixSet></TileMatrixSetLink></Layer>
  <TileMatrixSet><ows:Identifier>national</ows:Identifier>
   <ows:SupportedCRS>urn:ogc:def:crs:EPSG::28992</ows:SupportedCRS><TileMatrix><ows:Identifier>0</ows:Identifier><ScaleDenominator>1</ScaleDenominator>
    <TopLeftCorner>0 0</TopLeftCorner><TileWidth>256</TileWidth><TileHeight>256</TileHeight>
   </TileMatrix></TileMatrixSet>
  <TileMatrixSet><ows:Identifier>google</ows:Identifier><ows:SupportedCRS>urn:ogc:def:crs:EPSG::3857</ows:SupportedCRS>
   <TileMatrix><ows:Identifier>g:16</ows:Identifier><ScaleDenominator>8530.918335353</ScaleDenominator>
    <TopLeftCorner>-20037508.3428 20037508.3428</TopLeftCorner><TileWidth>256</TileWidth><TileHeight>256</TileHeight>
   </TileMatrix>
   <TileMatrix><ows:Identifier>odd</ows:Identifier><ScaleDenominator>6000</ScaleDenominator>
    <TopLeftCorner>-20037508.3428 20037508.3428</TopLeftCorner><TileWidth>256</TileWidth><TileHeight>256</TileHeight>
   </TileMatrix></TileMatrixSet>
 </Contents></Capabilities>"""
REST = '<ResourceURL format="image/png" resourceType="tile" template="{url}/r/{Style}/{TileMatrixSet}/{TileMatrix}/{TileRow}/{TileCol}.png"/>'  # noqa: E501


@pytest.mark.parametrize("restful", [True, False])
def test_wmts_requests_follow_the_capabilities(tmp_path: Path, restful: bool) -> None:
    def answer(request: Request) -> Reply:
        if request.path.startswith("/caps"):
            resource = REST.replace("{url}", server.url) if restful else ""
            text = CAPABILITIES.replace("{url}", server.url).replace("{resource}", resource)
            return Reply(body=text.encode())
        if restful:
            _, r, style, google, matrix, row, column = request.path.removesuffix(".png").split("/")
            assert (r, style, google, matrix) == ("r", "day", "google", "g%3A16")
        else:
            values = dict(pair.split("=") for pair in request.path.removeprefix("/kvp?").split("&"))
            assert values["REQUEST"] == "GetTile" and values["LAYER"] == "ortho" and values["TILEMATRIX"] == "g%3A16"
            assert values["STYLE"] == "day" and values["TILEMATRIXSET"] == "google" and values["FORMAT"] == "image/png"
            row, column = values["TILEROW"], values["TILECOL"]
        data = WORLD.tile(16, int(column), int(row))
        return Reply(404) if data is None else Reply(body=data)

    area = read_area(WORLD.box_deg(0.2), buffer_km=0.0)
    with serving(answer) as server:
        spec = SourceSpec(wmts=server.url + "/caps", layer_name="ortho", licence="CC0", requests_per_s=500)
        job = TileJob(spec, area, 0.1, tmp_path)  # finer than the server provides: its finest level is used
        assert job.estimate().items == 12
        job.fetch(lambda _: None)
    with job.openers()[0]() as imagery:
        image, mask = imagery.read(0, 0, imagery.width_px, imagery.height_px)
    assert mask.all() and (image == WORLD.image).all()


@pytest.mark.parametrize(
    ("layer", "data", "reason"),
    [
        ("orto", CAPABILITIES, "no layer 'orto'; it has: national only, ortho"),
        ("national only", CAPABILITIES, "not offered in Web Mercator"),
        ("ortho", CAPABILITIES.replace("image/png", "image/tiff"), "offered as image/tiff only"),
        ("ortho", "<html>", "no WMTS capabilities"),
    ],
)
def test_unusable_wmts_capabilities_are_reported(layer: str, data: str, reason: str) -> None:
    with pytest.raises(MapError, match=reason):
        read_capabilities(data.replace("{resource}", "").encode(), layer, "http://h")
