"""Preflight: every rule, usage errors, writing with saved previous values, and the presets that pass it."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner, Result

import map_rasters
from map_packages import centre_of
from terrafix.core.config import Config, HealthSection, LinkSection, Models, RecorderSection, SourceSection
from terrafix.core.config import Map as MapSection
from terrafix.core.errors import LinkError, UsageError
from terrafix.core.signature import generate
from terrafix.link.gnss.previous_source import PreviousSource, PreviousSourceFile
from terrafix.link.mavlink.transport import Address, Chunk
from terrafix_tools.cli import app
from terrafix_tools.mapping.build import build
from terrafix_tools.mission.file import read_mission, write_mission
from terrafix_tools.mission.items import Do, Item, Mission
from terrafix_tools.preflight import autopilot as conversation
from terrafix_tools.preflight import computer, vehicle
from terrafix_tools.preflight.autopilot import Autopilot
from terrafix_tools.preflight.lines import CheckStatus, Line, number
from terrafix_tools.preflight.parameter_check import check_parameters, parameter_names, proposed_changes
from terrafix_tools.preflight.rules import ALWAYS, GPS_INPUT_RULES, LOCAL_RULES, Context
from terrafix_tools.preflight.run import _parameter_lines, _vehicle_lines, preflight
from terrafix_tools.preflight.simulated import GROUND_DEFAULTS as DEFAULTS
from terrafix_tools.preflight.simulated import GroundAutopilot

ROOT = Path(__file__).resolve().parents[3]
VEHICLES = ROOT / "config" / "vehicles"
PAGE = ROOT / "docs" / "autopilot.md"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short time-outs: the simulated autopilot replies at once."""
    for name, value in {
        "POLL_S": 0.0,
        "QUIET_S": 0.02,
        "ANSWER_S": 0.1,
        "OTHERS_S": 0.05,
        "CONNECT_S": 0.1,
        "RATES_S": 0.01,
    }.items():
        monkeypatch.setattr(conversation, name, value)


def preset(name: str) -> dict[str, float]:
    lines = (VEHICLES / f"{name}.param").read_text().splitlines()
    return {n: float(v) for n, v in (line.split(",") for line in lines if line and not line.startswith("#"))}


def context(*, plane: bool = True, delay_ms: int = 5, **link: Any) -> Context:
    return Context(LinkSection(**link), plane, 1, delay_ms)


def lines_by_check(values: dict[str, float], at: Context) -> dict[str, Line]:
    return {line.check: line for line in check_parameters(values, at)}


# --- rules and presets ---


@pytest.mark.parametrize(
    ("name", "plane", "gps_id"),
    [("plane", True, 0), ("copter", False, 0), ("second-gps", True, 1), ("second-gps", False, 1)],
)
def test_the_presets_pass_all_rules(name: str, plane: bool, gps_id: int) -> None:
    lines = lines_by_check(DEFAULTS | preset(name), context(plane=plane, gps_id=gps_id))
    assert {c: line.text for c, line in lines.items() if line.status is not CheckStatus.OK} == {}


@pytest.mark.parametrize(("plane", "name"), [(True, "plane"), (False, "copter")])
def test_the_proposed_changes_on_a_new_autopilot_are_the_preset(plane: bool, name: str) -> None:
    changes = {c.name: c.new for c in proposed_changes(check_parameters(DEFAULTS, context(plane=plane)))}
    assert changes.items() <= preset(name).items()
    after = DEFAULTS | changes
    assert all(line.status is CheckStatus.OK for line in check_parameters(after, context(plane=plane)))


@pytest.mark.parametrize(("name", "gps_id"), [("plane", 0), ("copter", 0), ("second-gps", 1)])
def test_each_value_of_a_preset_is_what_its_rule_proposes(name: str, gps_id: int) -> None:
    at = context(plane=name != "copter", gps_id=gps_id)
    rules = {r.name.format(n=at.gps, m=at.other): r for r in (*GPS_INPUT_RULES, *ALWAYS) if r.applies(at, DEFAULTS)}
    untouched = {"AHRS_OPTIONS": 0.0, "EK3_GPS_CHECK": 31.0}  # of bits the default value decides
    for parameter, value in preset(name).items():
        assert rules[parameter].valid(value)
        assert rules[parameter].fix(untouched.get(parameter, -1.0), at) == value


