"""Import rules: direction of dependencies, one owner of each heavy library, libraries that the link must not load."""

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from terrafix_tools import cli

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = {
    "terrafix": ROOT / "daemon" / "terrafix",
    "terrafix_engines": ROOT / "engines" / "terrafix_engines",
    "terrafix_tools": ROOT / "tools" / "terrafix_tools",
    "terrafix_lab": ROOT / "tools" / "terrafix_lab",
}
# library -> the modules (and their submodules) that may import it
OWNERS = {
    "gtsam": (
        "terrafix.estimator",
        "terrafix.smoother",
        "terrafix_tools.finalise",
        "terrafix_lab.bench.growth.estimator_cost",
    ),
    "pymavlink": (
        "terrafix.link",
        "terrafix_lab.sim.autopilot",
        "terrafix.core.mavlink.tlog",
        "terrafix_lab.sim.flights.folder",
        "terrafix_lab.sim.flights.log",
        "terrafix_lab.sim.sitl",
        "terrafix_tools.preflight",
        "terrafix_lab.golden",
        "terrafix_tools.autopilot_log",
    ),  # tlog: reads recorded telemetry
    "mavsdk": ("terrafix_lab.sim.sitl",),
    "serial": ("terrafix.link",),
    "onnxruntime": ("terrafix_engines",),
    "torch": ("terrafix_lab.train",),
    "faiss": ("terrafix.anchor.place_index.faiss_ivf",),
    "systemd": ("terrafix.runtime.systemd",),
    "zmq": ("terrafix.runtime",),
    "pickle": (),
}
DIRECTION = {  # package -> other packages of the project that it may import
    "terrafix_lab": {"terrafix_tools", "terrafix", "terrafix_engines"},
    "terrafix_tools": {"terrafix", "terrafix_engines"},
    "terrafix": {"terrafix_engines"},
    "terrafix_engines": set(),
}
# Packages and modules of terrafix that are not a process and may be imported by all.
COMMON = {"core", "map", "messages", "processes", "runtime"}


def modules() -> Iterator[tuple[str, Path]]:
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = [package, *path.relative_to(folder).with_suffix("").parts]
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


MODULES = dict(modules())


@cache
def imports(path: Path) -> tuple[str, ...]:
    """All imported modules, also inside functions; ``from a import b`` counts as a.b."""
    found: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(found)


def within(name: str, module: str) -> bool:
    return name == module or name.startswith((module + ".", module + "_"))


def test_packages_are_imported_in_one_direction_only() -> None:
    for module, path in MODULES.items():
        package = module.split(".")[0]
        ours = {name.split(".")[0] for name in imports(path)} & set(PACKAGES)
        assert ours <= DIRECTION[package] | {package}, module


def test_below_the_lab_only_the_table_of_commands_names_it() -> None:
    """A name in a string (a process to start, a module to load) is a dependency as much as an import."""
    named = {
        module: path.read_text(encoding="utf-8").count("terrafix_lab")
        for module, path in MODULES.items()
        if module.split(".")[0] != "terrafix_lab"
    }
    in_table = sum(path.startswith("terrafix_lab.") for path in cli.MODULES.values())
    assert {module: count for module, count in named.items() if count} == {"terrafix_tools.cli": in_table}


# Names of public classes that still have two meanings in their package, or in the tests.
TWO_MEANINGS = {"terrafix": {"Hypothesis"}}
FOLDERS = {**PACKAGES, "tests": Path(__file__).parents[2]}


@pytest.mark.parametrize("package", FOLDERS)
def test_the_name_of_a_public_class_means_one_thing_in_its_package(package: str) -> None:
    defined = Counter(
        node.name
        for path in FOLDERS[package].rglob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert {name for name, count in defined.items() if count > 1} <= TWO_MEANINGS.get(package, set())


def test_heavy_libraries_are_imported_by_their_owners_only() -> None:
    for module, path in MODULES.items():
        for name in imports(path):
            owners = OWNERS.get(name.split(".")[0])
            assert owners is None or any(within(module, owner) for owner in owners), f"{module} imports {name}"


PROCESS_FOLDERS = sorted({p.parent.name for p in PACKAGES["terrafix"].glob("*/__init__.py")} - COMMON)


@pytest.mark.parametrize("folder", PROCESS_FOLDERS)
def test_process_folders_do_not_import_each_other(folder: str) -> None:
    for module, path in MODULES.items():
        if module.startswith(f"terrafix.{folder}"):
            for name in imports(path):
                parts = name.split(".")
                if parts[0] == "terrafix" and len(parts) > 1:
                    assert parts[1] in COMMON | {folder}, f"{module} imports {name}"


@pytest.mark.parametrize("folder", PROCESS_FOLDERS)
def test_of_the_runtime_process_folders_import_only_the_checkpoint_mechanism(folder: str) -> None:
    """Processes do not know the run folder: all of their files in it are checkpoints (runtime/checkpoint.py)."""
    for module, path in MODULES.items():
        if module.startswith(f"terrafix.{folder}"):
            used = {name for name in imports(path) if name.startswith("terrafix.runtime")}
            assert used <= {"terrafix.runtime.checkpoint.CheckpointFile"}, f"{module} imports {used}"


@pytest.mark.parametrize(
    ("folder", "allowed"),
    [
        ("core", {"core", "messages"}),
        ("map", {"core", "map", "messages"}),
        ("runtime", {"core", "messages", "processes", "runtime"}),
    ],
)
def test_common_packages_import_nothing_above_them(folder: str, allowed: set[str]) -> None:
    for module, path in MODULES.items():
        if within(module, f"terrafix.{folder}"):
            ours = [name.split(".") for name in imports(path) if name.startswith("terrafix")]
            assert all(parts[0] == "terrafix" and parts[1] in allowed for parts in ours), module


def test_the_link_process_is_free_of_gtsam_opencv_and_onnxruntime() -> None:
    process = "terrafix.runtime.process_main, terrafix.runtime.executor, terrafix.link.node"
    assert loaded(process, {"cv2", "gtsam", "onnxruntime", "faiss", "scipy", "matplotlib"}) == set()


def test_the_command_line_imports_no_numerical_libraries() -> None:
    """So that `--help` and a restart in flight are fast."""
    named = {"numpy", "cv2", "pyproj", "zmq", "structlog"}
    assert loaded("terrafix_tools.cli, terrafix.runtime.fork_server", named) == set()


def loaded(modules: str, named: set[str]) -> set[str]:
    """Which of the modules ``named`` are loaded after importing ``modules`` in a separate interpreter."""
    code = f"import sys, {modules}; print(*sorted({named!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_supervisor_and_processes_do_not_import_optional_libraries_at_start() -> None:
    """The supervisor needs no arrays; the anchor opens a model or checks a signature only if one is configured."""
    assert loaded("terrafix.runtime.supervisor", {"numpy", "cv2", "pyproj"}) == set()
    assert loaded("terrafix.runtime.process_main, terrafix.anchor.node", {"onnxruntime", "cryptography"}) == set()
