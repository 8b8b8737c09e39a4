"""Generates the tables of docs/inputs.md: what is read from outside, in which unit and datum, what is assumed and what
is refused. Every row names the tests that hold it. Run this file to write the tables into the page."""

from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "inputs.md"


@dataclass(frozen=True)
class Row:
    """``tests``: file below tests/unit and names of its test functions, which hold the row."""

    quantity: str
    comes_from: str
    unit: str
    datum: str
    assumed: str
    refused: str
    tests: tuple[str, tuple[str, ...]]


MAP_INPUTS: tuple[Row, ...] = (
    Row(
        "heights, unit", "unit of the band; else the vertical coordinate system; `--dem-unit`",
        "any length of PROJ's database, converted to metres; depths become negative", "-",
        "metres, where file and coordinates say nothing else",
        "unknown unit; band and vertical system that differ; no unit beside coordinates in feet",
        ("map/inputs/test_elevation_units.py", (
            "test_heights_are_converted_from_the_unit_of_the_band",
            "test_heights_are_converted_from_the_unit_of_the_vertical_system",
            "test_a_unit_or_datum_that_is_not_known_is_asked_for",
            "test_a_stated_unit_and_datum_count_and_are_in_the_manifest",
            "test_every_elevation_of_the_field_has_its_height",
        )),
    ),
    Row(
        "heights, values", "scale and offset of the band", "(raw x scale + offset) units", "-",
        "an undeclared void is an implausible height", "a scale of 0, nan",
        ("map/inputs/test_elevation_units.py", (
            "test_scale_and_offset_of_the_band_are_applied", "test_feet_with_a_scale_are_both",
            "test_a_drape_of_a_simulated_flight_converts_feet_too",
        )),
    ),
    Row(
        "heights, datum", "vertical system, or a coordinate system of three dimensions; `--dem-datum`", "m",
        "EGM96: ellipsoidal and EGM2008 heights by their grids, national ones by PROJ's operation",
        "EGM96 where nothing is said; EGM2008 and national heights as they are, where PROJ lacks the grid, which is "
        "named with the error",
        "ellipsoidal heights without a grid",
        ("map/inputs/test_elevation_units.py", (
            "test_ellipsoidal_heights_of_the_file_are_converted_or_refused",
            "test_a_vertical_system_with_the_name_of_an_ellipsoid_counts_from_it",
            "test_what_is_assumed_of_a_plain_file_is_in_the_manifest_and_in_map_check",
        )),
    ),
    Row(
        "imagery, datum", "coordinate system of the file", "that of its coordinates",
        "WGS 84 by the operation that PROJ uses there",
        "WGS 84 of a datum that is not named on its ellipsoid or GRS 80 (4 m); the shift that a file states itself",
        "a datum that is not named, or for which PROJ has no operation, on any other ellipsoid",
        ("map/inputs/test_image_datums.py", (
            "test_a_datum_that_is_not_named_is_refused", "test_a_shift_of_zero_from_another_ellipsoid_is_no_datum",
            "test_a_datum_without_a_way_to_wgs84_is_refused",
            "test_an_ellipsoid_about_the_earths_centre_is_wgs84_with_a_word_and_an_accuracy",
            "test_a_named_datum_without_a_code_is_that_datum", "test_the_datums_of_the_field",
        )),
    ),
    Row(
        "imagery, accuracy", "`--ce90`, `ce90_m`; PROJ's accuracy of the operation", "m, radius of 90 %", "-",
        "no better than the operation; a grid that PROJ lacks is named; the grid must be on the vehicle, too "
        "(`preflight`)",
        "-",
        ("map/inputs/test_image_datums.py", (
            "test_the_accuracy_is_not_below_what_proj_states_and_a_missing_grid_is_named",
            "test_an_accuracy_that_is_not_stated_is_that_of_a_datum_worse_than_the_default",
            "test_a_vehicle_without_the_grid_of_the_build_is_told",
        )),
    ),
    Row(
        "imagery, place", "geotransform", "-", "-", "-",
        "ground control points, RPC or arrays of positions alone: the line of gdalwarp is in the message",
        ("map/inputs/test_image_datums.py", ("test_an_image_without_a_grid_names_the_command_that_makes_one",)),
    ),
    Row(
        "imagery, mask", "alpha; else mask band; else nodata; else the collar on the image's own pixels", "-", "-",
        "alpha instead of nodata; a nodata value that the pixels cannot hold is ignored",
        "an image without a valid pixel",
        ("map/inputs/test_image_masks.py", (
            "test_alpha_wins_over_nodata", "test_an_alpha_band_in_any_place_is_the_mask",
            "test_nodata_that_8_bits_cannot_hold_is_ignored_with_a_word",
            "test_a_collar_is_found_on_every_grid", "test_a_warped_source_of_a_mosaic_has_no_collar_either",
            "test_the_masks_of_the_field",
        )),
    ),
    Row(
        "rows of MBTiles", "`tile_row`, bounds, scheme", "tiles", "WGS 84, Web Mercator",
        "from the north where only so the bounds fit, or the scheme says so without bounds; else from the south; "
        "bounds that fit neither are named",
        "rows and zooms that do not exist",
        ("map/inputs/test_tile_rows.py", (
            "test_rows_from_either_side_are_read_where_the_bounds_say_which",
            "test_without_bounds_the_scheme_counts_and_without_both_the_specification",
            "test_bounds_that_fit_neither_reading_are_named", "test_the_tile_files_of_the_field",
        )),
    ),
    Row(
        "area", "KML (any encoding, KMZ, gx:Track, DJI's way points), GeoJSON, a box", "degrees", "WGS 84",
        "points alone are a path in their order; points beside outlines and links to other documents are left out",
        "decimal commas; a single point; a link alone",
        ("map/inputs/test_area_files.py", (
            "test_a_kml_is_read_in_its_encoding_declared_or_not",
            "test_spaces_behind_commas_are_read_and_decimal_commas_refused",
            "test_a_track_and_the_points_of_a_planner_are_paths", "test_a_link_to_another_document_is_named",
            "test_an_archive_is_read_by_its_document",
            "test_every_area_of_the_field_has_its_size_or_is_refused",
        )),
    ),
    Row(
        "mission, positions", "QGC WPL 110 and 120, plans of all versions of QGroundControl",
        "degrees, or 1e-7 degrees", "WGS 84",
        "items without a position are flown where the vehicle is; an unknown command or frame is named once",
        "positions in metres; a mission without any position",
        ("map/inputs/test_mission_dialects.py", (
            "test_every_mission_of_the_field_gives_its_area",
            "test_a_command_adds_its_position_only_when_it_is_flown_to",
            "test_an_unknown_command_is_named_once_with_its_items", "test_version_120_has_no_home_row",
            "test_plans_of_all_versions_of_qgroundcontrol_are_read",
            "test_positions_in_scaled_integers_are_degrees_and_those_in_metres_are_refused",
        )),
    ),
)  # fmt: skip

