"""Criteria over a track of claims and truth, which acceptance, Monte Carlo and the fault matrix share."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix_lab.faults.edits import Span
from terrafix_lab.track import CRITERIA, Track, measured


def track(error_m: dict[int, float], sigma_m: dict[int, float] | None = None, fault: Span | None = None) -> Track:
    """40 positions, one a second, 2 m off at a sigma of 5 m but for those that are given; nan: none."""
    errors, sigmas = np.full(40, 2.0), np.full(40, 5.0)
    errors[list(error_m)], sigmas[list(sigma_m or {})] = list(error_m.values()), list((sigma_m or {}).values())
    return Track(np.arange(40.0), errors, (errors / sigmas) ** 2, sigmas, fault)


FAULT = Span(10.0, 20.0, "fault")


def test_a_position_is_late_beyond_20_m_and_3_sigma_after_3_s_and_five_positions() -> None:
    late = CRITERIA["late sure over 20 m"].measure
    assert late(track({12: 21.0, 14: 21.0}, fault=FAULT)) == 0.0, "the fifth position of the fault is at 14 s"
    assert late(track({9: 21.0, 15: 21.0, 16: 19.0}, fault=FAULT)) == 2.0
    assert late(track({15: 21.0}, {15: 7.1}, FAULT)) == 0.0 and late(track({15: float("nan")}, fault=FAULT)) == 0.0


def test_right_again_are_three_positions_in_a_row_within_20_m_and_claimed_to_30_m() -> None:
    assert track({}, fault=FAULT).again_s() == 1.0
    assert track({22: 30.0}, fault=FAULT).again_s() == 3.0, "21 s alone is no three in a row"
    wide = {k: 12.4 for k in range(15, 31)}  # 95 %: 30.4 m
    assert track({}, wide, FAULT).again_s() == 11.0
    assert track({}, {k: 12.2 for k in range(15, 31)}, FAULT).again_s() == 1.0
    assert track({k: float("nan") for k in range(21, 40)}, fault=FAULT).again_s() == float("inf")
    assert track({}).again_s() is None and track({}, fault=Span(10.0, 38.0, "")).again_s() is None


def test_several_flights_are_shown_as_the_worst_and_one_that_never_is_right_again_is_counted() -> None:
    right, late = track({}, fault=FAULT), track({k: 25.0 for k in range(15, 24)}, fault=FAULT)
    assert measured([right, late]) == {"late sure over 20 m": "9", "right again": "4 s"}
    never = track({k: float("nan") for k in range(21, 40)}, fault=FAULT)
    assert measured([right, never])["right again"] == "never in 1 of 2 flights"
    assert measured([track({})]) == {"late sure over 20 m": "0", "right again": "-"}


def test_the_time_to_notice_ends_at_the_last_false_position_after_the_beginning() -> None:
    assert track({5: 90.0, 13: 90.0}, fault=FAULT).notice_s() == pytest.approx(3.0)
    assert track({5: 90.0}, fault=FAULT).notice_s() is None and track({5: 90.0}).notice_s() is None
    assert track({0: 90.0, 1: 90.0}).is_late().sum() == 2, "without a fault all are"


def test_a_fault_is_reported_by_its_cause_and_named_by_the_verdict() -> None:
    texts = [(9.0, "picture frozen"), (12.0, "3D fix"), (14.0, "picture frozen: not used")]
    found = replace(track({15: 25.0, 17: 25.0}, fault=FAULT), texts=texts, cause="picture frozen")
    assert measured([found])["reported"] == "4 s" and found.verdict_s() == float("inf")
    named = replace(found, refused=[Span(8.0, 16.0, "picture frozen")], untrusted=[Span(16.0, 18.0, "no position")])
    assert measured([named])["in the verdict"] == "0 s" and measured([named])["trusted and wrong"] == "1"
    other = replace(named, cause="upside down")
    assert other.reported_s() == other.verdict_s() == float("inf") and replace(named, cause="").reported_s() is None