def test_the_page_names_every_parameter_that_preflight_checks() -> None:
    named = set(re.findall(r"`([A-Z0-9_n]+)`", PAGE.read_text()))
    checked = {rule.name.format(n="n", m="n") for rule in (*GPS_INPUT_RULES, *LOCAL_RULES, *ALWAYS)}
    assert {n for n in checked if n not in named and n.replace("GPSn", "GPS1") not in named} == set()


@pytest.mark.parametrize("name", ["plane", "copter", "second-gps"])
def test_the_page_gives_the_reason_of_each_value_of_a_preset(name: str) -> None:
    rows = {
        parameter: [cell.strip() for cell in line.split("|")[1:-1]]
        for line in PAGE.read_text().splitlines()
        if line.startswith("| `")
        for parameter in re.findall(r"`([A-Z0-9_]+)`", line.split("|")[1])
    }
    for parameter, value in preset(name).items():
        assert parameter in rows, f"docs/autopilot.md does not say why {parameter}"
        assert re.search(rf"(?<![\d.]){number(value)}(?![\d.]*\d)", rows[parameter][1]), (
            f"{parameter}: the page has another value"
        )
        assert len(rows[parameter][2]) > 10


TWO_PORTS = DEFAULTS | {"SERIAL2_PROTOCOL": 2}


@pytest.mark.parametrize(
    ("firmware", "changes", "link", "status", "says"),
    [
        ((4, 6), {"SERIAL2_PROTOCOL": -1}, {}, "ok", "no second MAVLink port"),
        ((4, 6), {}, {}, "warn", r"800 bytes a second.*SERIAL1, SERIAL2.*set bit 10 \(1024\) of SERIALn_OPTIONS"),
        ((4, 6), {}, {"rate_hz": 5.0}, "warn", "400 bytes a second"),
        ((4, 7), {}, {}, "warn", r"set bit 1 \(2\) of MAVn_OPTIONS"),
        ((4, 6), {"SERIAL2_OPTIONS": 1024}, {}, "warn", "SERIAL2 does not forward.*link.ground_devices"),
        ((4, 7), {"MAV2_OPTIONS": 2}, {}, "warn", "SERIAL2 does not forward"),
        ((4, 7), {"MAV2_OPTIONS": 1}, {}, "warn", "is forwarded"),
        ((4, 6), {"SERIAL2_OPTIONS": 1026}, {"ground_devices": ["udpout:10.0.0.2:14550"]}, "ok", "stays off"),
    ],
)
def test_the_forwarding_check_explains_how_to_stop_forwarding_of_gps_input(
    firmware: tuple[int, int], changes: dict[str, float], link: dict[str, Any], status: str, says: str
) -> None:
    line = lines_by_check(TWO_PORTS | changes, Context(LinkSection(**link), True, 1, 5, firmware))["forwarding"]
    assert line.status == status and re.search(says, f"{line.text} -> {line.fix}")


def test_only_parameters_of_the_firmware_version_are_requested() -> None:
    old, new = (set(parameter_names(Context(LinkSection(), True, 1, 5, firmware))) for firmware in ((4, 6), (4, 7)))
    assert "SERIAL2_OPTIONS" in old and not {n for n in old if n.startswith("MAV")}
    assert "MAV2_OPTIONS" in new and "SERIAL2_OPTIONS" not in new


def test_the_firmware_version_comes_from_autopilot_version(monkeypatch: pytest.MonkeyPatch) -> None:
    firmwares: list[tuple[int, int]] = []
    monkeypatch.setattr(
        "terrafix_tools.preflight.run.parameter_names", lambda at: firmwares.append(at.firmware) or parameter_names(at)
    )
    for version in (4 << 24 | 6 << 16, 4 << 24 | 7 << 16):
        with Autopilot(LinkSection(), GroundAutopilot(TWO_PORTS, version=version)) as autopilot:
            autopilot.connect()
            _parameter_lines(autopilot, _vehicle_lines(autopilot, Config())[0])
    assert firmwares == [(4, 6), (4, 7)]


