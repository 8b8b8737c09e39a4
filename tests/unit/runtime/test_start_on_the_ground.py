"""What `terrafix run` checks before the supervisor starts."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import map_rasters
from terrafix.core.errors import MapError, SourceError, UsageError
from terrafix_tools.live import package_for, package_for_in_child
from terrafix_tools.mapping.build import build


def test_errors_in_source_start_and_map_are_reported_before_take_off(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no source given"):
        package_for("", "", None, [])
    with pytest.raises(UsageError, match="write LAT,LON in degrees"):
        package_for("/dev/video0", "here", None, [])
    with pytest.raises(MapError, match="no map: give one with --map"):
        package_for("/dev/video0", "", None, [])
    with pytest.raises(MapError, match=r"none\.gpkg: no such map package"):
        package_for("/dev/video0", "", tmp_path / "none.gpkg", [])


def test_a_missing_map_is_rejected(data_set: Callable[[str], Path], tmp_path: Path) -> None:
    flight = data_set("flights/town-a")
    with pytest.raises(MapError, match=r"none\.tif: no such map"):
        package_for(str(flight), "", tmp_path / "none.tif", [])


def test_the_map_is_checked_in_a_child_process_with_the_same_result_and_errors(tmp_path: Path) -> None:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64))
    package = build(tif, tmp_path / "m.gpkg")
    assert package_for_in_child("/dev/video0", "", package, []) == package_for("/dev/video0", "", package, [])
    with pytest.raises(UsageError, match="write LAT,LON in degrees"):
        package_for_in_child("/dev/video0", "here", package, [])
    with pytest.raises(MapError, match=r"none\.gpkg: no such map package"):
        package_for_in_child("/dev/video0", "", tmp_path / "none.gpkg", [])


def test_the_supervisor_holds_none_of_the_libraries_that_check_the_map(tmp_path: Path) -> None:
    package = build(map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(64, 64)), tmp_path / "m.gpkg")
    code = f"""
import sys
from pathlib import Path
from terrafix_tools import cli
from terrafix_tools.live import package_for_in_child
import terrafix.runtime.supervisor
package_for_in_child("/dev/video0", "", Path({str(package)!r}), [])
print(*sorted({{"numpy", "cv2", "pyproj", "sqlite3", "PIL", "rasterio"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
