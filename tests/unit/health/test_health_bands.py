"""Health from a sysfs tree: zones, throttling, hysteresis, and files that cannot be read."""

import io
import json
from pathlib import Path

import pytest

from terrafix.core import logs
from terrafix.core.config import Config, HealthSection
from terrafix.core.errors import ConfigError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.health.node import HealthNode, make_edge, make_node
from terrafix.messages import Health, TemperatureZone, ThermalBand, ThermalReading

SECOND_NS = 1_000_000_000


def settings(**values: object) -> HealthSection:
    return HealthSection(**({"hot_c": 80.0, "critical_c": 95.0, "hysteresis_c": 5.0} | values))  # type: ignore[arg-type]


def evaluate(node: HealthNode, temperature_c: float | None, *throttling: str) -> Health:
    zones = [] if temperature_c is None else [TemperatureZone(name="cpu-thermal", temperature_c=temperature_c)]
    (health,) = node.on(ThermalReading(t_ns=5, zones=zones, throttling=list(throttling), disk_free_mb=7))
    assert isinstance(health, Health)
    return health


@pytest.mark.parametrize(
    ("temperatures_c", "bands"),
    [
        ([70, 79.9, 80.0, 79.0, 75.1, 75.0, 79.9, 80.0], "nnhhhnnh"),
        ([94.9, 95.0, 94.0, 90.1, 90.0, 76.0, 75.0], "hccchhn"),
        ([100.0, 20.0], "cn"),
        ([20.0, 100.0], "nc"),
    ],
)
def test_bands_are_entered_at_the_limit_and_left_below_it(temperatures_c: list[float], bands: str) -> None:
    node = HealthNode(settings())
    assert "".join(evaluate(node, t).band[0] for t in temperatures_c) == bands


def test_without_hysteresis_a_band_is_left_at_its_limit() -> None:
    node = HealthNode(settings(hysteresis_c=0.0))
    assert "".join(evaluate(node, t).band[0] for t in (80.0, 79.99, 80.0, 95.0, 94.99)) == "hnhch"


def test_throttling_gives_at_least_the_band_hot_while_it_lasts() -> None:
    node = HealthNode(settings())
    hot = evaluate(node, 60.0, "cpu-throttle-alert")
    assert (hot.band, hot.throttled) == (ThermalBand.HOT, True)
    assert hot.cause == "cpu-thermal 60.0 C is the hottest zone; throttled by cpu-throttle-alert"
    assert evaluate(node, 60.0).band is ThermalBand.NORMAL, "no hysteresis after the end of throttling"
    assert evaluate(node, 96.0, "cpu-throttle-alert").band is ThermalBand.CRITICAL


def test_without_a_readable_zone_the_band_is_normal_and_the_cause_states_it() -> None:
    health = evaluate(HealthNode(settings()), None)
    assert (health.band, health.temperature_c, health.disk_free_mb, health.t_ns) == (ThermalBand.NORMAL, None, 7, 5)
    assert health.cause == "no temperature zone is readable: taken for normal"


def test_a_critical_limit_below_the_hot_limit_is_rejected() -> None:
    with pytest.raises(ConfigError, match=r"\[health\] critical_c = 70 is not above hot_c = 80; raise critical_c"):
        HealthNode(settings(critical_c=70.0))


def write(root: Path, name: str, **files: str) -> None:
    folder = root / "class" / "thermal" / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        (folder / file).write_text(text + "\n")


def context(tmp_path: Path) -> NodeContext:
    config = Config(health=settings(sysfs_root=str(tmp_path)))
    return NodeContext(config=config, frames=MemoryFrameStore(1), map_path=None, out_dir=tmp_path)


def test_a_sysfs_tree_as_on_a_jetson_is_read_and_changes_of_the_band_are_logged(tmp_path: Path) -> None:
    write(tmp_path, "thermal_zone0", type="cpu-thermal", temp="61500")
    write(tmp_path, "thermal_zone1", type="gpu-thermal", temp="63250")
    write(tmp_path, "thermal_zone2", type="cv0-thermal", temp="-256000")  # powered down
    write(tmp_path, "thermal_zone3", type="cv1-thermal")  # temp cannot be read
    write(tmp_path, "thermal_zone4", type="odd", temp="warm")
    write(tmp_path, "cooling_device0", type="pwm-fan", cur_state="3")
    write(tmp_path, "cooling_device1", type="cpu-throttle-alert", cur_state="0")
    write(tmp_path, "cooling_device2", type="hot-surface-alert", cur_state="1")
    ctx = context(tmp_path)
    node, edge = make_node(ctx), make_edge(ctx)
    (reading,) = edge.poll(0)
    assert isinstance(reading, ThermalReading)
    assert reading.zones == [
        TemperatureZone(name="cpu-thermal", temperature_c=61.5),
        TemperatureZone(name="gpu-thermal", temperature_c=63.25),
    ]
    assert reading.throttling == []
    assert reading.disk_free_mb is not None and reading.disk_free_mb >= 0
    assert list(edge.poll(SECOND_NS // 2)) == [], "once a second"

    stream = io.StringIO()
    writer = logs.configure("INFO", "health", stream)
    for second, (temperature, state) in enumerate([("81000", "0"), ("81000", "0"), ("70000", "1"), ("70000", "0")], 1):
        write(tmp_path, "thermal_zone1", temp=temperature)
        write(tmp_path, "cooling_device1", cur_state=state)
        for message in edge.poll(second * SECOND_NS):
            for health in node.on(message):
                edge.on_message(health)
    edge.close()
    writer.close()
    changes = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [(c["band"], c["level"]) for c in changes] == [("hot", "warning"), ("normal", "info")]
    assert changes[0]["cause"] == "gpu-thermal 81.0 C; hot from 80 C down to 75 C"


def test_a_missing_sysfs_tree_gives_an_empty_reading(tmp_path: Path) -> None:
    (reading,) = make_edge(context(tmp_path / "nothing")).poll(0)
    assert isinstance(reading, ThermalReading)
    assert (reading.zones, reading.throttling, reading.disk_free_mb) == ([], [], None)
