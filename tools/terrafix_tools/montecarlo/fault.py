"""What may go wrong in a flight of the Monte Carlo run. The command line knows it without all that it takes to fly."""

from enum import StrEnum


class Fault(StrEnum):
    """One kind of trouble; a flight has one, or none, and with --lies some of LIES beside it."""

    NONE = "none"
    WRONG = "10 % wrong matches"  # each somewhere else
    JUMPS = "350 m jumps"
    BLACKOUT = "60 s blackouts"  # nothing is seen at all
    HEIGHT = "height 10 % wrong"
    COMPASS = "compass 10-15 deg off"
    ROWS = "repeated rows"  # wrong matches that agree with each other for half a minute
    LATE = "matches 0-2 s late"  # and out of order
    DRIFT = "no map after 90 s"  # odometry alone
    HILLS = "hills without elevation"  # against the rules; this and the next only when asked for
    PHOTOS = "photos 5 s apart"  # that hardly overlap, with what the autopilot said at each and nothing between
    FOREIGN = "foreign motion"  # from here on: an input lies
    FROZEN = "frozen camera"
    STALE = "late pictures"
    SCALE = "height scale wrong"
    FOCAL = "focal length wrong"
    HEADING = "heading 90 or 180 deg off"
    START = "start 300 m off"
    TOWN = "wrong-map matches"


LIES = (
    Fault.FOREIGN,
    Fault.FROZEN,
    Fault.STALE,
    Fault.SCALE,
    Fault.FOCAL,
    Fault.HEADING,
    Fault.START,
    Fault.TOWN,
)
