"""Declared dependencies, lock file and version agree with the code."""

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
import typer
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import terrafix
from terrafix.core.errors import MapError
from terrafix_tools.cli import app
from terrafix_tools.installation import install_command

ROOT = Path(__file__).resolve().parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
GROUND = tomllib.loads((ROOT / "tools" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CORE = {canonicalize_name(Requirement(r).name): Requirement(r) for r in PROJECT["dependencies"]}
EXTRAS = {  # libraries, without our own distribution for the ground
    extra: {canonicalize_name(Requirement(r).name): Requirement(r) for r in requirements if GROUND["name"] not in r}
    for extra, requirements in PROJECT["optional-dependencies"].items()
}
RANGED = ("ground", "sim", "cluster", "faiss", "fleet", "console", "rosbag", "vehicle", "gstreamer", "train")
WITHOUT_GROUND = {
    "vehicle",
    "gstreamer",
    "faiss",
    "rosbag",
    "dev",
    "docs",
    "nightly",
}  # what a vehicle may have, and the checks
IMPORTED_AS = {
    "foxglove-schemas-protobuf": "foxglove_schemas_protobuf",
    "protobuf": "google",
    "opencv-python-headless": "cv2",
    "pyserial": "serial",
    "pyzmq": "zmq",
    "pillow": "PIL",
    "pyyaml": "yaml",
    "python-multipart": "python_multipart",
    "faiss-cpu": "faiss",
    "systemd-python": "systemd",
    "pygobject": "gi",
    "jsonschema-rs": "jsonschema_rs",
    "axe-core-python": "axe_core_python",
}
COMMANDS = {"ruff", "mypy", "types-pyserial", "pytest-xdist", "hatchling"}  # used by scripts/check or the build
EXPORTER = {"onnx", "onnxscript"}  # imported by PyTorch when it writes ONNX
SEARCH = ROOT / "daemon" / "terrafix" / "anchor" / "place_index" / "faiss_ivf.py"  # the only file that imports FAISS
SERVICE = ROOT / "daemon" / "terrafix" / "runtime" / "systemd.py"  # the only file that imports systemd-python
ULOG = ROOT / "daemon" / "terrafix" / "core" / "autopilot_log" / "ulog.py"  # the only file that imports pyulog
BAGS = ROOT / "daemon" / "terrafix" / "vision" / "sources" / "bag_reader.py"  # the only file that imports rosbags
OURS = {"terrafix", "terrafix_engines", "terrafix_tools", "terrafix_lab"}
SOURCES = ("daemon", "engines", "tools")
LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8")


def imported(*folders: str, extras: bool = True) -> set[str]:
    """Top-level names of all third-party modules imported below the folders; with or without the code of the extras of
    what flies: FAISS, systemd, pyulog and rosbags."""
    found: set[str] = set()
    for folder in folders:
        own = {path.stem for path in (ROOT / folder).rglob("*.py")}
        for path in (ROOT / folder).rglob("*.py"):
            if not extras and path in (SEARCH, SERVICE, ULOG, BAGS):
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    found |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.level == 0:
                    found.add((node.module or "").split(".")[0])
        found -= own if folder == "tests" else set()
    return found - OURS - set(sys.stdlib_module_names)


def modules(requirements: dict[str, Requirement]) -> set[str]:
    return {IMPORTED_AS.get(name, name) for name in requirements if name not in COMMANDS}


def test_daemon_and_engines_import_only_the_core_dependencies() -> None:
    assert imported("daemon", "engines", extras=False) <= modules(CORE)


def test_what_flies_starts_without_faiss() -> None:
    code = "import sys; sys.modules['faiss'] = None; import terrafix.anchor.node, terrafix_tools.mapping.place_index"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_what_flies_starts_without_the_tests_that_gtsam_brings() -> None:
    """systemd/install.sh takes pytest away from a vehicle."""
    without = "import sys; sys.modules.update(dict.fromkeys(('pytest', '_pytest', 'pluggy', 'iniconfig')))"
    code = f"{without}; import terrafix.estimator.node, terrafix.smoother.node"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert "uninstall --yes pytest pluggy iniconfig" in (ROOT / "systemd" / "install.sh").read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_import_is_declared_and_every_dependency_is_imported() -> None:
    declared = modules(CORE) | modules(EXTRAS["ground"]) | modules(EXTRAS["sim"]) | modules(EXTRAS["cluster"])
    declared |= (modules(EXTRAS["train"]) - EXPORTER) | modules(EXTRAS["faiss"]) | modules(EXTRAS["fleet"])
    declared |= modules(EXTRAS["vehicle"])
    declared |= modules(EXTRAS["console"]) | modules(EXTRAS["rosbag"])
    assert imported("daemon", "engines", "tools") == declared
    assert imported("tests") - declared <= modules(EXTRAS["dev"]) | modules(EXTRAS["nightly"])
    assert modules(EXTRAS["dev"]) <= imported("tests")


def test_every_dependency_has_a_version_range() -> None:
    for requirement in [*CORE.values(), *(one for extra in RANGED for one in EXTRAS[extra].values())]:
        operators = {specifier.operator for specifier in requirement.specifier}
        assert {">=", "<"} <= operators, f"{requirement}: give the lowest that works and the next major"


def test_no_opencv_with_cve_2025_53644_is_taken() -> None:
    assert not CORE["opencv-python-headless"].specifier.contains("4.11.0.86")  # 4.12 is the first without


def test_the_lock_file_has_every_dependency_within_its_range() -> None:
    """Except those of the training, whose version of PyTorch depends on the GPU driver."""
    locked: dict[str, list[str]] = {}
    for name, version in re.findall(r"^([\w.-]+)==([^\s;]+)", LOCK, flags=re.M):
        locked.setdefault(canonicalize_name(name), []).append(version)
    for requirements in (CORE, *(EXTRAS[extra] for extra in EXTRAS if extra != "train")):
        for name, requirement in requirements.items():
            assert name in locked, f"{name} is not in requirements.lock: run scripts/lock"
            for version in locked[name]:
                assert requirement.specifier.contains(version), f"requirements.lock has {name} {version}"


def test_the_same_pythons_are_stated_installed_and_checked() -> None:
    classified = [one.removeprefix("Programming Language :: Python :: ") for one in PROJECT["classifiers"]]
    pythons = [version for version in classified if version.startswith("3.")]
    oldest, newest = pythons[0], int(pythons[-1].removeprefix("3."))
    assert pythons == [f"3.{minor}" for minor in range(int(oldest.removeprefix("3.")), newest + 1)]
    assert PROJECT["requires-python"] == f">={oldest},<3.{newest + 1}"
    stated = f"Python {oldest} to 3.{newest}"
    for page in ("README.md", "docs/install.md", "docs/jetson.md", "Containerfile", "requirements.lock"):
        assert stated in (ROOT / page).read_text(encoding="utf-8"), page
    candidates = ["python3", *(f"python{version}" for version in reversed(pythons))]
    for installer in ("scripts/install", "systemd/install.sh"):
        text = (ROOT / installer).read_text(encoding="utf-8")
        assert f"needs {stated}; found" in text and f"-{' '.join(candidates)}}}; do" in text, installer
        assert f"not (3, {oldest.removeprefix('3.')}) <= sys.version_info < (3, {newest + 1})" in text, installer
    for script, listed in (
        ("scripts/pythons", f"set -- {' '.join(pythons)}"),
        ("scripts/lock", f"for python in {' '.join(pythons)};"),
        (".github/workflows/check.yml", "python: [" + ", ".join(f'"{version}"' for version in pythons) + "]"),
    ):
        assert listed in (ROOT / script).read_text(encoding="utf-8"), script


def test_the_lock_file_names_no_host() -> None:
    assert not re.search(r"://|--index-url|--extra-index-url|--find-links|file:", LOCK)


def test_the_version_is_the_same_in_code_metadata_and_changelog() -> None:
    version = PROJECT["version"]
    assert terrafix.__version__ == version == GROUND["version"]
    assert GROUND["requires-python"] == PROJECT["requires-python"]
    assert metadata.version("terrafix") == version
    newest = re.search(r"^## \[([^\]]+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.M)
    assert newest is not None and newest[1] == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_the_licence_file_matches_the_declared_licence() -> None:
    assert PROJECT["license"] == "Apache-2.0"
    assert "Version 2.0, January 2004" in (ROOT / "LICENSE").read_text(encoding="utf-8")


@pytest.mark.parametrize("package", sorted(OURS))
def test_the_packages_are_marked_as_typed(package: str) -> None:
    assert list(ROOT.glob(f"*/{package}/py.typed"))


@pytest.mark.parametrize("command", ["map build /nowhere.tif --out /nowhere.gpkg"])
def test_without_the_ground_extra_one_line_states_what_to_install(command: str) -> None:
    """The installation on a vehicle has the core dependencies only."""
    code = "import sys; sys.modules['rasterio'] = None; from terrafix_tools.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *command.split()], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr == f"terrafix: this command needs rasterio; install it: {install_command('ground')}\n"


def test_without_gdal_a_map_package_is_enough_for_replay_run_and_report() -> None:
    code = "import sys; sys.modules['rasterio'] = None; import terrafix_tools.replay, terrafix_tools.live, "
    code += "terrafix_tools.report.page, terrafix_tools.evaluate"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def files_of_wheel(folder: Path, source: Path) -> set[str]:
    """The wheel as the build backend assembles it from ``source``, unpacked in ``folder``; -> its files of code."""
    builder = pytest.importorskip("hatchling.builders.wheel", reason="the build backend is not installed")
    (wheel,) = builder.WheelBuilder(str(source)).build(directory=str(folder.parent), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
        return {name for name in archive.namelist() if name.split("/")[0] in OURS}


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of a vehicle, in a folder of its own."""
    folder = tmp_path_factory.mktemp("wheel") / "site"
    files_of_wheel(folder, ROOT)
    return folder


def in_wheel(unpacked: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command of the vehicle's wheel, outside the source tree, without GDAL and the lab of this checkout."""
    code = "import sys; sys.modules.update(rasterio=None, terrafix_lab=None); "
    code += "sys.argv[0] = 'terrafix'; from terrafix_tools.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=unpacked.parent,
        env={**os.environ, "PYTHONPATH": str(unpacked), "COLUMNS": "80"},
        check=False,
    )


def test_each_file_of_the_packages_is_in_one_of_the_two_wheels(tmp_path: Path) -> None:
    flying, ground = files_of_wheel(tmp_path / "a", ROOT), files_of_wheel(tmp_path / "b", ROOT / "tools")
    assert not flying & ground
    tracked = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *SOURCES],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    written = {name.partition("/")[2] for name in tracked.stdout.split() if name.split("/")[1] in OURS}
    both = {name for name in flying | ground if not name.startswith("terrafix/data/")}
    assert both == written


def test_a_vehicle_gets_the_commands_used_at_it_and_neither_lab_nor_console(unpacked: Path) -> None:
    folders = {path.name for path in (unpacked / "terrafix_tools").iterdir()} | {
        path.name for path in unpacked.iterdir()
    }
    assert not folders & {"terrafix_lab", "console", "export", "fleet", "finalise", "compare", "locate", "parallel"}
    assert not (unpacked / "terrafix_engines" / "train").exists()
    shown = in_wheel(unpacked, "--help")
    commands = [line.split()[1] for line in shown.stdout.splitlines() if re.match(r"│ [a-z]", line)]
    at_it = "run status hint init config preflight camera source files models replay report evaluate log map"
    assert commands == at_it.split(), shown.stderr
    status = in_wheel(unpacked, "status", "--run", "nowhere")
    assert status.returncode == 2 and status.stderr.startswith("terrafix: nowhere: no such folder; omit --run")


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        ("demo", "ground"),
        ("finalise out/run", "ground"),
        ("map build map.tif --out map.gpkg", "ground"),
        ("models fetch xfeat", "ground"),
        ("serve", "console"),
    ],
)
def test_a_command_that_a_vehicle_does_not_have_says_what_to_install(unpacked: Path, words: str, extra: str) -> None:
    done = in_wheel(unpacked, *words.split())
    assert done.returncode == 2
    pip = f"{sys.executable} -m pip install"
    assert done.stderr == f"terrafix: this command needs terrafix-ground; install it: {pip} 'terrafix[{extra}]'\n"


