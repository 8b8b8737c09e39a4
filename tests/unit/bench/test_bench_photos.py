"""Generated photos of the benchmark: content, and metadata as of a survey camera."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

import map_rasters
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.vision.sources import open_source
from terrafix_lab.bench.photos import ADVANCE, FOCAL, SEEN_PX, write_photos

SIZE_PX = 1200, 800


@pytest.mark.slow
def test_photos_have_content_and_metadata_of_their_positions(tmp_path: Path) -> None:
    both = map_rasters.utm(tmp_path / "a.tif", map_rasters.texture(1300, 900))
    write_photos(both, both, tmp_path / "photos", SIZE_PX)
    source = open_source(str(tmp_path / "photos"))
    shots, origin = list(source.shots()), source.origin()
    assert origin.camera.fx == pytest.approx(FOCAL * SIZE_PX[0], abs=0.01)
    rows = list(csv.DictReader((tmp_path / "photos" / "truth.csv").read_text(encoding="utf-8").splitlines()))
    frame = LocalFrame(origin.lat_deg, origin.lon_deg)
    first, last = (np.array(frame.to_local(float(r["lat_deg"]), float(r["lon_deg"]))[:2]) for r in (rows[0], rows[-1]))
    assert np.hypot(*first) < 0.01  # the start is the GPS of the first photo
    path_m = 5 * ADVANCE * SIZE_PX[1] * SEEN_PX / SIZE_PX[0] * 0.5
    assert np.hypot(*(last - first)) == pytest.approx(path_m, rel=1e-3)
    yaw_rad = shots[0].states[0].yaw_rad
    assert yaw_rad is not None
    assert math.remainder(math.atan2(*(last - first)) - yaw_rad, math.tau) == pytest.approx(0.0, abs=1e-3)
    assert shots[0].states[0].agl_m == pytest.approx(SEEN_PX * 0.5 * FOCAL, rel=1e-3)
    # The flight direction is the image top: the second photo is the first one, shifted down.
    one, two = (shot.image for shot in shots[:2])
    assert one is not None and two is not None
    shift_px = round(ADVANCE * SIZE_PX[1])
    correlation = np.corrcoef(one[:-shift_px, :, 1].ravel(), two[shift_px:, :, 1].ravel())[0, 1]
    assert correlation > 0.9


def test_imagery_that_is_too_small_raises_a_map_error(tmp_path: Path) -> None:
    small = map_rasters.utm(tmp_path / "a.tif", map_rasters.texture(800, 900))
    with pytest.raises(MapError, match="too small"):
        write_photos(small, small, tmp_path / "photos", SIZE_PX)
