"""The synthetic record of the benchmark of the report, and its limits."""

from pathlib import Path

from terrafix.messages import MapMatch, NavEstimate
from terrafix.recorder.reader import read_flight
from terrafix_tools.bench.long_flight import Rates
from terrafix_tools.bench.long_record import write_long_record
from terrafix_tools.bench.report import LIMITS, exceeded
from terrafix_tools.report.gather import gather
from terrafix_tools.report.page import report


def test_a_long_record_has_the_rates_and_the_accuracy_that_it_states(tmp_path: Path) -> None:
    size = write_long_record(tmp_path, 6.0, Rates(points_per_match=20))
    assert size == (tmp_path / "flight-000.mcap").stat().st_size
    messages = [message for _, _, message in read_flight(tmp_path)]
    assert sum(isinstance(message, NavEstimate) for message in messages) == 60
    matches = [message for message in messages if isinstance(message, MapMatch)]
    assert [len(match.matches) for match in matches] == [20] * 12
    view = gather(tmp_path, None)
    assert view.evaluation is not None and view.evaluation["ellipse95_coverage"] > 0.85
    assert view.clocked and view.stage_times.percentiles_ms("odometry")
    text = report(tmp_path).read_text(encoding="utf-8")
    assert "16 matches agree with the pose, 4 do not." in text


def test_every_limit_is_compared() -> None:
    assert exceeded(LIMITS) == []
    assert exceeded(LIMITS | {"wall_s": 60.1}) == ["wall_s"]
    assert exceeded({name: 2 * limit for name, limit in LIMITS.items()}) == list(LIMITS)
