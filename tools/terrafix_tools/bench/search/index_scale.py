"""Place index of large maps: recall, time and memory of FAISS and of the exact search, on generated descriptors.

python -m terrafix_tools.bench.search.index_scale MAP.tif ... --pair CAMERA.tif MAP.tif AGL [--pair ...]
    [--km2 100 1000 10000] [--searches 100] [--work FOLDER] [--json FILE]

No map is that large, so descriptors are drawn from a mixture of Gaussians that is fitted to those of the real MAPs:
weights, means and covariances of clusters. A search has four queries (squares of the frame) for each of
29 headings: one of them resembles its
disc as a frame of the other date resembles the disc below it, which is measured on each --pair; the others resemble
none. Each search strategy runs in a process of its own, whose peak memory is measured; both have the same queries."""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
import typer

from terrafix.anchor.place_index.faiss_ivf import write_faiss
from terrafix.anchor.place_index.format import FAISS, HEADER, POSITIONS, VECTORS, VERSION, Header, IndexedLayer, file_of
from terrafix.anchor.place_index.index import PlaceIndex
from terrafix.anchor.place_index.recognizer import SHIFTS
from terrafix.core.errors import TerrafixError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_engines.retrieval.places import PooledGradientPlaces
from terrafix_tools.bench.search.index_views import similarities
from terrafix_tools.bench.search.views import TwoDates
from terrafix_tools.flight_map import map_cache_dir
from terrafix_tools.mapping.build import ensure_package
from terrafix_tools.mapping.place_index import SIDE_PER_AGL, STEPS_PER_SIDE, describe_layer

AGL_M = 120.0  # height of the flights: a disc of 90 m every 22 m, 1975 of them for a square kilometre
CLUSTERS = 48  # of the mixture
OWN_COVARIANCE = 0.5  # share of a cluster's own covariance; the rest is that of all clusters: few vectors belong to one
QUERIES = 29 * len(SHIFTS)  # of an unknown heading
VIEWS_A_PAIR = 25  # frames whose similarity to the map is measured
FOUND = 200  # discs of each query, as in flight
AMONG = (1, 5, 200)
BEST = 5  # discs whose agreement is measured
CHUNK = 100_000
SEED = 7


@dataclass(frozen=True)
class Mixture:
    """Mixture of Gaussians, projected to unit vectors. ``weights`` (K,), ``means`` (K, D), ``roots`` (K, D, D):
    Cholesky factors of the covariances."""

    weights: np.ndarray
    means: np.ndarray
    roots: np.ndarray

    @classmethod
    def fit(cls, vectors: np.ndarray) -> "Mixture":
        """``vectors`` (N, D) float32."""
        stop = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 30, 1e-4)
        cv2.setRNGSeed(SEED)
        _, labels, means = cv2.kmeans(vectors, CLUSTERS, None, stop, 2, cv2.KMEANS_PP_CENTERS)  # type: ignore[call-overload]
        labels = labels.ravel()
        everywhere = np.cov((vectors - means[labels]).T)
        roots = []
        for k in range(CLUSTERS):
            own = np.cov((vectors[labels == k] - means[k]).T) if np.sum(labels == k) > 1 else everywhere
            mixed = OWN_COVARIANCE * own + (1.0 - OWN_COVARIANCE) * everywhere
            roots.append(np.linalg.cholesky(mixed + 1e-8 * np.eye(len(mixed))))
        return cls(np.bincount(labels, minlength=CLUSTERS) / len(labels), means, np.array(roots, np.float32))

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """-> (count, D) float32 unit vectors."""
        labels = np.sort(rng.choice(len(self.weights), count, p=self.weights))
        drawn = rng.standard_normal((count, self.means.shape[1]), np.float32)
        for k in np.unique(labels):
            drawn[labels == k] = self.means[k] + drawn[labels == k] @ self.roots[k].T
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        return rng.permutation(drawn)


