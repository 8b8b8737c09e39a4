"""Digests of messages: which changes they detect, which they ignore, and how differences are reported."""

from pathlib import Path

import msgspec
import pytest

from link_rig import S, estimate
from terrafix.core.errors import UsageError
from terrafix.messages import Frame, Message
from terrafix_lab.golden import __main__ as golden
from terrafix_lab.golden.cases import CASES, GoldenCase
from terrafix_lab.golden.digest import Digest, Digests, differences

FRAMES: list[Message] = [Frame(t_ns=i * S, frame_id=i, file=f"{i}.jpg", width=8, height=4) for i in range(3)]


def digests(messages: list[Message]) -> dict[str, Digest]:
    found = Digests()
    for message in messages:
        found.take(message)
    return found.result()


def test_every_message_type_has_its_own_digest_and_count() -> None:
    found = digests([*FRAMES, estimate(0)])
    assert {name: digest.count for name, digest in found.items()} == {"Frame": 3, "NavEstimate": 1}
    assert found["Frame"] == digests(FRAMES)["Frame"]


@pytest.mark.parametrize(
    "changed",
    [
        FRAMES[:2],
        [FRAMES[1], FRAMES[0], FRAMES[2]],
        [*FRAMES[:2], msgspec.structs.replace(FRAMES[2], t_ns=FRAMES[2].t_ns + 1)],
    ],
)
def test_a_missing_message_another_order_or_time_changes_the_digest(changed: list[Message]) -> None:
    assert digests(changed)["Frame"] != digests(FRAMES)["Frame"]


def test_the_publication_time_of_a_message_is_not_part_of_the_digest() -> None:
    assert digests([estimate(0, late_ns=0)]) == digests([estimate(0, late_ns=5 * S)])
    assert digests([estimate(0)]) != digests([estimate(0, east_m=0.001)])


def test_byte_streams_with_different_chunk_borders_have_different_digests() -> None:
    one, two = Digests(), Digests()
    for found, parts in ((one, (b"ab", b"c")), (two, (b"a", b"bc"))):
        for part in parts:
            found.take_bytes("wire", part)
    assert one.result() != two.result()


def test_a_digest_difference_names_the_stream_and_the_change() -> None:
    before = digests([*FRAMES, estimate(0)])
    now = digests([*FRAMES[:2], msgspec.structs.replace(FRAMES[2], width=9)])
    assert differences(before, before) == []
    assert differences(before, now) == ["Frame: 3, other contents", "NavEstimate: gone (1)"]
    assert differences(now, digests(FRAMES[:1])) == ["Frame: 3 -> 1"]
    assert differences({}, digests(FRAMES)) == ["Frame: new (3)"]


def test_case_names_are_unique_and_an_unknown_name_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    with pytest.raises(UsageError, match="'towm-a': unknown; choose from: montecarlo"):
        golden.wanted_cases(["towm-a"], tmp_path)
    left = [case.name for case in golden.wanted_cases([], tmp_path)]
    assert left == [case.name for case in CASES if not case.needs]
    assert "town-a: skipped" in capsys.readouterr().err


def test_missing_and_corrupt_reference_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="write it with --update-refs"):
        golden.references(tmp_path / "none.json")
    (tmp_path / "torn.json").write_text('{"montecarlo": {"Frame"')
    with pytest.raises(UsageError, match="not a file of references"):
        golden.references(tmp_path / "torn.json")


def test_cases_are_compared_with_their_references(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    case = GoldenCase("flight", lambda _, __: {})
    monkeypatch.setattr(golden, "run_case", lambda *_: digests(FRAMES))
    golden.write(tmp_path / "refs.json", {"flight": digests(FRAMES)})
    assert golden.compare([case], tmp_path, golden.references(tmp_path / "refs.json")) == 0
    assert golden.compare([case], tmp_path, {"flight": digests(FRAMES[:2])}) == 1
    assert golden.compare([case], tmp_path, {}) == 1


@pytest.mark.slow
def test_a_failed_case_gives_its_reason_in_one_line(tmp_path: Path) -> None:
    town = next(case for case in CASES if case.name == "town-a")
    with pytest.raises(UsageError, match=r"town-a: failed; .*town-a"):
        golden.run_case(town, tmp_path)
