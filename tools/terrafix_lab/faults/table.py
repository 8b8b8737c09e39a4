"""The table of faults. Acceptance, Monte Carlo and the fault matrix name its rows, as far as their driver has what a
row needs: `terrafix accept --scenario`, `terrafix montecarlo --fault`, `terrafix chaos --fault`."""

import math
from collections.abc import Callable
from functools import partial, reduce
from itertools import accumulate, pairwise

from terrafix.core.errors import UsageError
from terrafix_lab.faults import edits, pictures
from terrafix_lab.faults.edits import Edit, Span, StateEdit, during
from terrafix_lab.faults.fault import Fault, Need, Process
from terrafix_lab.faults.messages import outliers
from terrafix_lab.faults.processes import (
    AROUND_THEM,
    KILLED_AND_LIMITED,
    SHORT_S,
    go_on_all,
    set_doubled,
    show_another_place,
    show_own_place,
    slow_all,
)

FROZEN_S, FORGED_S, LATE_S = 15.0, 10.0, 1.0
FOREIGN_S, DECK_S, CLIMB_S = 10.0, 22.0, 45.0
BUFFERS = 4
STILL_SHARE, LATE_TELEMETRY_S = 0.5, 2.0
DOUBLED_S = 0.5  # a second way of the telemetry, by a radio, takes so much longer
DROPPED, DOUBLED, SEED = 0.15, 0.15, 1
PIXELS, UNKNOWN = frozenset({Need.PIXELS}), frozenset({Need.UNKNOWN})


def whole(edit: Edit) -> Callable[[Span], Edit]:
    return lambda _span: edit


def reported(change: StateEdit) -> Callable[[Span], Edit]:
    """In the telemetry of the span."""
    return lambda span: edits.forged(span, change)


def shown(change: pictures.Change) -> Callable[[Span], Edit]:
    """In the pictures of the span."""
    return lambda span: during(span, pictures.every_picture(change))


def in_turn(name: str, words: str, *faults: Fault) -> Fault:
    """Faults of camera or telemetry that follow each other, each as long as it lasts."""

    def each(part: Callable[[Fault, Span], Edit], span: Span) -> Edit:
        begins_s = accumulate((f.lasts_s or 0.0 for f in faults), initial=span.from_s)
        edited = [part(f, Span(a, b, f.name)) for f, (a, b) in zip(faults, pairwise(begins_s), strict=True)]
        return lambda shots: reduce(lambda given, edit: edit(given), edited, shots)

    camera, reports = partial(each, Fault.of_camera), partial(each, Fault.of_telemetry)
    needs, lasts_s = frozenset().union(*(f.needs for f in faults)), sum(f.lasts_s or 0.0 for f in faults)
    return Fault(name, words, lasts_s, camera, reports, needs=needs, is_true=all(f.is_true for f in faults))


NONE = Fault("none", lasts_s=0.0, is_true=True)


def camera(name: str, words: str, source: Callable[[Span], Edit], *needs: Need) -> Fault:
    return Fault(f"camera: {name}", words, SHORT_S, source, needs=frozenset(needs), is_true=True)


