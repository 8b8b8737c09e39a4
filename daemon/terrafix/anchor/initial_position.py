"""A start that a GNSS receiver says, on the map: taken where there is imagery, with the height of the ground there."""

from terrafix.map.package import MapPackage
from terrafix.messages import GnssStart, Start, Verdict


def answered(said: GnssStart, package: MapPackage | None) -> Start:
    """Who prepared a map takes off on it: a start elsewhere is a wrong one, or a wrong map."""
    lat_deg, lon_deg = said.lat_deg, said.lon_deg
    if lat_deg is None or lon_deg is None or said.sigma_m is None:
        return _unknown(said.t_ns, Verdict.ACCEPTED)
    if package is not None and not package.covers_start(lat_deg, lon_deg, said.sigma_m):
        return _unknown(said.t_ns, Verdict.OUTSIDE_MAP)
    return Start(
        t_ns=said.t_ns,
        verdict=Verdict.ACCEPTED,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        sigma_m=said.sigma_m,
        ground_amsl_m=None if package is None else package.ground_amsl_m(lat_deg, lon_deg),
    )


def _unknown(t_ns: int, verdict: Verdict) -> Start:
    return Start(t_ns=t_ns, verdict=verdict, lat_deg=None, lon_deg=None, sigma_m=None, ground_amsl_m=None)
