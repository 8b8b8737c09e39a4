"""Scenarios with a false input ("lie"): the position must be correct or withdrawn. Described in docs/acceptance.md.

The last group has true inputs with gaps: the position must stay correct."""

from collections.abc import Callable
from functools import partial

from terrafix_lab.accept.false_inputs import inputs as lying
from terrafix_lab.accept.false_inputs import plans
from terrafix_lab.accept.false_inputs.plans import START_SIGMA_M
from terrafix_lab.accept.faults import flight_edits
from terrafix_lab.accept.faults.flight_edits import Edit
from terrafix_lab.accept.measuring.criteria import EVERYWHERE, LYING_IN_THE_LOOP, PERMANENT, TEMPORARY
from terrafix_lab.accept.measuring.results import Span
from terrafix_lab.accept.plan import CLOSED_LOOP, Scenario, always

FRAMES = 90  # of a generated flight: 45 s
LOOP_FRAMES = 200  # 100 s: 40 s with GNSS, 20 s jammed, 15 s with the lie, and 25 s to recover
FROZEN_S, FORGED_S, LATE_S = 15.0, 10.0, 1.0
BUFFERS = 4
HALF_SPEED = 0.5
STILL_SHARE, LATE_TELEMETRY_S = 0.5, 2.0
MAP_SHIFT_M, SMALL_SHIFT_M = (212.0, -212.0), (100.0, 80.0)  # east, north: 300 m; 128 m, as between two datums
DROPPED, DOUBLED = 0.15, 0.15
_scenario = partial(Scenario, frames=FRAMES)
SCARCE = (*EVERYWHERE, "claim width")
HEIGHTS = (
    ("height 30 % low", "The reported height is 30 % too small, and stated as good.", 0.7),
    ("height 30 % high", "The reported height is 30 % too large, and stated as good.", 1.3),
    ("height in feet", "The reported height is in feet where metres are expected.", lying.FEET_IN_A_METRE),
    ("height taken for feet", "The reported height was divided by 3.28 once too often.", 1.0 / lying.FEET_IN_A_METRE),
)
# Pictures in the closed loop, while GNSS is jammed and the autopilot navigates by Terrafix: what they show, rows, edit
IN_THE_LOOP: tuple[tuple[str, str, tuple[str, ...], Callable[[Span], Edit]], ...] = (
    (
        "GNSS jam, frozen picture",
        "one picture again and again, with new noise",
        (),
        partial(lying.stale_buffers, buffers=1),
    ),
    ("GNSS jam, four stale buffers", "four pictures in turn", (), partial(lying.stale_buffers, buffers=BUFFERS)),
    ("GNSS jam, foreign frames", "pictures of another place that agree with each other", (), lying.mirrored_before),
    (
        "GNSS jam, late pictures",
        "pictures that are a second old",
        ("late sure over 20 m",),
        lambda span: lying.during(span, lying.late_pictures(LATE_S)),
    ),
)
LIES_IN_THE_LOOP = {name: edit for name, _, _, edit in IN_THE_LOOP}
LIES: tuple[Scenario, ...] = (
    _scenario("ten foreign frames", "Ten frames in a row show another place.", TEMPORARY, plans.foreign_row()),
    _scenario(
        "fast foreign frames",
        "Ten frames in a row show another place, at three times the speed.",
        TEMPORARY,
        plans.foreign_row(pace=plans.FAST),
    ),
    _scenario(
        "foreign frames at the start", "The first ten frames show another place.", TEMPORARY, plans.foreign_row(at=0.0)
    ),
    _scenario(
        "15 % foreign frames",
        "At random, 15 % of the frames are of another vehicle's camera.",
        TEMPORARY,
        plans.foreign_at_random,
    ),
    _scenario(
        "every second frame foreign",
        "Two cameras by turns, one of them at another place, for 30 frames.",
        TEMPORARY,
        plans.interleaved,
    ),
    _scenario(
        "elsewhere in reverse",
        "Ten frames of another part of the map, in reverse order.",
        TEMPORARY,
        plans.elsewhere_reversed,
    ),
    _scenario(
        "another town's map",
        "The map is of another town; the start claims 50 m.",
        PERMANENT,
        plans.with_map("the map is of another town", plans.other_town, lying.start_sigma(START_SIGMA_M)),
    ),
    _scenario(
        "another town's map, no start",
        "The map is of another town, and no start is known.",
        PERMANENT,
        plans.with_map("the map is of another town", plans.other_town, lying.start_unknown),
    ),
    _scenario(
        "map shifted by 300 m",
        "The coordinates of the map are off by 300 m.",
        PERMANENT,
        plans.with_map("the map is shifted", partial(plans.shifted_map, MAP_SHIFT_M)),
    ),
    _scenario(
        "map in another datum",
        "The coordinates of the map are off by 128 m.",
        PERMANENT,
        plans.with_map("the map is shifted", partial(plans.shifted_map, SMALL_SHIFT_M)),
    ),
    _scenario(
        "map 10 % too large", "The scale of the map is wrong.", PERMANENT, plans.with_map("too large", plans.grown_map)
    ),
    _scenario("start 300 m off", "The start is 300 m off and claims 50 m.", TEMPORARY, plans.start_off),
    *(
        _scenario(
            f"heading {off} degrees off",
            f"The reported heading is off by {off} degrees throughout.",
            PERMANENT,
            plans.throughout("the heading is off", edit=flight_edits.yaw_plus(off)),
        )
        for off in (90, 180)
    ),
    *(
        _scenario(
            f"camera mounted {word}",
            f"The camera is turned by {off} degrees, and the description does not say so.",
            PERMANENT,
            plans.throughout("the mount is not as described", origin=lying.mount_yaw_plus(off)),
        )
        for word, off in (("sideways", 90.0), ("backwards", 180.0))
    ),
    _scenario(
        "mirrored pictures",
        "Left and right are exchanged in every picture.",
        PERMANENT,
        plans.throughout("mirrored", edit=lying.every_picture(lying.mirrored)),
    ),
    _scenario(
        "roll and pitch swapped",
        "Roll is reported as pitch, and pitch as roll.",
        PERMANENT,
        plans.throughout("swapped", edit=flight_edits.telemetry(lying.roll_pitch_swapped)),
    ),
    _scenario(
        "roll and pitch negated",
        "Roll and pitch are reported with the wrong sign.",
        PERMANENT,
        plans.throughout("of wrong sign", edit=flight_edits.telemetry(lying.roll_pitch_negated)),
    ),
    *(
        _scenario(
            name, promise, PERMANENT, plans.throughout("the height is wrong", edit=flight_edits.height_times(factor))
        )
        for name, promise, factor in HEIGHTS
    ),
    *(
        _scenario(
            f"focal length {word}",
            f"The focal length is {word} in the description, and stated to 1 %.",
            PERMANENT,
            plans.throughout("the focal length is wrong", origin=lying.focal_times(factor)),
        )
        for word, factor in (("halved", 0.5), ("doubled", 2.0))
    ),
    _scenario(
        "frozen picture with noise",
        "The camera repeats one picture for 15 s, with new noise each time.",
        TEMPORARY,
        plans.for_seconds(FROZEN_S, "frozen", partial(lying.stale_buffers, buffers=1)),
    ),
    _scenario(
        "four stale buffers",
        "The camera repeats four pictures in turn for 15 s.",
        TEMPORARY,
        plans.for_seconds(FROZEN_S, "stale", partial(lying.stale_buffers, buffers=BUFFERS)),
    ),
    _scenario(
        "camera falls behind",
        "For 15 s the pictures play at half their speed, then the camera is live.",
        TEMPORARY,
        plans.for_seconds(FROZEN_S, "slow", partial(lying.slow_pictures, speed=HALF_SPEED)),
    ),
    _scenario(
        "half the picture stands still",
        "The lower half of every picture shows a part of the vehicle, from the first frame on.",
        PERMANENT,
        plans.throughout("half of it stands still", edit=lying.partly_frozen(STILL_SHARE, lying.SEED)),
    ),
    _scenario(
        "telemetry 2 s late",
        "All that the autopilot reports is two seconds old when it gets its time.",
        (*PERMANENT, "late sure over 20 m"),
        plans.throughout("late telemetry", edit=lying.late_telemetry(LATE_TELEMETRY_S)),
    ),
    _scenario(
        "pictures 1 s late",
        "Every picture is a second old when it gets its time.",
        (*PERMANENT, "late sure over 20 m"),
        plans.throughout("late", edit=lying.late_pictures(LATE_S)),
    ),
    _scenario(
        "forged tilt",
        "For 10 s a roll is reported that is 15 degrees more than the true one.",
        TEMPORARY,
        plans.for_seconds(FORGED_S, "forged", lambda span: lying.forged(span, lying.rolled(15.0))),
    ),
    _scenario(
        "forged heading",
        "For 10 s the reported heading jumps by 90 degrees.",
        TEMPORARY,
        plans.for_seconds(FORGED_S, "forged", lambda span: lying.forged(span, flight_edits.turned(90.0))),
    ),
    _scenario(
        "dropped and doubled frames",
        "15 % of the frames are missing, 15 % come twice.",
        SCARCE,
        always(lying.dropped_and_doubled(DROPPED, DOUBLED, lying.SEED)),
    ),
    _scenario(
        "photos every 155 m",
        "Photos that share little ground, and nothing between them.",
        SCARCE,
        plans.sparse_photos,
        frames=400,
    ),
    _scenario(
        "gap of minutes", "No frame and no telemetry for three minutes.", (*SCARCE, "recovery"), plans.gap_of_minutes
    ),
    _scenario(
        "height unknown",
        "No height is reported.",
        SCARCE,
        always(flight_edits.telemetry(lying.height_unknown)),
    ),
    _scenario(
        "start unknown",
        "No start is known.",
        (*SCARCE, "first position"),
        always(origin=lying.start_unknown),
    ),
    *(
        Scenario(
            name,
            f"In flight, with nothing but Terrafix, for 15 s: {text}. Closed loop.",
            (*LYING_IN_THE_LOOP, *more),
            always(),
            ground=CLOSED_LOOP,
            frames=LOOP_FRAMES,
        )
        for name, text, more, _ in IN_THE_LOOP
    ),
)
