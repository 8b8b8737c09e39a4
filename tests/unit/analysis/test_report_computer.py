"""Charts of the computer's temperature and power in the report."""

from terrafix.messages import FrameRate, Health, ThermalBand, ThermalReading
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.sections_computer import computer


def _health(power_w: float | None) -> Health:
    return Health(
        t_ns=0,
        band=ThermalBand.HOT,
        temperature_c=81.0,
        throttled=False,
        disk_free_mb=None,
        cause="test",
        power_w=power_w,
    )


def _page(power_w: float | None) -> str:
    view = FlightView(title="test", rows=[], frame_ids=[], health=[(0.0, _health(power_w)), (1.0, _health(power_w))])
    return computer(view)


def test_power_is_drawn_where_it_was_measured() -> None:
    assert 'aria-label="Power"' in _page(9.5)
    assert 'aria-label="Power"' not in _page(None)
    assert 'aria-label="Temperature"' in _page(None)


def _load_page(*loads: dict[str, float]) -> str:
    readings = [
        (float(i), ThermalReading(t_ns=i, zones=[], throttling=[], disk_free_mb=None, cpu_load=load))
        for i, load in enumerate(loads)
    ]
    return computer(FlightView(title="test", rows=[], frame_ids=[], thermal=readings))


def test_load_is_drawn_for_all_cores_and_by_process() -> None:
    page = _load_page({}, {"all": 0.25, "vision": 0.9}, {"all": 0.5, "vision": 1.1, "link": 0.1})
    assert 'aria-label="All cores"' in page and 'aria-label="By process"' in page
    assert "vision" in page and "link" in page
    assert "Processor load" not in _load_page({}, {})


def test_the_frame_rate_is_stated_where_the_computer_was_too_slow() -> None:
    def page(slow: bool) -> str:
        rate = FrameRate(t_ns=0, offered_hz=2.0, taken_hz=1.33, every=1, computer_too_slow=slow)
        return computer(FlightView(title="test", rows=[], frame_ids=[], frame_rates=[(5.0, rate), (9.0, rate)]))

    assert "from 0:05 to 0:09, running at 1.3 of 2 Hz" in page(True)
    assert page(False) == ""