WRONG = [
    ("plane", {"GPS1_TYPE": 1}, "GPS1_TYPE", "fail", "set 14"),
    ("plane", {"GPS1_DELAY_MS": 0}, "GPS1_DELAY_MS", "fail", "200 ms"),
    ("plane", {"GPS1_DELAY_MS": 220}, "GPS1_DELAY_MS", "fail", "moment of sending"),
    ("plane", {"EK3_GPS_CHECK": 31}, "EK3_GPS_CHECK", "fail", "set 23"),
    ("plane", {"EK3_VELNE_M_NSE": 0.3}, "EK3_VELNE_M_NSE", "fail", "failsafe"),
    ("plane", {"EK3_VELNE_M_NSE": 1.5}, "EK3_VELNE_M_NSE", "fail", "does not align"),
    ("plane", {"EK3_SRC1_VELXY": 0}, "EK3_SRC1_VELXY", "fail", "velocity is sent"),
    ("plane", {"EK3_SRC1_POSZ": 3}, "EK3_SRC1_POSZ", "warn", "barometer"),
    ("plane", {"EK3_SRC1_YAW": 2}, "EK3_SRC1_YAW", "fail", "no yaw"),
    ("plane", {"AHRS_OPTIONS": 2}, "AHRS_OPTIONS", "warn", "set 3"),
    ("plane", {"ARSPD_USE": 0}, "ARSPD_USE", "warn", "170 m"),
    ("plane", {"EK3_CHECK_SCALE": 50}, "EK3_CHECK_SCALE", "warn", "set 100"),
    ("plane", {"EK3_SRC1_VELZ": 0}, "EK3_SRC1_VELZ", "warn", "set 3"),
    ("plane", {"EK3_POSNE_M_NSE": 5.0}, "EK3_POSNE_M_NSE", "warn", "set 0.5"),
    ("plane", {"EK3_GLITCH_RAD": 0}, "EK3_GLITCH_RAD", "warn", "clipped"),
    ("plane", {"GPS1_POS_X": 0.4}, "GPS1_POS_X", "warn", "antenna"),
    ("plane", {"GPS2_TYPE": 14}, "GPS2_TYPE", "fail", "both GPS"),
    ("plane", {"EK3_SRC2_VELXY": 6}, "EK3_SRC_OPTIONS", "warn", "set 0"),  # another source set has a velocity
    ("copter", {"FS_EKF_ACTION": 0}, "FS_EKF_ACTION", "warn", "drifts on"),
    ("second-gps", {"GPS_AUTO_SWITCH": 2}, "GPS_AUTO_SWITCH", "warn", "set 4"),  # it blends both
    ("second-gps", {"GPS_AUTO_SWITCH": 0}, "GPS_AUTO_SWITCH", "warn", "set 4"),  # left by a flight on Terrafix
    ("second-gps", {"GPS_PRIMARY": 1}, "GPS_PRIMARY", "warn", "set 0"),
    ("second-gps", {"ARMING_CHECK": 1}, "ARMING_CHECK", "warn", ""),
]


@pytest.mark.parametrize(("name", "changed", "check", "status", "says"), WRONG)
def test_each_wrong_value_has_a_reason_and_a_fix(
    name: str, changed: dict[str, float], check: str, status: str, says: str
) -> None:
    at = context(plane=name != "copter", gps_id=int(name == "second-gps"))
    line = lines_by_check(DEFAULTS | preset(name) | changed, at)[check]
    assert line.status == status
    assert says in f"{line.text} {line.fix}"
    assert (line.change is not None) or not line.fix


@pytest.mark.parametrize(
    ("name", "check"),
    [
        pytest.param("plane", "FS_EKF_ACTION", id="only a copter has a failsafe action"),
        pytest.param("plane", "EK3_SRC_OPTIONS", id="no other source set has a velocity"),
        pytest.param("plane", "GPS_AUTO_SWITCH", id="there is no other receiver"),
    ],
)
def test_a_rule_that_does_not_apply_has_no_line(name: str, check: str) -> None:
    assert check not in lines_by_check(DEFAULTS | preset(name), context())


@pytest.mark.parametrize(("value", "text"), [(1048566.0, "1048566"), (0.8999999761581421, "0.9"), (-1.0, "-1")])
def test_parameter_values_are_formatted_without_loss(value: float, text: str) -> None:
    assert number(value) == text


