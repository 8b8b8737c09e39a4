"""Requests that schemathesis makes from the OpenAPI description: the service does not fail, and answers as it says."""

from collections.abc import Iterator
from typing import Any

import hypothesis
import pytest

from console_rig import Console, batch, settings
from terrafix_tools.console.openapi import schema

schemathesis = pytest.importorskip("schemathesis", reason="needs the extra 'nightly'")
pytestmark = [pytest.mark.slow, pytest.mark.nightly]

EXAMPLES, UPLOADS = 30, 5  # of one operation; of uploads, whose bodies take long to make
MODES = ["POSITIVE", "NEGATIVE"]
STREAM = "/events"  # does not end


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Console, str]]:
    """A console, and the id of a flight with ten images."""
    with Console(settings(tmp_path_factory.mktemp("console"))) as running:
        flight_id = running.create()
        running.upload(flight_id, batch(0))
        yield running, flight_id


def operations() -> list[Any]:
    found = schemathesis.openapi.from_dict(schema())
    return [result.ok() for result in found.get_all_operations()]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("operation", operations(), ids=lambda one: f"{one.method} {one.path}")
def test_requests_by_the_description_are_answered_as_it_says(
    target: tuple[Console, str], operation: Any, mode: str
) -> None:
    if operation.path.endswith(STREAM):
        pytest.skip("a stream of events does not end")
    console, flight_id = target
    # The description cannot say every rule: which fields exclude each other, how images are named.
    from schemathesis.specs.openapi.checks import positive_data_acceptance

    @hypothesis.settings(
        max_examples=UPLOADS if "multipart" in str(operation.body) else EXAMPLES,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=[hypothesis.Phase.generate],
    )
    @hypothesis.given(operation.as_strategy(generation_mode=schemathesis.GenerationMode[mode]))
    def answered(case: Any) -> None:
        of_flight = case.path_parameters is not None and "flight_id" in case.path_parameters
        if of_flight and mode == "POSITIVE" and case.method != "DELETE":
            case.path_parameters["flight_id"] = flight_id
        case.validate_response(
            case.call(base_url=console.url, timeout=20.0), excluded_checks=[positive_data_acceptance]
        )

    try:
        answered()
    except hypothesis.errors.Unsatisfiable:
        pytest.skip("an operation without parameters has no wrong ones")
