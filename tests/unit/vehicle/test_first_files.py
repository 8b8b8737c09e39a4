"""`terrafix init`, `terrafix config check`, `preflight --simulate`: the first files of a vehicle, and practice."""

import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from broken_files import BROKEN, CAMERA_LINES
from terrafix.core.config import LinkSection, load
from terrafix.core.errors import ConfigError, SourceError, TerrafixError, UsageError
from terrafix.vision.sources.description import camera_of, read_description
from terrafix_tools import installation
from terrafix_tools.cli import app
from terrafix_tools.configuration.schema import FOLDER, NAMES, schemas, text_of
from terrafix_tools.preflight import autopilot as conversation
from terrafix_tools.preflight.lines import CheckStatus
from terrafix_tools.preflight.parameter_check import check_parameters
from terrafix_tools.preflight.practice import WRONG, Practice
from terrafix_tools.preflight.rules import Context

ROOT = Path(__file__).resolve().parents[3]
OPTIONS = ("--vehicle", "copter", "--camera", "csi://0", "--size", "1280x720", "--fov", "70", "--link", "/dev/ttyTHS1")


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_schemas_in_the_repository_are_those_of_the_tables() -> None:
    for kind, schema in schemas().items():
        written = (ROOT / FOLDER / NAMES[kind]).read_text(encoding="utf-8")
        assert written == text_of(schema), "run python -m terrafix_tools.configuration.schema"


def test_a_schema_explains_every_key_of_the_configuration_and_forbids_others() -> None:
    definitions = schemas()["configuration"]["$defs"]
    for name, table in definitions.items():
        assert table["additionalProperties"] is False
        if name != "Config":
            assert all(key.get("description") for key in table["properties"].values()), name


@pytest.mark.parametrize("path", sorted((ROOT / "config").rglob("*.toml")), ids=lambda path: path.name)
def test_an_example_names_a_schema_that_is_there(path: Path) -> None:
    if path.parent.name == "training":
        pytest.skip("for developers")
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first.startswith("#:schema ") and (path.parent / first.removeprefix("#:schema ")).is_file()


def test_init_writes_files_that_are_read_without_a_mistake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert call("init", "my", *OPTIONS).exception is None
    config = load([Path("my/config.toml")])
    assert (config.source.path, config.link.device) == ("csi://0", "/dev/ttyTHS1")
    camera = camera_of(Path(config.source.camera), read_description(Path(config.source.camera)))
    assert (camera.width, camera.fx) == (1280, pytest.approx(914.0, abs=0.1))  # 640 / tan(35 degrees)
    assert (tmp_path / "my/autopilot.param").read_text() == (ROOT / "config/vehicles/copter.param").read_text()
    assert "preflight --simulate copter --config my/config.toml" in (tmp_path / "my/CHECKLIST.md").read_text()
    for name in ("config.toml", "camera.toml"):
        schema = (tmp_path / "my" / name).read_text().splitlines()[0].removeprefix("#:schema ")
        assert (tmp_path / "my" / schema).is_file()
    checked = call("config", "check", "my/config.toml")
    assert "my/config.toml: configuration, no mistake found" in checked.output
    assert "[link] device = /dev/ttyTHS1" in checked.output and "focal length 914.0 px" in checked.output


def test_beside_a_receiver_terrafix_is_the_second_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    call("init", "my", *OPTIONS, "--vehicle", "second-gps")
    assert load([Path("my/config.toml")]).link.gps_id == 1  # as second-gps.param wants it


