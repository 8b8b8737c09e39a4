"""What `terrafix run` checks before the supervisor starts."""

from collections.abc import Callable
from pathlib import Path

import pytest

from terrafix.core.errors import MapError, SourceError, UsageError
from terrafix_tools.live import package_for


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
