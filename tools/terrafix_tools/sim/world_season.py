"""How a generated place looks at a date: sun, crops, leaves, water, exposure."""

from dataclasses import dataclass

Bgr = tuple[int, int, int]


@dataclass(frozen=True)
class Season:
    name: str
    key: int  # seed of what this date alone decides
    sun_azimuth_deg: float
    sun_elevation_deg: float
    crops: tuple[tuple[Bgr, float], ...]  # mean colour, strength of the rows
    meadow: Bgr
    forest_floor: Bgr
    water: Bgr
    broadleaf: tuple[Bgr, ...]
    shadow: float  # brightness in the shadow, 0..1
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)  # exposure and white balance
    gamma: float = 1.0
    saturation: float = 0.75
    haze: float = 0.0  # share of bluish white mixed in


SUMMER = Season(
    "summer",
    key=1,
    sun_azimuth_deg=140.0,
    sun_elevation_deg=56.0,
    crops=(
        ((112, 186, 208), 0.06),  # ripe wheat
        ((96, 172, 190), 0.10),  # barley
        ((52, 112, 74), 0.12),  # maize
        ((62, 128, 96), 0.10),  # beet
        ((120, 168, 196), 0.16),  # stubble
        ((58, 138, 118), 0.08),  # young crop
    ),
    meadow=(74, 146, 112),
    forest_floor=(38, 62, 48),
    water=(92, 84, 56),
    broadleaf=((38, 88, 52), (44, 100, 66), (34, 78, 50)),
    shadow=0.45,
    gamma=1.0,
)
AUTUMN = Season(
    "autumn",
    key=2,
    sun_azimuth_deg=232.0,
    sun_elevation_deg=30.0,
    crops=(
        ((74, 92, 116), 0.20),  # ploughed, dry
        ((56, 70, 88), 0.22),  # ploughed, wet
        ((66, 124, 92), 0.10),  # winter wheat coming up
        ((70, 138, 100), 0.08),  # catch crop
        ((118, 150, 170), 0.16),  # maize stubble
        ((84, 108, 134), 0.12),  # harrowed
    ),
    meadow=(84, 130, 116),
    forest_floor=(58, 82, 98),
    water=(128, 118, 96),
    broadleaf=((48, 100, 142), (54, 116, 150), (50, 78, 112), (52, 100, 104)),
    shadow=0.55,
    gain=(1.16, 1.10, 1.15),
    gamma=1.05,
    haze=0.06,
)
SEASONS = {s.name: s for s in (SUMMER, AUTUMN)}
