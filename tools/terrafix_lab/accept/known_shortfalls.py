"""The floors that are known not to hold over the generated world, each with its reason.

`terrafix accept` shows such a row as a known shortfall, and its exit code does not count it. A row whose floor holds
again is named by the headline; then its line here goes."""

import msgspec

from terrafix_lab.accept.measuring.results import JudgedRow, Verdict

WRONG_START = (
    "a start that is wrong at a small stated sigma is believed until five footprints were flown without a match"
)
SEARCH = "the search does not reach a place a kilometre off within the flight"
# (scenario, "what" of the criterion) -> reason
KNOWN_SHORTFALLS: dict[tuple[str, str], str] = {
    ("kidnapped", "truth inside the 95 % ellipse"): WRONG_START,
    ("kidnapped", "frames wrong by over 50 m and sure of it"): WRONG_START,
    ("kidnapped", "back within 50 m afterwards"): SEARCH,
}


def explained(row: JudgedRow, known: dict[tuple[str, str], str]) -> JudgedRow:
    """``row`` as a known shortfall, if it is below its floor and ``known`` has its reason; else as it is."""
    reason = known.get((row.scenario, row.what))
    if reason is None or row.verdict is not Verdict.BELOW:
        return row
    return msgspec.structs.replace(row, verdict=Verdict.KNOWN, why="; ".join(filter(None, (reason, row.why))))


def holding_again(rows: list[JudgedRow], known: dict[tuple[str, str], str]) -> list[str]:
    """Scenario and number of each row of ``known`` that holds its floor in this run."""
    return [
        f"{row.scenario}, {row.what}"
        for row in rows
        if (row.scenario, row.what) in known and row.verdict is Verdict.PASS
    ]
