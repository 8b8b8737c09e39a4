"""Generates the tables of docs/inputs.md: what is read from outside, in which unit and datum, what is assumed and what
is refused. Every row names the tests that hold it. Run this file to write the tables into the page."""

import re
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


MAP_INPUTS: tuple[Row, ...] = ()

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
        "0/0/0, and a heading of zero in all photos: not reported",
        "-",
        (
            "vision/test_photo_makers.py",
            (
                "test_attitudes_of_several_makers_are_those_of_one_vehicle",
                "test_gimbal_angles_of_zero_leave_the_flights_heading_and_a_wide_mount",
                "test_what_is_exactly_zero_in_all_photos_is_not_reported",
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
        "jumps above 1 s and damaged stamps are repaired by the autopilot's time; without it a jump counts as no gap",
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
        made = table(rows)
        text, count = re.subn(
            rf"(<!-- table: {name} -->).*?(<!-- end -->)", lambda m, t=made: f"{m[1]}\n{t}\n{m[2]}", text, flags=re.S
        )
        assert count == 1, f"{PAGE}: the marks of the table '{name}' are missing"
    return text


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