FLIGHT_INPUTS: tuple[Row, ...] = (
    Row(
        "focal length of photos",
        "EXIF, XMP of DJI and Pix4D, sensor table",
        "px of the stored photo",
        "-",
        "digital zoom is not in FocalLength or the calibration; resized by EXIF's size, else by the principal point",
        "cut; calibration that FocalLengthIn35mmFilm contradicts; zoom with the 35 mm equivalent alone",
        (
            "vision/test_photo_makers.py",
            (
                "test_the_digital_zoom_multiplies_the_focal_length_of_the_lens",
                "test_calibration_and_principal_point_are_scaled_with_the_photo",
                "test_a_calibration_of_another_size_or_lens_is_refused_with_the_reason",
                "test_a_zoom_with_the_35_mm_equivalent_alone_is_refused_since_makers_differ",
            ),
        ),
    ),
    Row(
        "lenses of a folder of photos",
        "focal length over width of each photo",
        "-",
        "-",
        "up to a tenth of another lens is left out",
        "several lenses or zooms, both groups named",
        (
            "vision/test_photo_makers.py",
            (
                "test_photos_of_two_lenses_are_refused_with_both_groups",
                "test_a_few_photos_of_another_lens_are_left_out_with_a_word",
            ),
        ),
    ),
    Row(
        "attitude of photos",
        "XMP of DJI (gimbal), Autel and Pix4D (Camera), Parrot",
        "degrees",
        "true north; DJI: pitch from the horizon; Pix4D: from straight down, below -45 from the horizon",
        "1-sigma of the tilt 9 degrees, unless flight.toml says it; 0/0/0, headings that are all zero: not reported; "
        "yaws of gimbal and flight more than 30 degrees apart are the 1-sigma of the heading",
        "-",
        (
            "vision/test_photo_makers.py",
            (
                "test_attitudes_of_several_makers_are_those_of_one_vehicle",
                "test_gimbal_angles_of_zero_leave_the_flights_heading_and_a_wide_mount",
                "test_a_stated_accuracy_of_the_tilt_replaces_that_of_photos",
                "test_what_is_exactly_zero_in_all_photos_is_not_reported",
                "test_a_gimbal_yaw_far_from_that_of_the_flight_widens_the_heading",
            ),
        ),
    ),
    Row(
        "height of photos",
        "RelativeAltitude (DJI), AboveGroundAltitude (Autel, Pix4D)",
        "m",
        "above take-off; above ground",
        "zero in all photos: not reported",
        "a median above 5000 m",
        ("vision/test_photo_makers.py", ("test_the_height_of_autel_and_pix4d_is_read",)),
    ),
    Row(
        "files in a folder of photos",
        "names",
        "-",
        "-",
        "`._*`, `Thumbs.db` and other files are left out",
        "a folder without photos",
        ("vision/test_photo_makers.py", ("test_files_of_macos_and_windows_beside_photos_are_left_out",)),
    ),
    Row(
        "clock of a telemetry log",
        "time stamps of the records",
        "microseconds",
        "since 1970, of the logging computer",
        "jumps above 1 s and damaged stamps are repaired by the autopilot's time; without it a jump is no gap",
        "packets without time stamps",
        (
            "autopilot_log/test_log_clock_and_vehicles.py",
            (
                "test_a_jump_of_the_logs_clock_is_repaired_by_the_autopilots_own_time_and_said",
                "test_one_damaged_bit_of_a_time_stamp_costs_nothing",
                "test_without_the_autopilots_time_a_jump_is_taken_for_no_gap_and_said",
                "test_a_stream_of_packets_without_time_stamps_is_no_log",
            ),
        ),
    ),
    Row(
        "vehicle of a telemetry log",
        "system ids of autopilots",
        "-",
        "-",
        "the only one that moves; `--system`, `[telemetry] system_id` choose",
        "several that move",
        (
            "autopilot_log/test_log_clock_and_vehicles.py",
            (
                "test_of_two_vehicles_the_one_that_moves_is_read_and_both_are_named",
                "test_the_vehicle_of_a_log_is_chosen_by_system_and_by_system_id",
                "test_of_two_vehicles_that_fly_none_is_guessed",
            ),
        ),
    ),
    Row(
        "flight modes",
        "custom_mode by MAV_TYPE, or the firmware's banner",
        "-",
        "-",
        "an unknown type has numbers",
        "-",
        (
            "autopilot_log/test_log_clock_and_vehicles.py",
            ("test_modes_are_named_by_the_type_of_the_vehicle_and_unknown_types_have_no_names",),
        ),
    ),
    Row(
        "DataFlash log",
        "messages FMT anywhere in the file",
        "as its format characters say",
        "start of the autopilot; logs of 2013: GPS week",
        "lost, zero and foreign bytes are skipped and counted",
        "a file without a whole FMT",
        (
            "autopilot_log/test_dataflash_damage.py",
            (
                "test_lost_zero_and_foreign_bytes_are_skipped_and_counted",
                "test_a_text_log_of_2013_has_its_times_from_the_gps_and_names_of_modes",
                "test_what_has_no_whole_format_is_no_log",
            ),
        ),
    ),
    Row(
        "telemetry of GoPro",
        "GPMF in the video: GPS5, GPS9",
        "degrees",
        "WGS 84",
        "positions are truth; inertial streams and orientation are not read, since their axes are not stated",
        "-",
        ("vision/test_source_gpmf.py", ("test_positions_of_a_gopro_are_truth_at_the_times_of_the_frames",)),
    ),
    Row(
        "topics of a ROS bag",
        "types, mavros's names; `--topic`, `[source] topics`",
        "SI; headings in degrees",
        "east, north, up; forward, left, up (REP 103, 145)",
        "a true heading in the orientation of Imu; stamps 10 s from the time of recording are of another clock; an "
        "orientation that never changes: not reported; NavSatFix is not read",
        "several topics of a kind; no images; no CameraInfo",
        (
            "vision/test_source_rosbag.py",
            (
                "test_telemetry_of_a_bag_is_in_the_axes_of_the_vehicle",
                "test_several_topics_are_asked_for_and_chosen",
                "test_stamps_of_another_clock_give_way_to_the_times_of_recording",
                "test_an_orientation_that_never_changes_is_not_reported",
                "test_positions_of_a_bag_are_truth_and_nothing_else",
            ),
        ),
    ),
    Row(
        "temperature",
        "thermal zones of sysfs",
        "0.001 degrees Celsius",
        "-",
        "PMIC-Die at 100, and what never changes, does not decide; `[health] zones` chooses",
        "outside of -55 to 150 degrees",
        (
            "health/test_zones.py",
            (
                "test_the_die_of_the_pmic_at_its_normal_value_does_not_decide",
                "test_a_zone_that_never_changes_while_others_do_stops_deciding_after_a_minute",
                "test_health_zones_chooses",
            ),
        ),
    ),
    Row(
        "power",
        "hwmon",
        "mV, mA, microwatts",
        "-",
        "-",
        "shunts and sums of an INA3221",
        ("health/test_zones.py", ("test_shunts_and_sums_of_an_ina3221_are_no_rails_and_a_power_counts_once",)),
    ),
)

TABLES = {"map": MAP_INPUTS, "flight": FLIGHT_INPUTS}


def table(rows: tuple[Row, ...]) -> str:
    lines = ["| quantity | comes from | unit | datum | assumed, and said | refused |", "|---|---|---|---|---|---|"]
    for row in rows:
        file, _ = row.tests
        held = f"[{row.quantity}](../tests/unit/{file})"
        lines.append(f"| {held} | {row.comes_from} | {row.unit} | {row.datum} | {row.assumed} | {row.refused} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """The text of the page with all tables generated."""
    for name, rows in TABLES.items():
        start, end = text.index(f"<!-- table: {name} -->"), text.index("<!-- end -->", text.index(f"table: {name}"))
        text = f"{text[:start]}<!-- table: {name} -->\n{table(rows)}\n{text[end:]}"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
