"""Which zones decide the thermal band: constants of a driver do not, chosen ones do, and which one decided is said."""

from collections.abc import Callable
from pathlib import Path

import pytest

from terrafix.core.config import Config, HealthSection
from terrafix.health.node import HealthNode
from terrafix.health.power import read_rails
from terrafix.health.sysfs import read_zones
from terrafix.messages import Health, TemperatureZone, ThermalBand, ThermalReading
from terrafix_tools.preflight.computer import temperature_line

S = 1_000_000_000


def sysfs(root: Path, *zones: tuple[str, str | None]) -> Path:
    """``zones``: type and content of temp; None: it cannot be read. -> class/thermal."""
    for i, (kind, temp) in enumerate(zones):
        folder = root / "class" / "thermal" / f"thermal_zone{i}"
        folder.mkdir(parents=True)
        (folder / "type").write_text(kind + "\n")
        if temp is not None:
            (folder / "temp").write_text(temp + "\n")
    return root / "class" / "thermal"


def health(node: HealthNode, zones: list[TemperatureZone], t_ns: int = 0) -> Health:
    (found,) = node.on(ThermalReading(t_ns=t_ns, zones=zones, throttling=[], disk_free_mb=1))
    assert isinstance(found, Health)
    return found


@pytest.mark.parametrize("name", ["PMIC-Die", "pmic-die", "PMIC_Die", "PMIC-Die-thermal"])
def test_the_die_of_the_pmic_at_its_normal_value_does_not_decide(name: str, tmp_path: Path) -> None:
    zones = read_zones(
        sysfs(tmp_path, ("AO-therm", "38500"), (name, "100000"), ("GPU-therm", "-256000"), ("cv0", None))
    )
    found = health(HealthNode(HealthSection()), zones)
    assert (found.band, found.temperature_c) == (ThermalBand.NORMAL, 38.5)
    assert (
        found.cause
        == f"AO-therm 38.5 C is the hottest zone; {name} 100.0 C is a constant of its driver and does not decide"
    )


@pytest.mark.parametrize("alarm_c", [120.0, 140.0])
def test_an_alarm_of_the_pmic_decides(alarm_c: float) -> None:
    zones = [
        TemperatureZone(name="CPU-therm", temperature_c=50.0),
        TemperatureZone(name="PMIC-Die", temperature_c=alarm_c),
    ]
    assert health(HealthNode(HealthSection()), zones).band is ThermalBand.CRITICAL


def test_a_zone_that_never_changes_while_others_do_stops_deciding_after_a_minute() -> None:
    node = HealthNode(HealthSection())
    bands = []
    for second in range(70):
        zones = [
            TemperatureZone(name="cpu", temperature_c=50.0 + 0.5 * (second % 3)),
            TemperatureZone(name="stuck-thermal", temperature_c=99.0),
        ]
        bands.append(health(node, zones, second * S).band)
    assert bands[:60] == [ThermalBand.CRITICAL] * 60 and bands[60:] == [ThermalBand.NORMAL] * 10
    moved = [TemperatureZone(name="cpu", temperature_c=50.0), TemperatureZone(name="stuck-thermal", temperature_c=99.5)]
    assert health(node, moved, 71 * S).band is ThermalBand.CRITICAL, "it measures after all"


def test_a_computer_whose_zones_all_stand_still_is_judged_by_them() -> None:
    node = HealthNode(HealthSection())
    zones = [TemperatureZone(name="cpu", temperature_c=96.0), TemperatureZone(name="gpu", temperature_c=60.0)]
    assert {health(node, zones, second * S).band for second in range(0, 200, 10)} == {ThermalBand.CRITICAL}


def test_zones_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    zones = read_zones(sysfs(tmp_path, ("CPU-therm", "40000"), ("GPU-therm", "41000"), ("CPU-therm", "97000")))
    assert [zone.name for zone in zones] == ["CPU-therm (thermal_zone0)", "GPU-therm", "CPU-therm (thermal_zone2)"]
    found = health(HealthNode(HealthSection()), zones)
    assert found.band is ThermalBand.CRITICAL and found.cause.startswith(
        "CPU-therm (thermal_zone2) 97.0 C; critical from"
    )


@pytest.mark.parametrize(
    ("chosen", "decides"),
    [
        (["GPU-therm"], "GPU-therm"),
        (["CPU-therm"], "CPU-therm (thermal_zone2)"),
        (["CPU-therm (thermal_zone0)"], "CPU-therm (thermal_zone0)"),
        (["PMIC-Die", "GPU-therm"], "PMIC-Die"),
    ],
)
def test_health_zones_chooses(chosen: list[str], decides: str, tmp_path: Path) -> None:
    thermal = sysfs(
        tmp_path, ("CPU-therm", "40000"), ("GPU-therm", "41000"), ("CPU-therm", "60000"), ("PMIC-Die", "100000")
    )
    section = HealthSection(zones=chosen, sysfs_root=str(tmp_path))
    assert health(HealthNode(section), read_zones(thermal)).cause.startswith(f"{decides} ")
    assert decides in temperature_line(Config(health=section)).text


def test_chosen_zones_that_are_not_there_are_said(tmp_path: Path) -> None:
    thermal = sysfs(tmp_path, ("CPU-therm", "99000"))
    section = HealthSection(zones=["soc"], sysfs_root=str(tmp_path))
    found = health(HealthNode(section), read_zones(thermal))
    assert (found.band, found.cause) == (ThermalBand.NORMAL, "no zone of [health] zones is readable: taken for normal")
    assert "choose among: CPU-therm" in temperature_line(Config(health=section)).fix


def rail_files(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True)
    for name, text in files.items():
        (folder / name).write_text(text + "\n")


def test_shunts_and_sums_of_an_ina3221_are_no_rails_and_a_power_counts_once(tmp_path: Path) -> None:
    rail_files(
        tmp_path / "hwmon0", name="ina3221", in1_label="VDD_IN", in1_input="5000", curr1_input="1800", in4_input="9",
        curr4_input="2800", in5_input="3", curr5_input="1", in7_label="sum of shunt voltages", in7_input="12",
    )  # fmt: skip
    rail_files(
        tmp_path / "hwmon1",
        name="ina226",
        in0_input="3",
        in1_input="12000",
        curr1_input="1000",
        power1_input="12100000",
    )
    assert [(rail.name, rail.power_w) for rail in read_rails(tmp_path)] == [("VDD_IN", 9.0), ("ina226 power1", 12.1)]


def test_the_boards_of_the_field_are_read_right(data_set: Callable[[str], Path]) -> None:
    field = data_set("field")
    found = health(HealthNode(HealthSection()), read_zones(field / "jetson-pmic" / "sysfs" / "class" / "thermal"))
    assert (found.band, found.temperature_c) == (ThermalBand.NORMAL, 38.5) and "PMIC-Die" in found.cause
    rails = {rail.name: rail.power_w for rail in read_rails(field / "ina3221" / "hwmon")}
    assert rails == {"VDD_IN": 9.0, "VDD_CPU_GPU_CV": 3.0, "VDD_SOC": 2.0}