def test_local_frame_outputs_have_their_own_rules() -> None:
    at = context(outputs=["odometry"])
    lines = lines_by_check(DEFAULTS, at)
    assert "GPS1_TYPE" not in lines
    assert (lines["VISO_TYPE"].status, lines["source set"].status) == ("fail", "fail")
    good = DEFAULTS | {
        "EK3_SRC_OPTIONS": 0,
        "VISO_TYPE": 1,
        "EK3_SRC2_POSXY": 6,
        "EK3_SRC2_VELXY": 6,
        "AHRS_OPTIONS": 1,
    }
    assert all(line.status is CheckStatus.OK for line in check_parameters(good, at))
    loop = lines_by_check(good | {"EK3_SRC2_YAW": 6}, at)["source set"]
    assert "the autopilot's own" in loop.text
    blind = lines_by_check(good, context(outputs=["vision_position"]))["source set"]
    assert "no velocity" in blind.text


def test_serial_speed_and_system_id_are_checked() -> None:
    at = Context(LinkSection(device="/dev/ttyTHS1", baud=921_600, sysid=1), True, 3, 5)
    lines = lines_by_check(DEFAULTS | preset("plane"), at)
    assert "no port speaks MAVLink at 921600 baud (MAVLink: SERIAL1 57)" in lines["serial port"].text
    assert "set link.sysid = 3" in lines["system id"].fix
    same = lines_by_check(DEFAULTS | {"SERIAL1_BAUD": 921}, at)
    assert same["serial port"].status == "ok"


def test_a_missing_parameter_is_reported() -> None:
    values = {name: value for name, value in DEFAULTS.items() if name != "GPS1_TYPE"}
    assert "no such parameter" in lines_by_check(values, context())["GPS1_TYPE"].text
    assert "GPS1_TYPE" in parameter_names(context())


@pytest.mark.parametrize(
    ("device", "baud", "trip_ms", "advice"),
    [
        ("udpout:a:1", 9600, None, 5),
        ("udpout:a:1", 9600, 40.0, 20),
        ("/dev/x", 57_600, None, 14),
        ("/dev/x", 9600, 9.0, 50),
    ],
)
def test_the_recommended_delay_follows_from_the_line(
    device: str, baud: int, trip_ms: float | None, advice: int
) -> None:
    assert vehicle.delay_advice_ms(LinkSection(device=device, baud=baud), trip_ms) == advice


# --- the MAVLink client ---


@contextmanager
def connected(values: dict[str, float], **more: Any) -> Iterator[Autopilot]:
    """``more``: of GroundAutopilot."""
    with Autopilot(LinkSection(), GroundAutopilot(values, **more)) as autopilot:
        autopilot.connect(1.0)
        yield autopilot


def test_parameters_are_read_despite_packet_loss() -> None:
    with connected(DEFAULTS, loses=20) as autopilot:
        read = autopilot.read([*DEFAULTS, "NO_SUCH_PARAMETER"])
    assert read == pytest.approx(DEFAULTS)
    assert (autopilot.plane, autopilot.sysid, autopilot.armed) == (True, 1, False)


@pytest.mark.parametrize(
    ("there", "link", "says"),
    [
        (GroundAutopilot({}, also=(9,)), {}, "2 autopilots on .*, system ids 1, 9; name yours in link.autopilot_sysid"),
        (GroundAutopilot({}), {"autopilot_sysid": 3}, "has system id 1, not 3; correct link.autopilot_sysid"),
        (GroundAutopilot({}, firmware=mavlink.MAV_AUTOPILOT_PX4), {}, "is px4, not ArduPilot"),
        (GroundAutopilot({}, firmware=mavlink.MAV_AUTOPILOT_INVALID), {}, "no autopilot on .*, only system 1"),
    ],
)
def test_a_wrong_or_ambiguous_autopilot_is_an_error(there: GroundAutopilot, link: dict[str, Any], says: str) -> None:
    with Autopilot(LinkSection(**link), there) as autopilot, pytest.raises(LinkError, match=says) as caught:
        autopilot.connect(0.3)
    assert "\n" not in str(caught.value)


