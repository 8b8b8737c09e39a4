"""Error that all map matches share, so that no number of them averages it away.

Beside the registration error that the map package states, what stands above the ground looks displaced by its shadow
where the sun of the frame is not that of the map: all trees of an orchard by the same metres, whichever way the vehicle
flies over them."""

# 1-sigma per axis of the mean displacement of a frame's matches over a map without an error: root mean square of 0.98 m
# along the axis on which the suns differ most, and 0.60 m across it; which axis that is, is not known in flight.
ILLUMINATION_SIGMA_M = 0.81  # [measured: docs/integrity.md]


def illumination_variance_m2(map_sigma_m: float) -> float:
    """Variance per horizontal axis by shadows. ``map_sigma_m``: 1-sigma of the map; 0 means that there was no match."""
    return ILLUMINATION_SIGMA_M**2 if map_sigma_m else 0.0


def shared_variance_m2(map_sigma_m: float) -> float:
    """Variance per horizontal axis of a position by matches with a map of 1-sigma ``map_sigma_m``, shadows included."""
    return map_sigma_m**2 + illumination_variance_m2(map_sigma_m)
