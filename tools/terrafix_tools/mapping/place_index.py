"""``terrafix map index``: place descriptors of one or several map packages, and the FAISS index over them."""

import math
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from terrafix.anchor.place_index.faiss_ivf import write_faiss
from terrafix.anchor.place_index.format import (
    DEGREES,
    FAISS,
    HEADER_FILE,
    INDEX_VERSION,
    POSITIONS,
    VECTORS,
    Header,
    IndexedLayer,
    file_of,
)
from terrafix.anchor.place_index.index import MAX_EXACT
from terrafix.core.errors import MapError, ModelError, OutputError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.retrieval.places import PlaceDescriber, disc, open_place_describer
from terrafix_engines.runtime import ModelFileError

# Diameter of the discs in heights: a frame whose shorter side is 0.87 heights (60 degrees, 4:3) shows them whatever its
# heading, with the squares beside its middle.
SIDE_PER_AGL = 0.75
STEPS_PER_SIDE = 4  # discs of a row or column within a side
VALID_SHARE = 0.95  # least share of a disc with imagery
ROW_CHUNK = 256  # discs that are described at a time


@dataclass(frozen=True)
class IndexOptions:
    """``agl_m``: height of the flights. ``model``: place descriptor. ``faiss``: makes a FAISS index in any case, not
    only of more vectors than the exact search takes."""

    agl_m: float
    model: str
    models_folder: str = ""
    faiss: bool = False


def write_index(packages: Sequence[Path], out: Path, options: IndexOptions) -> Header:
    """Writes the folder ``out`` (``place_index.format``). Raises MapError, ModelError, OutputError, UsageError."""
    try:
        describer = open_place_describer(options.model, options.models_folder)
    except ModelFileError as error:
        raise ModelError(str(error)) from None
    if out.exists():
        raise OutputError(f"{out}: exists; choose another folder, or remove it")
    part = Path(tempfile.mkdtemp(prefix=f"{out.name}.", dir=_parent(out)))
    try:
        header = _write(packages, part, options, describer)
        part.replace(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error}); check folder and space") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return header


def _parent(out: Path) -> Path:
    if not out.resolve().parent.is_dir():
        raise OutputError(f"{out}: the folder {out.parent} does not exist; make it first")
    return out.resolve().parent


def _write(packages: Sequence[Path], folder: Path, options: IndexOptions, describer: PlaceDescriber) -> Header:
    side_m = SIDE_PER_AGL * options.agl_m
    layers, vectors, positions = list[IndexedLayer](), list[np.ndarray](), list[np.ndarray]()
    for path in packages:
        package = MapPackage.open(path)
        west, south, east, north = package.manifest.bounds_wgs84
        frame = LocalFrame((south + north) / 2, (west + east) / 2)
        imagery = [layer for layer in package.manifest.layers if not layer.is_drawn]
        if not imagery:
            raise MapError(f"{path}: has no imagery, and the search of a drawn map uses no index; leave it out")
        for layer in imagery:
            first = sum(map(len, vectors))
            for row_vectors, row_positions in describe_layer(
                package.bind(frame, layer.table), frame, side_m, describer
            ):
                vectors.append(row_vectors)
                positions.append(row_positions)
            layers.append(
                IndexedLayer(
                    package=path.name,
                    checksum=package.manifest.checksum,
                    table=layer.table,
                    first=first,
                    count=sum(map(len, vectors)) - first,
                )
            )
        package.close()
    if not vectors:
        raise MapError(f"{packages[0]}: has no ground of {side_m:.0f} m in one piece; give a smaller height")
    every = np.concatenate(vectors)
    np.save(folder / VECTORS, every)
    np.save(folder / POSITIONS, np.concatenate(positions))
    names = [VECTORS, POSITIONS]
    if options.faiss or len(every) > MAX_EXACT:
        write_faiss(every, folder / FAISS)
        names.append(FAISS)
    header = Header(
        version=INDEX_VERSION,
        descriptor=describer.name,
        model=options.model,
        size=describer.size,
        side_m=side_m,
        step_m=side_m / STEPS_PER_SIDE,
        layers=tuple(layers),
        files={name: file_of(folder / name, hashed=True) for name in names},
    )
    (folder / HEADER_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(header)))
    return header


def describe_layer(
    local: LocalMap, frame: LocalFrame, side_m: float, describer: PlaceDescriber
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Row by row from the north: vectors (N, D) float16 and positions (N, 2) int32 of the discs with imagery."""
    e_min, n_min, e_max, n_max = local.bounds_m
    side_px, gsd_m, step_m = describer.side_px, side_m / describer.side_px, side_m / STEPS_PER_SIDE
    inside = disc(side_px, 0.0) > 0.0
    columns_m = np.arange(e_min, e_max - side_m + step_m, step_m)
    rows = max(math.floor((n_max - n_min - side_m) / step_m) + 1, 0)
    for row in range(rows):
        top_m = n_max - row * step_m
        for begin in range(0, len(columns_m), ROW_CHUNK):
            corners_m = columns_m[begin : begin + ROW_CHUNK]
            starts = np.round((corners_m - corners_m[0]) / gsd_m).astype(int)
            image, valid = local.window(corners_m[0], top_m, int(starts[-1]) + side_px, side_px, gsd_m)
            starts = [s for s in starts if valid[:, s : s + side_px][inside].mean() >= VALID_SHARE]
            if not starts:
                continue
            vectors = describer.describe(np.array([image[:, s : s + side_px] for s in starts]))
            centres_m = [(corners_m[0] + (s + side_px / 2) * gsd_m, top_m - side_m / 2) for s in starts]
            degrees = np.array([frame.to_wgs84(*at) for at in centres_m])
            yield vectors.astype(np.float16), np.round(degrees / DEGREES).astype(np.int32)