def test_init_overwrites_nothing(tmp_path: Path) -> None:
    (tmp_path / "camera.toml").write_text("mine")
    error = call("init", tmp_path, *OPTIONS).exception
    assert isinstance(error, UsageError) and "camera.toml: exists, and is not overwritten" in str(error)
    assert [path.name for path in tmp_path.iterdir()] == ["camera.toml"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (OPTIONS[2:], "--vehicle is missing"),
        ((*OPTIONS, "--vehicle", "rover"), "choose one of copter, plane, second-gps, px4"),
        ((*OPTIONS, "--size", "huge"), "--size huge"),
        ((*OPTIONS, "--fov", "5"), "10 to 150"),
        ((*OPTIONS, "--lens", "none.toml"), "none.toml: no such file"),
    ],
)
def test_init_says_what_is_missing_or_wrong(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    error = call("init", tmp_path / "new", *arguments).exception
    assert isinstance(error, TerrafixError) and words in str(error), error
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(("kind", "text", "key"), BROKEN)
def test_a_broken_file_is_one_line_that_names_the_key(tmp_path: Path, kind: str, text: str, key: str) -> None:
    path = tmp_path / "my.toml"
    path.write_text(text)
    tomllib.loads(text)
    error = call("config", "check", path).exception
    assert isinstance(error, ConfigError | SourceError), (kind, error)
    assert str(error).startswith(str(path)) and key in str(error) and "\n" not in str(error)


def test_there_are_fifty_broken_files() -> None:
    assert len(BROKEN) >= 50


def test_a_file_that_a_configuration_names_and_that_is_not_there_is_said(tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text("[source]\ncamera = 'lens.toml'\n")
    error = call("config", "check", tmp_path / "my.toml").exception
    assert isinstance(error, ConfigError) and "[source] camera: lens.toml is not there, seen from" in str(error)


def test_a_description_without_a_start_is_a_camera_and_with_one_a_flight(tmp_path: Path) -> None:
    for more, kind in (("", "camera description"), ("[start]\nlat_deg = 48\nlon_deg = 11\n", "flight description")):
        (tmp_path / "my.toml").write_text(CAMERA_LINES + more)
        assert f"my.toml: {kind}, no mistake found" in call("config", "check", tmp_path / "my.toml").output


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"CONNECT_S": 2.0, "OTHERS_S": 0.05, "RATES_S": 0.2, "ANSWER_S": 0.5, "QUIET_S": 0.3}.items():
        monkeypatch.setattr(conversation, name, value)


@pytest.mark.parametrize(("vehicle", "name"), [(vehicle, name) for vehicle, names in WRONG.items() for name in names])
def test_the_wrong_parameter_of_the_practice_is_the_only_one_that_preflight_complains_of(
    vehicle: str, name: str
) -> None:
    practice = Practice(vehicle, name)
    link = LinkSection(gps_id=1 if vehicle == "second-gps" else 0)
    context = Context(link, plane=vehicle == "plane", sysid=1, delay_ms=5, firmware=(4, 6))
    lines = list(check_parameters(practice.values, context))
    (wrong,) = [line for line in lines if line.status is not CheckStatus.OK]
    assert wrong.check == name and wrong.change is not None and wrong.change.new != practice.values[name]


def test_practice_with_write_sets_the_parameter_right(
    quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call("init", "my", *OPTIONS, "--vehicle", "plane").exception is None
    practice = ("--simulate", "plane", "--config", "my/config.toml")
    assert " ".join(practice) in Path("my/CHECKLIST.md").read_text(encoding="utf-8")
    result = call("preflight", *practice, "--write", "--yes")
    assert "\nFound: it was " in result.output and result.exit_code == 0


def test_practice_needs_no_link(tmp_path: Path) -> None:
    assert isinstance(call("preflight", "--simulate", "copter", "--link", "udpin:0.0.0.0:1").exception, UsageError)


def test_practice_knows_no_px4_and_reads_the_configuration_first(tmp_path: Path) -> None:
    error = call("preflight", "--simulate", "px4").exception
    assert isinstance(error, UsageError) and "choose one of copter, plane, second-gps" in str(error)
    result = call("preflight", "--simulate", "plane", "--config", tmp_path / "none.toml")
    assert isinstance(result.exception, ConfigError) and result.output == ""


def test_the_checklist_of_px4_has_no_practice_with_an_ardupilot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = call("init", "my", *OPTIONS, "--vehicle", "px4")
    assert "next     my/CHECKLIST.md" in result.output
    assert "--simulate" not in Path("my/CHECKLIST.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("url", "prefix", "command"),
    [
        (
            "file:///src/terrafix",
            "/venv",
            "/venv/bin/python -m pip install -e '/src/terrafix[ground]' -e /src/terrafix/tools",
        ),
        (
            "file:///d/terrafix-1.whl",
            "/venv",
            "/venv/bin/python -m pip install '/d/terrafix-1.whl[ground]' --find-links /d",
        ),
        (
            "file:///d/terrafix-1.whl",
            "/opt/a/.local/share/pipx/venvs/terrafix",
            "pipx install --force '/d/terrafix-1.whl[ground]' --pip-args '--find-links /d'",
        ),
        ("", "/venv", "/venv/bin/python -m pip install 'terrafix[ground]'"),
    ],
)
def test_what_to_install_is_said_as_this_installation_was_made(
    monkeypatch: pytest.MonkeyPatch, url: str, prefix: str, command: str
) -> None:
    monkeypatch.setattr(installation, "_origin", lambda _: url.removeprefix("file://"))
    monkeypatch.setattr(Path, "is_dir", lambda path: str(path) == "/src/terrafix")
    monkeypatch.setattr("sys.prefix", prefix)
    monkeypatch.setattr("sys.executable", "/venv/bin/python")
    assert installation.install_command("ground") == command