@dataclass(frozen=True)
class Row:
    """One strategy at one size. ``recall``: share of searches with the right disc among the best 1, 5 and 200;
    ``agreement``: share of the five best discs of the exact search that are among the five best of this one;
    ``peak_mb``: peak memory of the whole process."""

    km2: float
    discs: int
    strategy: str
    recall: tuple[float, ...]
    agreement: float
    median_s: float
    p95_s: float
    cpu_s: float
    peak_mb: float
    build_s: float
    file_mb: float


def real_vectors(maps: Sequence[Path]) -> np.ndarray:
    """-> (N, D) float32 of all discs of the maps. Raises MapError."""
    found = []
    for path in maps:
        package = MapPackage.open(ensure_package(path, map_cache_dir()))
        west, south, east, north = package.manifest.bounds_wgs84
        frame = LocalFrame((south + north) / 2, (west + east) / 2)
        side_m = max(SIDE_PER_AGL * AGL_M, PooledGradientPlaces.side_px * package.manifest.gsd_m)
        found += [v for v, _ in describe_layer(package.bind(frame), frame, side_m, PooledGradientPlaces())]
    return np.concatenate(found).astype(np.float32)


def write_generated(folder: Path, mixture: Mixture, similarity: np.ndarray, km2: float, searches: int) -> float:
    """Writes a place index of that size, and its queries with the right discs. -> seconds that FAISS's index took."""
    rng = np.random.default_rng(SEED)
    count = round(km2 * 1e6 / (SIDE_PER_AGL * AGL_M / STEPS_PER_SIDE) ** 2)
    size = mixture.means.shape[1]
    vectors = np.lib.format.open_memmap(folder / VECTORS, "w+", np.float16, (count, size))
    for first in range(0, count, CHUNK):
        vectors[first : first + CHUNK] = mixture.draw(min(CHUNK, count - first), rng)
    np.save(folder / POSITIONS, np.zeros((count, 2), np.int32))
    right = rng.choice(count, searches, replace=False)
    queries = mixture.draw(searches * QUERIES, rng).reshape(searches, QUERIES, size)
    queries[:, 0] = resembling(vectors[right].astype(np.float32), queries[:, 0], rng.choice(similarity, searches))
    np.savez(folder / "queries.npz", right=right, queries=queries)
    began_s = time.monotonic()
    write_faiss(vectors, folder / FAISS)
    build_s = time.monotonic() - began_s
    layer = IndexedLayer(package="generated", checksum="", table="imagery", first=0, count=count)
    header = Header(
        version=VERSION,
        descriptor=PooledGradientPlaces.name,
        model="",
        size=size,
        side_m=SIDE_PER_AGL * AGL_M,
        step_m=SIDE_PER_AGL * AGL_M / STEPS_PER_SIDE,
        layers=(layer,),
        files={name: file_of(folder / name, hashed=False) for name in (VECTORS, POSITIONS, FAISS)},
    )
    (folder / HEADER).write_bytes(msgspec.json.encode(header))
    return build_s