def test_a_geotiff_on_a_vehicle_is_one_line(unpacked: Path, tmp_path: Path) -> None:
    (tmp_path / "map.tif").touch()
    flight = ("--source", "/dev/video0", "--map", str(tmp_path / "map.tif"), "--out", str(tmp_path / "out"))
    done = in_wheel(unpacked, "run", *flight)
    assert done.returncode == MapError.exit_code
    assert re.fullmatch(r"terrafix: \S+/map.tif: no map package .* pip install .*\[ground\]'.*\n", done.stderr)


@pytest.mark.slow
def test_every_module_of_the_vehicles_wheel_is_imported_without_the_ground(unpacked: Path) -> None:
    """An import at the top of a module that only the ground has would end `terrafix run` in the field."""
    extras = [modules(EXTRAS[extra]) for extra in EXTRAS if extra not in ("dev", "nightly")]
    absent = [*sorted(set().union(*extras) - modules(CORE)), "terrafix_lab"]
    names = [
        ".".join(path.relative_to(unpacked).with_suffix("").parts)
        for path in sorted(unpacked.rglob("*.py"))
        if path.name not in ("__main__.py", SEARCH.name)
    ]
    code = f"import importlib, sys; sys.modules.update(dict.fromkeys({absent}))\nfor name in {names}: "
    code += "importlib.import_module(name)"
    environment = {**os.environ, "PYTHONPATH": str(unpacked)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr


def test_every_extra_whose_commands_are_on_the_ground_brings_them() -> None:
    ground = f"{GROUND['name']}=={PROJECT['version']}"
    extras = PROJECT["optional-dependencies"]
    assert {extra for extra in extras if ground in extras[extra]} == set(extras) - WITHOUT_GROUND
    assert GROUND["dependencies"] == [f"{PROJECT['name']}=={PROJECT['version']}"]


def test_the_wheel_has_the_files_of_the_source_tree_and_copies_them(unpacked: Path) -> None:
    done = in_wheel(unpacked, "files", "copies")
    assert done.returncode == 0, done.stderr
    copies = unpacked.parent / "copies"
    for folder in ("config", "systemd"):
        for path in (path for path in (ROOT / folder).rglob("*") if path.is_file()):
            assert (copies / path.relative_to(ROOT)).read_bytes() == path.read_bytes()
    assert str(unpacked) in in_wheel(unpacked, "files").stdout, "they come from the wheel, not from the source tree"
    (copies / "config" / "default.toml").write_text("mine")
    again = in_wheel(unpacked, "files", "copies")
    assert again.returncode == 6 and "exists, with other content" in again.stderr


def test_the_installer_of_the_wheel_installs_unit_and_settings(unpacked: Path, tmp_path: Path) -> None:
    installer = unpacked / "terrafix" / "data" / "systemd" / "install.sh"
    done = subprocess.run(["sh", str(installer), "--prefix", str(tmp_path), "--no-pip"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "etc/systemd/system/terrafix.service").is_file()
    assert (tmp_path / "etc/terrafix/terrafix.toml").is_file()
    stub = tmp_path / "python"
    stub.write_text('#!/bin/sh\n[ "$1" = --version ] && echo "Python 3.15.2"\n')
    stub.chmod(0o755)
    command = ["sh", str(ROOT / "systemd" / "install.sh"), "--prefix", str(tmp_path), "--python", str(stub)]
    too_new = subprocess.run(command, capture_output=True, text=True)
    assert too_new.returncode == 1 and "needs Python 3.11 to 3.14; found Python 3.15.2. See" in too_new.stderr
    no_package = subprocess.run(["sh", str(installer), "--prefix", str(tmp_path)], capture_output=True, text=True)
    assert no_package.returncode == 2 and "give the wheel with --package" in no_package.stderr


def test_the_image_has_the_labels_of_a_blueos_extension() -> None:
    text = (ROOT / "Containerfile").read_text(encoding="utf-8").replace("\\\n", "")
    assert f"ARG VERSION={PROJECT['version']} " in text
    labels = {name: json.loads(value) for name, value in re.findall(r"^LABEL (\w+)='(.*)'$", text, re.MULTILINE)}
    assert set(labels) == {"authors", "company", "tags", "permissions"}
    permissions = labels["permissions"]
    assert set(permissions["ExposedPorts"]) == set(permissions["HostConfig"]["PortBindings"]) == {"8700/tcp"}
    command = typer.main.get_command(app).get_command(None, "serve")
    known = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in permissions["Cmd"] if word.startswith("--")} <= known
