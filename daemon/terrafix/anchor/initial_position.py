"""Initial position from a GNSS receiver, checked against the map and completed with the height of the map's ground."""

from terrafix.map.package import MapPackage
from terrafix.messages import GnssInitialPosition, InitialPosition, Verdict


def check_initial_position(gnss: GnssInitialPosition, package: MapPackage | None) -> InitialPosition:
    """The reply to a GnssInitialPosition: ACCEPTED with the ground's AMSL height if the map covers it, OUTSIDE_MAP
    without a position if it does not (the receiver or the loaded map is wrong), ACCEPTED without a position if the
    receiver has none."""
    lat_deg, lon_deg = gnss.lat_deg, gnss.lon_deg
    if lat_deg is None or lon_deg is None or gnss.sigma_m is None:
        return _unknown(gnss.t_ns, Verdict.ACCEPTED)
    if package is not None and not package.covers_start(lat_deg, lon_deg, gnss.sigma_m):
        return _unknown(gnss.t_ns, Verdict.OUTSIDE_MAP)
    return InitialPosition(
        t_ns=gnss.t_ns,
        verdict=Verdict.ACCEPTED,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        sigma_m=gnss.sigma_m,
        ground_amsl_m=None if package is None else package.ground_amsl_m(lat_deg, lon_deg),
    )


def _unknown(t_ns: int, verdict: Verdict) -> InitialPosition:
    return InitialPosition(t_ns=t_ns, verdict=verdict, lat_deg=None, lon_deg=None, sigma_m=None, ground_amsl_m=None)