class Streaming(GroundAutopilot):
    """Has its own clock (s), and sends requested streams at ``share`` of their rate."""

    def __init__(self, share: float) -> None:
        super().__init__({})
        self._share, self._requested, self.now_s = share, dict[int, float](), 0.0

    def clock(self) -> float:
        self.now_s += 0.001
        return self.now_s

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        message = self._parser.decode(bytearray(packet))
        if message.get_type() == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._requested[int(message.param1)] = 1e6 / message.param2
            return True
        return super().write(packet)

    def read(self) -> list[Chunk]:
        before_s, self._read_s = getattr(self, "_read_s", 0.0), self.now_s
        for message_id, rate_hz in self._requested.items():
            each = rate_hz * self._share
            for _ in range(int(each * self.now_s) - int(each * before_s)):
                kind = mavlink.mavlink_map[message_id]
                lengths = (kind.array_lengths[place] for place in kind.orders)
                self.send(kind(*([0] * n if n else 0 for n in lengths)))
        return super().read()


@pytest.mark.parametrize(
    ("share", "status", "says"),
    [(1.0, "ok", "attitude 25 Hz, IMU 33 Hz"), (0.5, "warn", "too slow: ATTITUDE 12.")],
)
def test_the_streams_of_the_link_are_requested_and_counted(
    share: float, status: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conversation, "RATES_S", 6.5)
    there = Streaming(share)
    with Autopilot(LinkSection(), there, there.clock) as autopilot:
        autopilot.connect(0.3)
        line = vehicle.rates(autopilot.rates())
    assert (line.status, says in line.text) == (status, True), line.text


def test_unreadable_parameters_are_one_line() -> None:
    with connected({}) as autopilot, pytest.raises(LinkError, match="does not answer requests for parameters"):
        autopilot.read(["GPS1_TYPE"])


def test_a_parameter_that_keeps_its_value_is_an_error() -> None:
    with (
        connected(DEFAULTS, read_only=("GPS1_TYPE",)) as autopilot,
        pytest.raises(LinkError, match="GPS1_TYPE could not be set to 14"),
    ):
        autopilot.write("GPS1_TYPE", 14)


# --- the command ---


Wired = Callable[..., GroundAutopilot]


@pytest.fixture
def wired(monkeypatch: pytest.MonkeyPatch) -> Wired:
    """``wired(values, **of_GroundAutopilot)``: the autopilot that the command finds."""

    def put(values: dict[str, float], **more: Any) -> GroundAutopilot:
        there = GroundAutopilot(values, **more)
        monkeypatch.setattr(conversation, "open_at_start", lambda _device, _baud: there)
        return there

    return put


def run(*arguments: str, answer: str | None = None) -> Result:
    return CliRunner().invoke(app, ["preflight", *arguments], input=answer)


def test_write_sets_wrong_parameters_and_saves_the_previous_values(wired: Wired, tmp_path: Path, capsys: Any) -> None:
    there = wired(DEFAULTS)
    ready = preflight([], out=tmp_path, write=True, yes=True, as_json=True, with_computer=False)
    output = json.loads(capsys.readouterr().out)
    assert ready and output["ready"]
    assert {name: there.values[name] for name in preset("plane")} == pytest.approx(preset("plane"))
    saved = dict(line.split(",") for line in Path(output["saved_to"]).read_text().splitlines())
    assert {name: float(value) for name, value in saved.items()} == {name: DEFAULTS[name] for name in saved}
    assert set(saved) == {change["name"] for change in output["written"]} == set(there.parameters_set)


def test_after_writing_the_result_is_that_of_the_values_read_back(wired: Wired, tmp_path: Path) -> None:
    wired(DEFAULTS)
    done = run("--write", "--yes", "--autopilot-only", "--out", str(tmp_path))
    assert done.exit_code == 0
    assert "Read back from the autopilot:" in done.output
    assert "0 failures" in done.output.splitlines()[-1]


LEFT = {"GPS_AUTO_SWITCH": 4, "GPS_PRIMARY": 1}  # by a flight that ended on Terrafix


