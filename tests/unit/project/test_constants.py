"""Every constant of estimator, anchor and link says where it comes from, and the number of chosen ones only falls."""

from collections import Counter

from constants_ledger import constants

MAX_TUNED = 463  # lower it when a constant gets a measurement or a specification; never raise it


def test_every_constant_has_a_source() -> None:
    without = [f"{c.where} {c.name}" for c in constants() if c.source is None]
    assert not without, "a comment with [measured: where], [spec: what] or [tuned] is missing: " + ", ".join(without)


def test_the_number_of_tuned_constants_only_falls() -> None:
    tuned = Counter(c.source for c in constants())["tuned"]
    assert tuned <= MAX_TUNED, "give the new constant a measurement or a specification"
    assert tuned == MAX_TUNED, f"set MAX_TUNED to {tuned}, so that it cannot rise again"
