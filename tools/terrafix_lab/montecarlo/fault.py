"""Faults of a flight of the Monte Carlo run whose sizes are drawn; others are in terrafix_lab/faults/table.py."""

from enum import StrEnum


class DrawnFault(StrEnum):
    """A flight has one fault or none; with --lies in addition some of LIES, its false inputs."""

    NONE = "none"
    WRONG = "10 % wrong matches"  # each at another place
    JUMPS = "350 m jumps"
    BLACKOUT = "60 s blackouts"  # no odometry and no match
    HEIGHT = "height 10 % wrong"
    COMPASS = "compass 10-15 deg off"
    ROWS = "repeated rows"  # wrong matches that agree with each other for 30 s
    LATE = "matches 0-2 s late"  # and out of order
    DRIFT = "no map after 90 s"  # odometry only
    HILLS = "hills without elevation"  # outside of the specification; this and the next only with --fault
    PHOTOS = "photos 5 s apart"  # with little overlap; telemetry at each photo and none between
    FOREIGN = "foreign motion"  # from here on: a false input
    FROZEN = "frozen camera"
    STALE = "late pictures"
    SCALE = "height scale wrong"
    FOCAL = "focal length wrong"
    HEADING = "heading 90 or 180 deg off"
    START = "start 300 m off"
    TOWN = "wrong-map matches"


LIES = (
    DrawnFault.FOREIGN,
    DrawnFault.FROZEN,
    DrawnFault.STALE,
    DrawnFault.SCALE,
    DrawnFault.FOCAL,
    DrawnFault.HEADING,
    DrawnFault.START,
    DrawnFault.TOWN,
)