CAMERA = (
    camera("unplugged", "No frame comes.", edits.unplugged),
    camera("frozen", "One picture again and again.", pictures.frozen),
    camera("black", "Black pictures.", pictures.black),
    camera("overexposed", "All but the darkest ground is white.", shown(pictures.overexposed), Need.PIXELS),
    camera("defocused", "Blurred pictures.", shown(pictures.defocused), Need.PIXELS),
    camera("wrong resolution", "Half the width and height.", shown(pictures.halved), Need.PIXELS),
    camera("no JPEG", "Bytes that are no image.", pictures.torn),
    camera("each image ten times", "Ten times the frames.", partial(edits.repeated, times=10), Need.LIVE),
    camera("stamps 5 s ahead", "Time stamps in the future.", partial(edits.stamped, by_s=5.0), Need.LIVE),
    camera("stamps 3 s late", "Time stamps in the past.", partial(edits.stamped, by_s=-3.0), Need.LIVE),
)
HEIGHTS = (
    ("height 30 % low", "The reported height is 30 % too small, and stated as good.", 0.7),
    ("height 30 % high", "The reported height is 30 % too large, and stated as good.", 1.3),
    ("height in feet", "The reported height is in feet where metres are expected.", edits.FEET_IN_A_METRE),
    ("height taken for feet", "The reported height was divided by 3.28 once too often.", 1.0 / edits.FEET_IN_A_METRE),
)
# Inputs that are wrong and look right: the position must be right or withdrawn.
FALSE_INPUTS = (
    *(
        Fault(
            f"heading {off} degrees off",
            f"The reported heading is off by {off} degrees throughout.",
            telemetry=reported(edits.turned(off)),
        )
        for off in (90, 180)
    ),
    *(
        Fault(
            f"camera mounted {word}",
            f"The camera is turned by {off:g} degrees, and the description does not say so.",
            origin=edits.mount_yaw_plus(off),
        )
        for word, off in (("sideways", 90.0), ("backwards", 180.0))
    ),
    Fault("mirrored pictures", "Left and right are exchanged in every picture.", source=shown(pictures.mirrored)),
    Fault(
        "roll and pitch swapped",
        "Roll is reported as pitch, and pitch as roll.",
        telemetry=reported(edits.roll_pitch_swapped),
    ),
    Fault(
        "roll and pitch negated",
        "Roll and pitch are reported with the wrong sign.",
        telemetry=reported(edits.roll_pitch_negated),
    ),
    *(Fault(name, words, telemetry=reported(edits.height_times(factor))) for name, words, factor in HEIGHTS),
    *(
        Fault(
            f"focal length {word}",
            f"The focal length is {word} in the description, and stated to 1 %.",
            origin=edits.focal_times(factor),
        )
        for word, factor in (("halved", 0.5), ("doubled", 2.0))
    ),
    Fault(
        "frozen picture with noise",
        "The camera repeats one picture for 15 s, with new noise each time.",
        FROZEN_S,
        partial(pictures.stale_buffers, buffers=1),
        cause="picture frozen",
    ),
    Fault(
        "four stale buffers",
        "The camera repeats four pictures in turn for 15 s.",
        FROZEN_S,
        partial(pictures.stale_buffers, buffers=BUFFERS),
        cause="picture frozen",
    ),
    Fault(
        "camera falls behind",
        "For 15 s the pictures play at half their speed, then the camera is live.",
        FROZEN_S,
        partial(pictures.falling_behind, lag_s=FROZEN_S / 2),
        cause="camera .* late",
    ),
    Fault(
        "stream falls behind",
        "For 40 s the delay of the pictures grows evenly to 2 s, then the camera is live.",
        40.0,
        partial(pictures.falling_behind, lag_s=2.0),
        cause="camera .* late",
    ),
    Fault(
        "picture squeezed in one axis",
        "16:9 is shown as 4:3 in every picture: one axis has another scale than the description says.",
        source=shown(pictures.scaled(1.0, 4.0 / 3.0)),
        cause="squeezed|contradicts motion",
    ),
    Fault(
        "camera upside down",
        "For 20 s the pictures are turned by 180 degrees, as after a reboot of the camera.",
        20.0,
        shown(pictures.upside_down),
        cause="upside down",
    ),
    Fault(
        "foreign frames in a row",
        "For 5 s the pictures are mirrored: they agree with each other, and are nowhere on the map.",
        5.0,
        shown(pictures.mirrored),
    ),
    Fault(
        "half the picture stands still",
        "The lower half of every picture shows a part of the vehicle, from the first frame on.",
        source=whole(pictures.partly_frozen(STILL_SHARE, SEED)),
        needs=PIXELS,
    ),
    Fault(
        "telemetry 2 s late",
        "All that the autopilot reports is two seconds old when it gets its time.",
        telemetry=whole(edits.late_telemetry(LATE_TELEMETRY_S)),
        cause="telemetry .* late",
    ),
    Fault(
        "pictures 1 s late",
        "Every picture is a second old when it gets its time.",
        source=whole(pictures.late_pictures(LATE_S)),
        cause="camera .* late",
    ),
    Fault(
        "forged tilt",
        "For 10 s a roll is reported that is 15 degrees more than the true one.",
        FORGED_S,
        telemetry=reported(edits.rolled(15.0)),
    ),
    Fault(
        "forged heading",
        "For 10 s the reported heading jumps by 90 degrees.",
        FORGED_S,
        telemetry=reported(edits.turned(90.0)),
    ),
)
# True inputs, of which some are missing or imprecise: the position must stay good.
SCARCE_INPUTS = (
    Fault(
        "dropped and doubled frames",
        "15 % of the frames are missing, 15 % come twice.",
        source=whole(edits.dropped_and_doubled(DROPPED, DOUBLED, SEED)),
        is_true=True,
    ),
    Fault(
        "height unknown",
        "No height is reported.",
        telemetry=reported(edits.height_unknown),
        needs=UNKNOWN,
        is_true=True,
    ),
    Fault(
        "start unknown", "No start is known.", origin=edits.start_unknown, needs=frozenset({Need.SEARCH}), is_true=True
    ),
)
# Within what is promised.
IMPRECISE_INPUTS = (
    Fault(
        "height wrong by 10 %",
        "The reported height is 10 % too large.",
        telemetry=reported(edits.height_times(1.10)),
        is_true=True,
    ),
    Fault(
        "compass wrong by 15 degrees",
        "The reported heading is off by 15 degrees.",
        telemetry=reported(edits.turned(15.0)),
        is_true=True,
    ),
    Fault(
        "heading unknown", "No heading is reported.", telemetry=reported(edits.yaw_unknown), needs=UNKNOWN, is_true=True
    ),
)
MATCHES = (
    Fault(
        "350 m outlier fix",
        "Every tenth map fix has an error of 350 m and a small covariance: it is rejected.",
        matches=outliers,
    ),
)
STREAMED = (  # as a stream or its receiver fails in flight
    Fault(
        "pictures 1.4 s late at once",
        "For 20 s every picture is 1.4 s old when it gets its time.",
        20.0,
        lambda span: during(span, pictures.late_pictures(1.4)),
        past_s=2.0,
        cause="camera .* late",
    ),
    Fault(
        "frozen picture that jitters",
        "The camera repeats one picture for 15 s, each time moved by 0.4 px.",
        FROZEN_S,
        pictures.jittering,
        needs=PIXELS,
        cause="picture frozen",
    ),
    Fault(
        "pictures of another time",
        "For 10 s the pictures are those of 25 s before.",
        FOREIGN_S,
        lambda span: during(span, pictures.late_pictures(pictures.FOREIGN_LAG_S)),
        past_s=pictures.FOREIGN_LAG_S + 1.0,
        cause="contradicts motion|not on the map",
    ),
    Fault(
        "water",
        "For 60 s the camera sees open water.",
        60.0,
        pictures.water,
        needs=PIXELS,
        is_true=True,
        cause="without texture",
    ),
    Fault(
        "zoom that creeps",
        "For 20 s the focal length grows to 1.3 times that of the description.",
        20.0,
        partial(pictures.zooming, factor=1.3),
        cause="focal",
    ),
)


