"""Appearance of a generated place at a date: sun, crops, leaves, water, exposure."""

from dataclasses import dataclass

Bgr = tuple[int, int, int]


@dataclass(frozen=True)
class Season:
    name: str
    key: int  # seed of everything specific to this date
    sun_azimuth_deg: float
    sun_elevation_deg: float
    crops: tuple[tuple[Bgr, float], ...]  # mean colour, contrast of the rows
    meadow: Bgr
    forest_floor: Bgr
    water: Bgr
    broadleaf: tuple[Bgr, ...]
    shadow: float  # brightness in the shadow, 0..1
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)  # exposure and white balance
    gamma: float = 1.0
    saturation: float = 0.75
    haze: float = 0.0  # share of bluish white


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
SPRING = Season(
    "spring",
    key=3,
    sun_azimuth_deg=118.0,
    sun_elevation_deg=42.0,
    crops=(
        ((64, 208, 214), 0.05),  # rape in flower
        ((58, 140, 92), 0.08),  # winter wheat
        ((66, 152, 108), 0.10),  # winter barley
        ((88, 118, 146), 0.18),  # seedbed, dry
        ((70, 94, 118), 0.20),  # seedbed, wet
        ((82, 126, 124), 0.14),  # sugar beet coming up
    ),
    meadow=(66, 156, 104),
    forest_floor=(60, 92, 92),
    water=(104, 98, 70),
    broadleaf=((62, 140, 110), (70, 128, 112), (58, 116, 96)),
    shadow=0.5,
    gain=(1.05, 1.06, 1.02),
    saturation=0.8,
    haze=0.03,
)
WINTER = Season(
    "winter",
    key=4,
    sun_azimuth_deg=196.0,
    sun_elevation_deg=22.0,
    crops=(
        ((78, 96, 114), 0.20),  # ploughed
        ((64, 80, 96), 0.22),  # ploughed, wet
        ((72, 112, 98), 0.09),  # winter wheat
        ((90, 124, 124), 0.12),  # dead catch crop
        ((104, 128, 142), 0.16),  # stubble
    ),
    meadow=(82, 116, 112),
    forest_floor=(70, 84, 94),
    water=(120, 112, 100),
    broadleaf=((72, 88, 98), (64, 80, 90), (80, 96, 104)),  # bare
    shadow=0.62,
    gain=(1.22, 1.16, 1.14),
    saturation=0.6,
    haze=0.09,
)
SEASONS = {s.name: s for s in (SUMMER, AUTUMN, SPRING, WINTER)}