def resembling(discs: np.ndarray, others: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    """Unit vectors (N, D) whose scalar product with ``discs`` is ``similarity`` (N,); the rest of each is the part of
    ``others`` that is orthogonal to its disc."""
    rest = others - np.sum(others * discs, axis=1, keepdims=True) * discs
    rest /= np.linalg.norm(rest, axis=1, keepdims=True)
    s = similarity[:, None]
    return np.asarray(s * discs + np.sqrt(1.0 - s**2) * rest, dtype=np.float32)


def search_all(folder: Path, strategy: str) -> dict[str, object]:
    """Runs all searches of a generated index. Run it in a process of its own: it measures the peak memory."""
    index = PlaceIndex.open(folder, strategy, verify=False)  # type: ignore[arg-type]
    with np.load(folder / "queries.npz") as stored:
        right, queries = stored["right"], stored["queries"]
    ranks, seconds, best = list[int](), list[float](), list[list[int]]()
    began_cpu_s = time.process_time()
    for disc, of_headings in zip(right, queries, strict=True):
        began_s = time.monotonic()
        found = index.find(of_headings, FOUND)
        seconds.append(time.monotonic() - began_s)
        best.append([one.id for one in found[:BEST]])
        ranks.append(next((rank for rank, one in enumerate(found, 1) if one.id == disc), sys.maxsize))
    return {
        "recall": [float(np.mean([rank <= k for rank in ranks])) for k in AMONG],
        "median_s": float(np.median(seconds)),
        "p95_s": float(np.quantile(seconds, 0.95)),
        "cpu_s": (time.process_time() - began_cpu_s) / len(right),
        "peak_mb": peak_mb(),
        "best": best,
    }


def peak_mb() -> float:
    """Peak resident memory of this process (VmHWM, proc(5)). ``getrusage`` would count its parent's before exec."""
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def measure(
    maps: Sequence[Path], pairs: Sequence[tuple[Path, Path, float]], sizes: Sequence[float], searches: int, work: Path
) -> list[Row]:
    """-> a row for each size and strategy. Raises TerrafixError."""
    mixture = Mixture.fit(real_vectors(maps))
    similarity = np.concatenate([similarities(TwoDates(a, b), agl, VIEWS_A_PAIR) for a, b, agl in pairs])
    rows = []
    for km2 in sizes:
        with tempfile.TemporaryDirectory(dir=work) as made:
            folder = Path(made)
            build_s = write_generated(folder, mixture, similarity, km2, searches)
            for row in compare(folder, km2, build_s):
                typer.echo(text_of(row))
                rows.append(row)
    return rows


def compare(folder: Path, km2: float, build_s: float) -> Iterator[Row]:
    """The rows of both strategies, each in a process of its own."""
    exact_best: list[list[int]] = []
    for strategy, file in (("exact", VECTORS), ("faiss", FAISS)):
        command = [sys.executable, "-m", "terrafix_tools.bench.search.index_scale", "--search", strategy]
        done = subprocess.run([*command, "--work", str(folder)], capture_output=True, text=True, check=True)
        result = json.loads(done.stdout)
        best = result.pop("best")
        exact_best = exact_best or best
        shares = [len(set(one) & set(exact)) / len(exact) for one, exact in zip(best, exact_best, strict=True)]
        yield Row(
            km2=km2,
            discs=len(np.load(folder / POSITIONS, mmap_mode="r")),
            strategy=strategy,
            agreement=float(np.mean(shares)),
            build_s=build_s if strategy == "faiss" else 0.0,
            file_mb=(folder / file).stat().st_size / 1e6,
            **result,
        )


def text_of(row: Row) -> str:
    recall = " ".join(f"{100 * share:5.1f}" for share in row.recall)
    seconds = f"{row.median_s:8.2f} {row.p95_s:6.2f} {row.cpu_s:6.2f} s"
    sizes = f"{row.peak_mb:7.0f} MB {row.file_mb:7.0f} MB {row.build_s:6.0f} s"
    return f"{row.km2:8.0f} {row.discs:9} {row.strategy:6} {recall} % {100 * row.agreement:5.1f} % {seconds} {sizes}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("maps", type=Path, nargs="*", metavar="MAP.tif", help="real maps whose descriptors are fitted")
    parser.add_argument("--pair", nargs=3, action="append", default=[], metavar=("CAMERA", "MAP", "AGL"))
    parser.add_argument("--km2", type=float, nargs="+", default=[100.0, 1000.0, 10_000.0])
    parser.add_argument("--searches", type=int, default=100)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()), help="folder for the indices")
    parser.add_argument("--json", type=Path, help="writes the table")
    parser.add_argument("--search", choices=("exact", "faiss"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.search:
        typer.echo(json.dumps(search_all(given.work, given.search)))
        return
    if not given.maps or not given.pair:
        parser.error("give at least one MAP.tif and one --pair")
    typer.echo(
        "     km2     discs          among 1, 5, 200   agrees   median   p95    CPU     memory       file  build"
    )
    try:
        pairs = [(Path(a), Path(b), float(agl)) for a, b, agl in given.pair]
        rows = measure(given.maps, pairs, given.km2, given.searches, given.work)
    except TerrafixError as error:
        sys.exit(f"{error}")
    if given.json is not None:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
