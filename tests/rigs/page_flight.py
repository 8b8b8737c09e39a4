"""Flights of the console with results as they are stored, for tests of the page: nothing is computed."""

import asyncio
from typing import Any

from console_rig import Console, batch
from terrafix_tools.console.compute.observed import FrameOutcome
from terrafix_tools.console.events import Event, FlightCompleted, FrameProcessed, Health
from terrafix_tools.console.payloads import Ellipse, FlightState, FrameResult, Gps, WholeVerdict
from terrafix_tools.console.store import flights

MATCHED: dict[str, Any] = {"source": "satellite_anchored", "match": "accepted", "inliers": 41}
PROPAGATED: dict[str, Any] = {"source": "visual_propagated", "match": "too_low"}
LOST: dict[str, Any] = {"source": "dead_reckoned", "match": "lost", "search": "whole_map"}
FILES = [name for _, name, _ in batch(0)]


def middle(console: Console) -> tuple[float, float]:
    """Latitude and longitude of the middle of the map."""
    west, south, east, north = console.send("GET", "/maps").json["maps"][0]["bounds"]
    return (south + north) / 2, (west + east) / 2


def result(console: Console, frame_id: int, semi_m: float = 4.0, **given: Any) -> FrameResult:
    """Of a frame that flies east over the middle of the map. ``semi_m``: longer half axis of its ellipse."""
    lat, lon = middle(console)
    return FrameResult(
        frame_id=frame_id,
        file=given.pop("file", FILES[frame_id]),
        t_s=2.0 * frame_id,
        gps=Gps(lat=lat, lon=lon + 1e-5 * frame_id),
        altitude=310.0,
        agl_m=92.0,
        heading=90.0,
        ellipse=Ellipse(semi_major_m=semi_m, semi_minor_m=semi_m / 2, bearing_deg=30.0),
        fragment_id=0,
        **given,
    )


def store(
    console: Console,
    flight_id: str,
    results: list[FrameResult],
    state: FlightState = FlightState.PROCESSING,
    others: tuple[Event, ...] = (),
) -> None:
    """The results with their events, the last of them with ``others``."""
    with console.service.database.write() as db:
        for found in results:
            events: list[Event] = [FrameProcessed(**found.model_dump())]
            outcome = FrameOutcome(result=found, events=events, state=state)
            if found is results[-1]:
                outcome.events += others
            flights.store_outcome(db, flight_id, f"frame {found.frame_id}", outcome)
    tell(console, flight_id)


def tell(console: Console, flight_id: str) -> None:
    """The streams of the flight read what is new."""
    loop = console.service._loop
    asyncio.run_coroutine_threadsafe(console.service.feeds.refresh(flight_id), loop).result()


def uploaded(console: Console, **new: Any) -> str:
    """A flight with ten photos."""
    flight_id = console.create(**new)
    assert console.upload(flight_id, batch(0)).status == 202
    return flight_id


def completed(console: Console, flight_id: str, verdict: WholeVerdict) -> None:
    with console.service.database.write() as db:
        flights.complete(db, flight_id, FlightCompleted(statistics={"frames": 10}, verdict=verdict))
    tell(console, flight_id)


def live(console: Console, results: list[FrameResult]) -> str:
    """A live flight that nothing follows."""
    flight_id = "live-0123456789ab"
    with console.service.database.write() as db:
        flights.create_live(db, flight_id, name="evening", map_name="small", created_at="2026-01-01T10:00:00+00:00")
    store(console, flight_id, results)
    return flight_id


def health(console: Console, flight_id: str, **position: Any) -> None:
    """One event of health of a live flight; ``position``: changes of its facts."""
    facts = {
        "position": {
            "fix": "3D",
            "reason": "",
            "accuracy_m": 3.2,
            "degradation": "",
            "since_map_fix_s": 0.4,
            "estimate_age_ms": 80,
            "resets": 0,
            "search": None,
            "speed_mps": 12.0,
            "covariance_mode": "marginals",
            **position,
        },
        "autopilot": {
            "connected": True,
            "autopilot": "ArduPilot 4.6",
            "sent": 900,
            "received": 4000,
            "bad_bytes": 0,
            "refused": 0,
            "uses_position": True,
            "position_test_ratio": 0.3,
            "position_source": "receiver 1",
            "gnss": {"0": {"state": "spoofed", "distance_m": 812, "why": "it drifts away from the map"}},
        },
        "processes": [
            {"name": "vision", "state": "running", "idle_s": 0.1, "load": 0.3, "restarts": 0, "last_event": ""}
        ],
        "rates_hz": {"Frame": 5.0},
        "delay_ms": 140,
        "map_matches_accepted": 0.9,
        "dropped": {},
        "computer": {
            "band": "normal",
            "temperature_c": 55,
            "throttled": False,
            "power_w": 9.0,
            "disk_free_mb": 9000,
            "load": 0.4,
        },
        "rejected": [],
        "texts": ["Terrafix: 3D fix"],
    }
    console.service._loop.call_soon_threadsafe(console.service.feeds.pass_on, flight_id, Health(facts=facts))