def gimbal(
    name: str,
    words: str,
    telemetry: Callable[[Span], Edit],
    source: Callable[[Span], Edit] | None = None,
    *,
    is_true: bool = False,
    cause: str = "",
) -> Fault:
    needs = frozenset({Need.GIMBAL})
    return Fault(f"gimbal {name}", words, 20.0, source, telemetry, needs=needs, is_true=is_true, cause=cause)


GIMBAL = (
    gimbal(
        "not reported",
        "For 20 s the gimbal reports nothing.",
        partial(edits.gimbal_reports, age_s=lambda _: math.inf),
        is_true=True,
        cause="gimbal not reported",
    ),
    gimbal(
        "reported late",
        "For 20 s the reports of the gimbal are half a second old.",
        partial(edits.gimbal_reports, age_s=lambda _: 0.5),
    ),
    gimbal(
        "frozen",
        "For 20 s the gimbal reports one attitude.",
        partial(edits.gimbal_reports, age_s=lambda since_s: since_s),
        cause="gimbal repeats a report",
    ),
    gimbal(
        "drifts",
        "For 20 s the tilt that is reported drifts by a quarter of a degree a second.",
        partial(edits.gimbal_reports, up_deg=lambda since_s: 0.25 * since_s),
    ),
    gimbal(
        "looks away",
        "For 20 s the gimbal holds the camera at the horizon, and says so; what it sees is not on the map.",
        partial(edits.gimbal_reports, up_deg=lambda _: 90.0),
        shown(pictures.mirrored),
        is_true=True,
        cause="without ground",
    ),
)
LIVE = (  # which need a rig
    Fault(
        "pictures of another place",
        "For 10 s the pictures are those of a flight elsewhere.",
        FOREIGN_S,
        process=Process(show_another_place, show_own_place),
        needs=frozenset({Need.ELSEWHERE}),
        cause="contradicts motion|not on the map",
    ),
    Fault(
        "telemetry comes twice",
        "For 10 s all that the autopilot sends comes a second time, half a second later.",
        FORGED_S,
        process=Process(partial(set_doubled, after_s=DOUBLED_S), partial(set_doubled, after_s=None)),
        cause="two senders",
    ),
    Fault(
        "computer four times too slow",
        "For 20 s each process runs a quarter of the time.",
        20.0,
        process=Process(during=slow_all, end=go_on_all),
        cause="too slow",
    ),
    Fault(
        "start on a moving deck",
        "A copter stands disarmed on a deck that moves with 6 m/s for 22 s, takes off and climbs to 100 m.",
        DECK_S + CLIMB_S,
        needs=frozenset({Need.DECK}),
        cause="take-off|start",
    ),
)
INPUTS = {fault.name: fault for fault in (*CAMERA, *FALSE_INPUTS)}
SCENARIOS: tuple[Fault, ...] = (  # of several faults
    in_turn(
        "camera reboots upside down",
        "No frame for 6 s, then the pictures are turned by 180 degrees for 20 s.",
        INPUTS["camera: unplugged"],
        INPUTS["camera upside down"],
    ),
)
MATRIX = (NONE, *KILLED_AND_LIMITED, *CAMERA, *AROUND_THEM)  # what `terrafix chaos` flies if no fault is named
FAULTS = {
    fault.name: fault
    for fault in (
        *MATRIX,
        *FALSE_INPUTS,
        *STREAMED,
        *GIMBAL,
        *LIVE,
        *SCARCE_INPUTS,
        *IMPRECISE_INPUTS,
        *MATCHES,
        *SCENARIOS,
    )
}


def fault_named(name: str) -> Fault:
    """Raises UsageError."""
    if name not in FAULTS:
        raise UsageError(f"'{name}' is no fault; 'terrafix chaos --list' names them")
    return FAULTS[name]
