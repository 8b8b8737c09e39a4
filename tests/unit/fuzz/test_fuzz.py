"""Fuzzing of the parsers of what comes from outside: mutated inputs, a corpus of earlier findings, and its command."""

import random
import sqlite3
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer import Exit

from terrafix.core.errors import MapError, SourceError
from terrafix.map.package import MapPackage
from terrafix.vision.sources.images import decode_image
from terrafix_lab.fuzz import __main__ as command
from terrafix_lab.fuzz.mutate import MAX_BYTES, mutated
from terrafix_lab.fuzz.targets import HEIGHT, TARGETS, WIDTH, Target, refused_or_read

CORPUS = Path(__file__).resolve().parents[2] / "corpus"
TARGET_OF = {target.name.replace(" ", "-"): target for target in TARGETS}
EXAMPLES = 25  # of each target; the command runs as many as one likes
BOUNDED = settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck), database=None)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_valid_inputs_are_read(target: Target) -> None:
    for seed in target.seeds():
        if target.name not in ("mission", "plan", "autopilot log", "photo"):  # of several formats under one name
            target.run(seed)
        else:
            refused_or_read(target, seed)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_a_mutated_input_is_read_or_refused_in_one_line(target: Target) -> None:
    seeds = target.seeds()

    @BOUNDED
    @given(st.randoms(use_true_random=False))
    def check(rng: random.Random) -> None:
        refused_or_read(target, mutated(seeds, rng))

    check()


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_arbitrary_bytes_are_read_or_refused_in_one_line(target: Target) -> None:
    @BOUNDED
    @given(st.binary(max_size=400))
    def check(data: bytes) -> None:
        refused_or_read(target, data)

    check()


@pytest.mark.parametrize("file", sorted(CORPUS.glob("*/*")), ids=lambda file: f"{file.parent.name}/{file.name}")
def test_inputs_that_were_findings_are_read_or_refused_in_one_line(file: Path) -> None:
    refused_or_read(TARGET_OF[file.parent.name], file.read_bytes())


NULLS = (
    ("terrafix_manifest", "key"),
    ("terrafix_manifest", "value"),
    ("terrafix_hash", "table_name"),
    ("terrafix_hash", "sha256"),
    ("imagery", "tile_data"),
)


@pytest.mark.parametrize(("table", "column"), NULLS)
def test_a_map_whose_table_has_a_null_is_refused_in_one_line(table: str, column: str, tmp_path: Path) -> None:
    """Mutated maps ended in tracebacks there; their own files are too large for the corpus."""
    path = tmp_path / "map.gpkg"
    path.write_bytes(TARGET_OF["map"].seeds()[0])
    with sqlite3.connect(path) as db:
        db.executescript(
            f"CREATE TABLE copy AS SELECT * FROM {table}; DROP TABLE {table}; ALTER TABLE copy RENAME TO {table};"
            f"UPDATE {table} SET {column} = NULL WHERE rowid = 1"
        )
    db.close()
    with pytest.raises(MapError, match=r"damaged|altered"):
        MapPackage.open(path, verify=True)
    refused_or_read(TARGET_OF["map"], path.read_bytes())


def test_mutations_differ_from_their_seeds_are_bounded_and_the_same_for_a_seed() -> None:
    seeds = [b"abcdefgh" * 50, b"12345"]
    made = [mutated(seeds, random.Random(i)) for i in range(200)]
    assert made == [mutated(seeds, random.Random(i)) for i in range(200)]
    assert sum(data not in seeds for data in made) > 180 and len(set(made)) > 150
    assert max(map(len, (mutated([bytes(MAX_BYTES)], random.Random(i)) for i in range(3)))) <= MAX_BYTES


def breaks_at_x(data: bytes) -> None:
    if b"x" in data:
        raise SourceError("refused")
    if len(data) < 3:
        raise ValueError("a bug")


def test_the_command_finds_a_bug_writes_its_input_and_ends_with_exit_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "TARGETS", (Target("broken", lambda: [b"abcdef"], breaks_at_x),))
    with pytest.raises(Exit) as ended:
        command.main(target=None, executions=500, seed=1, out=tmp_path)
    assert ended.value.exit_code == 1
    (file,) = tmp_path.iterdir()
    assert file.name == "broken-1" and len(file.read_bytes()) < 3
    assert "broken: 500 executions, 1 findings" in capsys.readouterr().out


def spins(_data: bytes) -> None:
    while True:
        pass


def test_an_input_that_takes_too_long_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "LIMIT_S", 0.05)
    monkeypatch.setattr(command, "TARGETS", (Target("slow", lambda: [b"a"], spins),))
    with pytest.raises(Exit) as ended:
        command.main(target=None, executions=1, seed=1, out=tmp_path)
    assert ended.value.exit_code == 1 and (tmp_path / "slow-1").exists()


@pytest.mark.parametrize("file", sorted((CORPUS / "image").glob("chunk-*")), ids=lambda file: file.name)
def test_a_png_whose_chunk_states_gigabytes_is_refused_without_taking_them(file: Path) -> None:
    data = file.read_bytes()
    taken_mb = command._memory_of(lambda: refused_or_read(TARGET_OF["image"], data))
    assert taken_mb < 50.0
    assert decode_image(data, WIDTH, HEIGHT)[0] is None


def test_memory_beyond_the_limit_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        command, "TARGETS", (Target("hungry", lambda: [b"a"], lambda _data: bytearray(300 << 20).clear()),)
    )
    with pytest.raises(Exit):
        command.main(target=None, executions=1, seed=1, out=tmp_path)
    assert (tmp_path / "hungry-1").exists()
