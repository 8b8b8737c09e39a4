"""UTM zones of WGS84."""


def utm_epsg(lon_deg: float, lat_deg: float) -> int:
    """EPSG 326zz north of the equator, 327zz south of it; without the exceptions of Norway and Svalbard."""
    zone = int((lon_deg + 180.0) // 6.0) % 60 + 1
    return (32600 if lat_deg >= 0 else 32700) + zone
