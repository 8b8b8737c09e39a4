"""Figures of hot restarts."""

from collections.abc import Sequence

import pytest

from terrafix_lab.bench.restart import Kill, missed, summary


@pytest.mark.parametrize(
    ("fix_s", "is_missed"),
    [([0.0, 1.9, 3.9], False), ([2.1, 2.1, 3.9], True), ([0.0, 0.0, 4.1], True), ([0.0, 0.0, None], True)],
)
def test_a_row_misses_the_limits_by_its_median_its_worst_or_a_fix_that_did_not_come(
    fix_s: Sequence[float | None], is_missed: bool
) -> None:
    row = summary([Kill("link", 0.2, 0.0, back) for back in fix_s])
    assert (missed({"link": row}) == ["link"]) is is_missed
    assert row["kills"] == 3 and row["silence_worst_s"] == 0.2
    assert (row["fix_worst_s"] is None) is (None in fix_s)


def test_silence_counts_as_the_fix_does() -> None:
    assert missed({"all": summary([Kill("all", 4.5, 0.0, 0.0)])}) == ["all"]
    assert missed({"all": summary([])}) == []