@pytest.fixture
def second(tmp_path: Path) -> list[str]:
    config = tmp_path / "second.toml"
    config.write_text("[link]\ngps_id = 1\n")
    return ["--autopilot-only", "--config", str(config), "--out", str(tmp_path / "out")]


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    return tmp_path / "state"


def test_restore_sets_back_what_a_flight_has_changed_and_nothing_else(
    wired: Wired, second: list[str], state: Path
) -> None:
    PreviousSourceFile(state).save(PreviousSource(1, {"GPS_AUTO_SWITCH": 2.0, "GPS_PRIMARY": 0.0}))
    there = wired(DEFAULTS | preset("second-gps") | LEFT | {"GPS2_DELAY_MS": 0})
    seen = run(*second)
    assert seen.exit_code == 1
    assert "GPS_PRIMARY is 1 since a flight that ended on Terrafix; it was 0" in seen.output
    assert "terrafix preflight --restore" in seen.output
    run(*second, "--restore", "--yes")
    assert {name: there.values[name] for name in LEFT} == {"GPS_AUTO_SWITCH": 2.0, "GPS_PRIMARY": 0.0}
    assert set(there.parameters_set) == set(LEFT)
    assert PreviousSourceFile(state).load() is None


def test_restore_without_a_file_sets_what_the_rules_want(wired: Wired, second: list[str], state: Path) -> None:
    there = wired(DEFAULTS | preset("second-gps") | LEFT)
    done = run(*second, "--restore", "--yes")
    assert done.exit_code == 0
    assert there.values["GPS_PRIMARY"] == 0
    assert there.parameters_set == ["GPS_PRIMARY"]


def test_restore_leaves_the_state_of_another_vehicle(wired: Wired, second: list[str], state: Path) -> None:
    PreviousSourceFile(state).save(PreviousSource(9, {"GPS_PRIMARY": 0.0}))
    wired(DEFAULTS | preset("second-gps") | LEFT)
    done = run(*second, "--restore", "--yes")
    assert "since a flight" not in done.output
    assert PreviousSourceFile(state).load() is not None


@pytest.mark.parametrize("answer", ["n\n", "\n"], ids=["no", "return alone"])
def test_without_confirmation_nothing_is_set(wired: Wired, tmp_path: Path, answer: str) -> None:
    there = wired(DEFAULTS)
    done = run("--write", "--autopilot-only", "--out", str(tmp_path), answer=answer)
    assert done.exit_code == 1
    assert "GPS1_TYPE        1 -> 14" in done.output
    assert there.parameters_set == []
    assert list(tmp_path.iterdir()) == []


def test_json_with_write_requires_yes(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="add --yes"):
        preflight([], out=tmp_path, write=True, as_json=True)


def test_nothing_is_set_on_an_armed_vehicle(wired: Wired, tmp_path: Path) -> None:
    there = wired(DEFAULTS, armed=True)
    with pytest.raises(UsageError, match="disarm it"):
        preflight([], out=tmp_path, write=True, yes=True, with_computer=False)
    assert there.parameters_set == []


def test_a_missing_autopilot_is_a_failure_and_the_other_checks_run(tmp_path: Path) -> None:
    done = run("--json", "--link", "udpout:127.0.0.1:9", "--out", str(tmp_path))
    lines = {line["check"]: line for line in json.loads(done.output)["lines"]}
    assert done.exit_code == 1
    assert lines["autopilot"]["status"] == "fail"
    assert "nothing heard on udpout:127.0.0.1:9" in lines["autopilot"]["text"]
    assert {"map", "camera", "models", "clock", "disk", "temperature"} <= lines.keys()


def test_correlation_on_a_gpu_is_checked_where_it_is_configured(tmp_path: Path) -> None:
    def correlation_lines(models: Models) -> list[Line]:
        lines = computer.check_lines(Config(models=models), None, tmp_path)
        return [line for line in lines if line.check == "correlation"]

    (line,) = correlation_lines(Models(correlation="gpu", folder=str(tmp_path)))
    assert line.status is CheckStatus.FAIL and "no model is called 'correlation-512'" in line.text
    assert "terrafix models export" in line.fix
    assert correlation_lines(Models(folder=str(tmp_path))) == []


