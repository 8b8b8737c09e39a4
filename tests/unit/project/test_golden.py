"""Digests of messages: what changes one, what does not, and what is said of a difference."""

from pathlib import Path

import msgspec
import pytest

from link_rig import S, estimate
from terrafix.core.errors import UsageError
from terrafix.messages import Frame, Message
from terrafix_tools.golden import __main__ as golden
from terrafix_tools.golden.cases import CASES, Case
from terrafix_tools.golden.digest import Digest, Digests, differences

FRAMES: list[Message] = [Frame(t_ns=i * S, frame_id=i, file=f"{i}.jpg", width=8, height=4) for i in range(3)]


def digests(messages: list[Message]) -> dict[str, Digest]:
    found = Digests()
    for message in messages:
        found.take(message)
    return found.result()


def test_every_type_has_its_own_digest_and_count() -> None:
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
def test_one_message_less_another_order_and_one_nanosecond_change_the_digest(changed: list[Message]) -> None:
    assert digests(changed)["Frame"] != digests(FRAMES)["Frame"]


def test_the_time_at_which_the_shell_sent_a_message_is_not_compared() -> None:
    assert digests([estimate(0, late_ns=0)]) == digests([estimate(0, late_ns=5 * S)])
    assert digests([estimate(0)]) != digests([estimate(0, east_m=0.001)])


def test_two_streams_of_bytes_differ_where_only_their_borders_do() -> None:
    one, two = Digests(), Digests()
    for found, parts in ((one, (b"ab", b"c")), (two, (b"a", b"bc"))):
        for part in parts:
            found.take_bytes("wire", part)
    assert one.result() != two.result()


def test_a_difference_says_which_stream_and_how() -> None:
    before = digests([*FRAMES, estimate(0)])
    now = digests([*FRAMES[:2], msgspec.structs.replace(FRAMES[2], width=9)])
    assert differences(before, before) == []
    assert differences(before, now) == ["Frame: 3, other contents", "NavEstimate: gone (1)"]
    assert differences(now, digests(FRAMES[:1])) == ["Frame: 3 -> 1"]
    assert differences({}, digests(FRAMES)) == ["Frame: new (3)"]


def test_case_names_are_unique_and_an_unknown_one_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    with pytest.raises(UsageError, match="'towm-a': there is none; choose from: montecarlo"):
        golden.wanted_cases(["towm-a"], tmp_path)
    left = [case.name for case in golden.wanted_cases([], tmp_path)]
    assert left == [case.name for case in CASES if not case.needs]
    assert "town-a: left out" in capsys.readouterr().err


def test_references_that_are_absent_or_no_references(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="write it with --update-refs"):
        golden.references(tmp_path / "none.json")
    (tmp_path / "torn.json").write_text('{"montecarlo": {"Frame"')
    with pytest.raises(UsageError, match="not a file of references"):
        golden.references(tmp_path / "torn.json")


def test_cases_are_compared_with_their_references(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    case = Case("flight", lambda _, __: {})
    monkeypatch.setattr(golden, "found", lambda *_: digests(FRAMES))
    golden.write(tmp_path / "refs.json", {"flight": digests(FRAMES)})
    assert golden.compare([case], tmp_path, golden.references(tmp_path / "refs.json")) == 0
    assert golden.compare([case], tmp_path, {"flight": digests(FRAMES[:2])}) == 1
    assert golden.compare([case], tmp_path, {}) == 1


def test_a_case_that_fails_says_why_in_one_line(tmp_path: Path) -> None:
    town = next(case for case in CASES if case.name == "town-a")
    with pytest.raises(UsageError, match=r"town-a: failed; .*town-a"):
        golden.found(town, tmp_path)
