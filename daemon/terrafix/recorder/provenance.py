"""What a record says of its origin: versions, map, models and computer, for the header of every file."""

import os
import platform
import sqlite3
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec

from terrafix.core.config import Config, Models, without_passwords
from terrafix.core.errors import MapError
from terrafix.map.format import MANIFEST_TABLE
from terrafix.map.verify import connect
from terrafix_engines.runtime import ModelFileError
from terrafix_engines.store import StoredModel, models_folder, resolve_model, sha256_of

GIT_TIMEOUT_S = 2.0
RECORD_FORMAT = "terrafix-flight/2"
NOT_MODELS = ("correlation", "folder")  # keys of [models] that name no model
_VERSIONED = ("terrafix", "numpy", "gtsam", "opencv-python-headless", "onnxruntime", "pymavlink", "mcap", "msgspec")
_MAP_KEYS = ("name", "checksum", "date", "source", "built_with")
_DEVICE_NAMES = ("/proc/device-tree/model", "/sys/class/dmi/id/product_name")


def header(config: Config, map_path: Path | None = None) -> dict[str, str]:
    """Header of every file of a record. The camera of the flight is in its Origin, and repeated as `calibration`; what
    the source says of itself is in SourceFacts, and repeated as `source`.

    ``map_path``: map package; None: there is none."""
    parts = {
        "config": without_passwords(config),
        "versions": versions(),
        "map": map_of(map_path),
        "models": models_of(config.models),
        "device": device(),
    }
    return _encoded(parts)


def copied_header(found: dict[str, Any], **changed: Any) -> dict[str, str]:
    """Header of a record that is made of the messages of another one, in the present format, to which they were
    converted when read. ``found``: header of that record (ReadResult); ``changed``: parts that are new."""
    parts = {**found, **changed}
    return _encoded({name: part for name, part in parts.items() if name not in ("format", "calibration")})


def _encoded(parts: dict[str, Any]) -> dict[str, str]:
    return {"format": RECORD_FORMAT, **{name: msgspec.json.encode(part).decode() for name, part in parts.items()}}


def versions() -> dict[str, str]:
    """Versions of this program and of its libraries; empty text where one is not installed."""
    found = {"python": sys.version.split()[0], "platform": platform.platform(), "git": git_describe()}
    for name in _VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = ""
    return found


def git_describe() -> str:
    """Commit of the running source tree; empty text for an installed package."""
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--tags"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def map_of(path: Path | None) -> dict[str, str]:
    """Path, name, checksum, date and source of a map package; {} without a map. A map that cannot be read, which the
    anchor reports, has its path only."""
    if path is None:
        return {}
    try:
        db = connect(path)
        try:
            rows = dict(db.execute(f"SELECT key, value FROM {MANIFEST_TABLE}"))
        finally:
            db.close()
    except (MapError, sqlite3.Error, UnicodeDecodeError):
        rows = {}
    return {"path": str(path), **{key: rows[key] for key in _MAP_KEYS if key in rows}}


def models_of(models: Models) -> dict[str, dict[str, str]]:
    """Path and sha256 of each configured model; sha256 is empty where the file cannot be read."""
    found = {}
    for slot, text in msgspec.to_builtins(models).items():
        if text and slot not in NOT_MODELS:
            path, digest = text, ""
            try:
                model = resolve_model(text, slot, models_folder(models.folder))
                path = str(model.path if isinstance(model, StoredModel) else model)
                digest = sha256_of(Path(path))
            except (ModelFileError, OSError):
                pass
            found[slot] = {"path": path, "sha256": digest}
    return found


def device() -> dict[str, Any]:
    """The computer: product, processor, cores, memory, kernel. Empty text: not known."""
    return {
        "product": next((text for name in _DEVICE_NAMES if (text := _line(Path(name)))), ""),
        "machine": platform.machine(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "memory_mb": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20,
        "kernel": platform.release(),
    }


def processor() -> str:
    """Name of the processor; empty text: not known."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")


def _line(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip("\0\n ")
    except OSError:
        return ""