@pytest.mark.parametrize("device", ["udpin:127.0.0.1", "udpin:127.0.0.1:70000", "127.0.0.1:14550", "tcp:127.0.0.1:9"])
def test_an_invalid_device_is_one_failure_with_a_fix(device: str, tmp_path: Path) -> None:
    done = run("--json", "--autopilot-only", "--link", device, "--out", str(tmp_path))
    (line,) = json.loads(done.output)["lines"]
    assert device in line["text"]
    assert line["fix"] and line["fix"] not in line["text"]


def test_an_old_firmware_is_a_failure() -> None:
    with connected(DEFAULTS | preset("plane"), version=4 << 24 | 5 << 16) as autopilot:
        lines = {line.check: line for line in vehicle.check_lines(autopilot, LinkSection(), 5.0)}
    assert lines["firmware"].status == "fail"
    assert "4.5.0" in lines["firmware"].text


def test_the_mission_on_board_is_saved_as_a_file(tmp_path: Path) -> None:
    with connected(DEFAULTS, mission=((22, 48.0, 11.0, 50.0), (16, 48.01, 11.02, 120.0))) as autopilot:
        assert vehicle.save_mission(autopilot, tmp_path / "m") is None
    plan = read_mission(tmp_path / "m")
    assert plan.items[-1].lat_deg == pytest.approx(48.01)
    assert plan.items[-1].height_m == 120.0


@pytest.fixture
def small_map(tmp_path: Path) -> Path:
    tif = map_rasters.utm(tmp_path / "i.tif", map_rasters.texture(300, 300), pixel_m=1.0)
    return build(tif, tmp_path / "m.gpkg", date="2020-01-01", licence="CC0")


@pytest.mark.slow
def test_a_mission_on_board_with_any_items_is_checked_against_the_map(
    tmp_path: Path, small_map: Path, wired: Wired
) -> None:
    centre = centre_of(small_map)
    lat, lon = centre.lat_deg, centre.lon_deg
    on_it = ((189, lat, lon, 60.0), (177, 0.0, 0.0, 0.0), (82, lat + 1e-4, lon, 60.0))  # DO_LAND_START, jump, spline
    for items, status in ((on_it, "ok"), ((*on_it, (82, lat + 0.02, lon, 60.0)), "fail")):
        wired(DEFAULTS, mission=items, home=(lat, lon))
        done = run("--link", "udpout:127.0.0.1:9", "--map", str(small_map), "--json", "--out", str(tmp_path / "out"))
        lines = {line["check"]: line for line in json.loads(done.output)["lines"]}
        assert lines["mission"]["status"] == status, lines["mission"]


# --- this computer ---


def computer_lines(config: Config, mission: Path | None, out: Path) -> dict[str, Line]:
    return {line.check: line for line in computer.check_lines(config, mission, out)}


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (90, 120, 3), np.uint8)


def test_the_camera_check_detects_frozen_blurred_and_dark_images() -> None:
    smooth = np.dstack([np.tile(np.linspace(60, 200, 120, dtype=np.uint8), (90, 1))] * 3)
    assert computer.check_images([noise(i) for i in range(3)]).status == "ok"
    assert "same picture" in computer.check_images([noise(1)] * 3).text
    assert "blurred" in computer.check_images([smooth, smooth + 1, smooth]).text
    black = [np.full((90, 120, 3), i, np.uint8) for i in range(3)]
    assert "lens cap" in computer.check_images(black).fix
    assert "only 1" in computer.check_images([noise(1)]).text


def test_heat_low_disk_space_and_a_wrong_clock_are_warnings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zone = tmp_path / "class" / "thermal" / "thermal_zone0"
    zone.mkdir(parents=True)
    (zone / "temp").write_text("83000")
    (zone / "type").write_text("cpu-thermal")
    config = Config(health=HealthSection(sysfs_root=str(tmp_path)), recorder=RecorderSection(budget_mb=10**9))
    monkeypatch.setattr(computer.time, "time_ns", lambda: 0)
    lines = computer_lines(config, None, tmp_path / "out")
    assert (lines["temperature"].status, lines["disk"].status, lines["clock"].status) == ("warn", "warn", "warn")
    assert "83 C (cpu-thermal), on the ground already" in lines["temperature"].text
    assert "GPS week" in lines["clock"].text


