"""Ids of flights and frames that are unique over all flights."""

from pathlib import Path
from uuid import UUID

import msgspec
import numpy as np
import pytest

from terrafix.core import flight_id
from terrafix.core.flight_id import frame_uid, live_flight_id, recorded_flight_id
from terrafix.messages import Frame
from terrafix_tools.estimates import RowTable
from vision_origin import PINHOLE_ORIGIN as ORIGIN

FIRST = np.full((4, 6, 3), 7, np.uint8)


def test_flights_differ_by_boot_and_zero_and_recordings_by_what_they_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = live_flight_id(5_000)
    boot = tmp_path / "boot_id"
    boot.write_text("4c3b5e0a-0d5e-4f5e-8a43-7b1d3c0e9f11\n", encoding="ascii")
    monkeypatch.setattr(flight_id, "BOOT_ID_FILE", boot)
    ids = [here, live_flight_id(5_000), live_flight_id(5_001)]
    ids += [recorded_flight_id(ORIGIN, image) for image in (None, FIRST, FIRST + 1)]
    assert len({UUID(found) for found in ids}) == len(ids)
    assert recorded_flight_id(ORIGIN, FIRST.copy()) == ids[4] and live_flight_id(5_000) == ids[1]


@pytest.mark.parametrize("of", ["684103f7-867f-415a-b086-96d3fd85fb1a", ""])
def test_a_row_names_its_frame_over_all_flights(of: str) -> None:
    table = RowTable()
    table.take(msgspec.structs.replace(ORIGIN, flight_id=of))
    table.take(Frame(t_ns=0, frame_id=17, file="a.jpg", width=6, height=4))
    assert table.rows[17].frame_uid == frame_uid(of, 17) == (f"{of}/17" if of else "")
