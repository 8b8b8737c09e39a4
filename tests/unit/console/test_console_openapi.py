"""The checked in description of the interface."""

from terrafix_tools.console.events import EVENTS
from terrafix_tools.console.openapi import FILE, schema, text


def test_the_openapi_file_is_that_of_the_routes() -> None:
    assert FILE.read_text(encoding="utf-8") == text(), "run: python -m terrafix_tools.console.openapi"


def test_paths_of_the_contract_and_models_of_all_events_are_described() -> None:
    described = schema()
    for path in (
        "/flights",
        "/flights/{flight_id}/images/batch",
        "/flights/{flight_id}/user-fix",
        "/flights/{flight_id}/frames/{frame_id}/object-to-gps",
        "/flights/{flight_id}/events",
        "/flights/{flight_id}/complete",
    ):
        assert path in described["paths"]
    assert {kind.__name__ for kind in EVENTS} <= set(described["components"]["schemas"])