def test_start_and_mission_must_lie_on_the_map(tmp_path: Path, small_map: Path) -> None:
    frame, path = centre_of(small_map), str(small_map)

    def lines(start_m: tuple[float, float], *way_m: tuple[float, float], signed: bool = False) -> dict[str, Line]:
        places = [frame.to_wgs84(*place) for place in way_m]
        items = tuple(Item(Do.WAYPOINT, i, lat, lon, 100.0) for i, (lat, lon) in enumerate(places, start=1))
        mission = tmp_path / "m.waypoints"
        write_mission(mission, Mission("test", *places[0], items))
        lat, lon = frame.to_wgs84(*start_m)
        chosen = MapSection(path=path, require_signature=signed, trusted_keys=[str(tmp_path / "a.pub")])
        config = Config(map=chosen, source=SourceSection(start=f"{lat:.7f},{lon:.7f}"))
        return computer_lines(config, mission, tmp_path)

    good = lines((0.0, 0.0), (-50.0, 0.0), (50.0, 50.0))
    assert [good[check].status for check in ("map", "start", "mission")] == ["ok"] * 3
    config = Config(map=MapSection(path=path))
    unknown = computer_lines(config, tmp_path / "none.plan", tmp_path)
    assert [unknown[check].status for check in ("map", "start", "mission")] == ["ok", "warn", "fail"]
    assert "no such mission file" in unknown["mission"].text
    assert "autopilot's GNSS" in unknown["start"].text and "whole map" in unknown["start"].text
    config = Config(map=MapSection(path=path), link=LinkSection(gnss_start=False))
    searched = computer_lines(config, tmp_path / "none.plan", tmp_path)
    assert "GNSS" not in searched["start"].text and "whole map" in searched["start"].text
    bad = lines((900.0, 0.0), (0.0, 0.0), (400.0, 0.0))
    assert (bad["start"].status, bad["mission"].status) == ("fail", "fail")
    assert "leaves the map" in bad["mission"].text
    generate(tmp_path / "a.key", tmp_path / "a.pub", "somebody")
    unsigned = lines((0.0, 0.0), (-50.0, 0.0), (50.0, 50.0), signed=True)
    assert unsigned["map"].status == "fail"
    assert "sign" in f"{unsigned['map'].text} {unsigned['map'].fix}"


def test_a_command_that_is_not_known_is_named_by_preflight(tmp_path: Path, small_map: Path) -> None:
    centre = centre_of(small_map)
    lat, lon = centre.lat_deg, centre.lon_deg
    rows = [f"0 1 0 16 0 0 0 0 {lat} {lon} 0 1", f"1 0 3 82 0 0 0 0 {lat} {lon} 60 1", "2 0 3 62000 0 0 0 0 1 2 3 1"]
    mission = tmp_path / "m.waypoints"
    mission.write_text("\n".join(["QGC WPL 110", *rows]))
    line = computer_lines(Config(map=MapSection(path=str(small_map))), mission, tmp_path)["mission"]
    assert (line.status, line.text) == ("warn", "MAVLink command 62000 is not known: item 2")


def test_a_missing_map_is_a_failure_with_a_fix(tmp_path: Path) -> None:
    config = Config(map=MapSection(path=str(tmp_path / "none.gpkg")))
    lines = computer_lines(config, None, tmp_path)
    assert lines["map"].status == "fail"
    assert "terrafix map build" in lines["map"].fix


@pytest.mark.parametrize(("value", "fix"), [(0.0, "set 8"), (4.0, "set 12"), (8.0, ""), (-1.0, "")])
def test_from_ardupilot_4_7_on_the_checks_to_skip_are_checked_instead_of_those_to_run(value: float, fix: str) -> None:
    values = DEFAULTS | preset("second-gps") | {"ARMING_SKIPCHK": value}
    del values["ARMING_CHECK"]
    lines = lines_by_check(values, replace(context(gps_id=1), firmware=(4, 7)))
    assert "ARMING_CHECK" not in lines
    assert lines["ARMING_SKIPCHK"].fix == fix
    assert "ARMING_SKIPCHK" not in lines_by_check(DEFAULTS | preset("second-gps"), context(gps_id=1))
