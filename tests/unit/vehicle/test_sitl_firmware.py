"""A missing, non-executable or invalid binary, and ports in use: one line with a remedy."""

import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from terrafix.core.errors import UsageError
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.sitl.firmware import Firmware, Home, Ports, find_binary, kind_of, take_ports

HOME = Home(48.0, 14.0, 320.0, 90.0)


def script(path: Path, text: str) -> Path:
    path.write_text(f"#!{sys.executable}\n{text}\n")
    path.chmod(0o755)
    return path


def started(program: Path, folder: Path) -> Firmware:
    return Firmware(program, Kind.PLANE, folder, HOME, Ports(1, 2, 3, 4), [folder / "a.param", folder / "b.param"])


def test_a_missing_binary_setting_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TERRAFIX_ARDUPILOT_SITL", raising=False)
    with pytest.raises(UsageError, match=r"TERRAFIX_ARDUPILOT_SITL; docs/sitl.md"):
        find_binary(None)


def test_the_environment_variable_selects_the_binary(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = script(tmp_path / "arduplane", "")
    monkeypatch.setenv("TERRAFIX_ARDUPILOT_SITL", str(program))
    assert find_binary(None) == program


def test_a_binary_that_does_not_exist_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such ArduPilot binary"):
        find_binary(tmp_path / "arduplane")
    with pytest.raises(UsageError, match="no such ArduPilot binary"):
        find_binary(tmp_path)  # a folder


def test_a_binary_without_execute_permission_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "arduplane").write_text("")
    with pytest.raises(UsageError, match=r"may not be executed; chmod \+x"):
        find_binary(tmp_path / "arduplane")


def test_a_file_that_is_not_a_program_is_an_error(tmp_path: Path) -> None:
    program = tmp_path / "arduplane"
    program.write_bytes(b"\x7fELF of another machine")
    program.chmod(0o755)
    with pytest.raises(UsageError, match="cannot be run on this machine"):
        started(program, tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "kind"), [("arduplane", "plane"), ("arducopter-4.6.3", "copter"), ("ArduPlane", "plane")]
)
def test_the_vehicle_follows_from_the_binary_name(name: str, kind: str) -> None:
    assert kind_of(Path("/somewhere") / name, None) == kind


@pytest.mark.parametrize("name", ["firmware", "plane-or-copter"])
def test_an_inconclusive_binary_name_is_an_error(name: str) -> None:
    with pytest.raises(UsageError, match="give --vehicle"):
        kind_of(Path(name), None)
    assert kind_of(Path(name), Kind.COPTER) is Kind.COPTER


def test_a_port_in_use_is_an_error() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        taken = other.getsockname()[1]
        with pytest.raises(UsageError, match=rf"port {taken} is in use .*choose another --port"):
            take_ports(taken - 1)
    with pytest.raises(UsageError, match="not allowed"):
        take_ports(70_000)


def test_free_ports_differ() -> None:
    ports = take_ports()
    assert len({ports.ground, ports.companion, ports.observer, ports.rc_in}) == 4


def test_the_firmware_gets_home_ports_and_parameters(tmp_path: Path) -> None:
    program = script(tmp_path / "arduplane", "import sys, time; print(sys.argv[1:], flush=True); time.sleep(60)")
    with started(program, tmp_path / "run") as firmware:
        console = tmp_path / "run" / "firmware.log"
        for _ in range(200):
            if console.stat().st_size:
                break
            time.sleep(0.05)
        firmware.check()  # it runs
    text = console.read_text()
    for words in ("--home', '48.00000000,14.00000000,320.00,90.0", "--model', 'plane", "udpclient:127.0.0.1:2"):
        assert words in text
    assert f"{tmp_path}/run/a.param,{tmp_path}/run/b.param" in text


def test_the_error_of_a_firmware_that_ended_quotes_its_last_output(tmp_path: Path) -> None:
    program = script(tmp_path / "arduplane", "print('no such model'); raise SystemExit(3)")
    with started(program, tmp_path / "run") as firmware:
        firmware._process.wait(20)
        with pytest.raises(UsageError, match="ended with code 3, last output: no such model"):
            firmware.check()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--binary", "/nowhere/arduplane"], "/nowhere/arduplane: no such ArduPilot binary; docs/sitl.md says how"),
        (["--binary", sys.executable, "--vehicle", "plane", "--length", "-1"], "--length -1: choose more than 0"),
        (["--binary", sys.executable, "--vehicle", "plane", "--parameters", "no.param"], "no.param: no such parameter"),
        (["--binary", sys.executable], "the name contains neither plane nor copter; give --vehicle"),
    ],
)
def test_a_usage_error_is_one_line(arguments: list[str], text: str, tmp_path: Path) -> None:
    pytest.importorskip("mavsdk", reason="mavsdk is not installed (pip install 'terrafix[sim]')")
    command = [
        sys.executable,
        "-m",
        "terrafix_tools.cli",
        "sim",
        "ardupilot",
        "--out",
        str(tmp_path / "out"),
        *arguments,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and text in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "out").exists()
