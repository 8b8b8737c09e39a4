"""Degradation levels in GPS_INPUT, STATUSTEXT and NAMED_VALUE_FLOAT; texts of the pilot and their debounce."""

import math
import random
import re

import msgspec
import pytest

from link_rig import MS, S, estimate, every, fly, gps, texts
from link_wire import WiredEdge, heartbeat
from terrafix import messages as m
from terrafix.link.node import LinkNode
from terrafix.link.pilot_text.debounce import MAX_TEXT_INTERVAL_NS, RESET_AFTER_NS, Debounce
from terrafix.link.pilot_text.statustext import LINK_FAULTS, TWO_SENDERS

MAX_CHARACTERS = 50  # characters of STATUSTEXT
KNOWN_TEXTS = [  # every text to a pilot; a new text must be added here
    r"3D fix",
    r"no fix: (the estimate is too old|neither map nor odometry|worse than \d+ m|the speed is too uncertain)",
    r"no fix: (awaiting a better accuracy|not found on the map yet)",
    r"no fix: (suddenly less accurate|the position has jumped|no estimate yet|estimator (died|stuck|gave up))",
    r"no map fix for (5|15|35) s",
    r"map fix again",
    r"GPS_INPUT stopped: no estimate for 35 s",
    r"estimator (died|stuck|gave up)",
    r"computer is (normal|hot|critical)(, -?\d+ C)?",
    r"computer (too slow: (\d+ of \d+ frames late|running at [\d.]+ of [\d.]+ Hz)|keeps up again)",
    r"telemetry of (two senders, one ignored|one sender again)",
    r"(autopilot rebooted, or its time jumps|the autopilot's time is steady again)",
    r"(attitude jumps without gyros, ignored|the attitude is steady again)",
    r"GPS \d is \d+ m off the map",
    r"GPS \d and the map disagree",
    r"GPS \d is lost",
    r"GPS \d agrees with the map again",
    r"position source: (map|GPS)",
    r"lost, send a position hint",
    r"dead reckoning for [\d.]+ km, send a hint",
    r"whole map searched, send a hint",
    r"hint (accepted, searching within|agrees,|is|not used,) [\d.]+ k?m",
    r"hint (agrees,|is|not used,) [\d.]+ k?m( from the estimate| off, searching| outside the map)",
    r"hint is no position, not used",
    r"the map is found (nowhere: no fix|again)",
    r"height/focal seems x[\d.]+ off: no fix",
    r"(heading|mount yaw) off by -?\d+ deg: no fix",
    r"mirrored picture: no fix",
    r"picture squeezed by 1\.(19|33) in [xy]: no fix",
    r"picture (upside down|mirrored|turned by -?90 deg): not used",
    r"(the picture is right again|picture not on the map|the picture is on the map again)",
    r"(gimbal (not reported|repeats a report|reports its servos): level assumed|the gimbal's reports are used again)",
    r"focal or ground height seems x[\d.]+ off",
    r"(focal length|scale|heading|mount yaw|mirrored picture|aspect ratio) is plausible again",
    r"autopilot (does not use the position|uses a position again)",
]


def is_known(text: str) -> bool:
    return len(text) <= MAX_CHARACTERS and any(re.fullmatch(f"Terrafix: {known}", text) for known in KNOWN_TEXTS)


def test_every_pilot_text_is_one_of_the_known_sentences() -> None:
    draw = random.Random(4)
    labels = list(m.SourceLabel)
    published: list[m.Message] = []
    for _ in range(12):
        node = LinkNode(10.0, "act")
        sigma, velocity, east, label = 4.0, 0.5, 0.0, labels[0]
        for step in range(0, 60 * 50, 5):
            now_ns = step * 20 * MS
            if step % 500 == 0:
                sigma, velocity = draw.choice((4.0, 20.0, 60.0, 3000.0)), draw.choice((0.5, 2.0))
                east, label = draw.choice((0.0, 60.0, 5000.0)), draw.choice(labels)
            age_ms = draw.choice((0, 6_000, 16_000, 40_000))
            if draw.random() < 0.2:
                claims = {"velocity_sigma": velocity, "anchor_age_ms": age_ms, "source_label": label}
                published += node.on(estimate(now_ns - 100 * MS, sigma_m=sigma, east_m=east, **claims))  # type: ignore[arg-type]
            if draw.random() < 0.01:
                event = draw.choice(("died", "stuck", "gave_up", "restarted"))
                published += node.on(m.ProcessEvent(t_ns=now_ns, process="estimator", event=event))
            if draw.random() < 0.01:
                band = draw.choice(list(m.ThermalBand))
                published += node.on(
                    m.Health(
                        t_ns=now_ns,
                        band=band,
                        temperature_c=105.4,
                        throttled=True,
                        disk_free_mb=None,
                        cause="a long cause",
                    )
                )
            published += node.tick(now_ns)
    published_texts = set(texts(published))
    assert len(published_texts) >= 12
    assert [text for text in published_texts if not is_known(text)] == []


def test_gps_input_records_the_degradation_level_and_the_time_without_a_map_fix() -> None:
    feed = every(200 * MS, lambda t: estimate(t, anchor_age_ms=t // MS), late_ns=20 * MS)
    sent = gps(fly(LinkNode(10.0), 0, 40 * S, feed))
    for seconds, level in ((3, 0), (10, 1), (20, 2), (38, 3)):
        at = next(g for g in sent if g.t_ns >= seconds * S)
        assert at.degradation == level
        assert at.unanchored_s == pytest.approx(seconds, abs=0.3)


def test_before_the_first_estimate_the_time_without_a_map_fix_is_unknown() -> None:
    (first,) = gps(list(LinkNode(10.0).tick(0)))
    assert (first.degradation, first.unanchored_s) == (0, None)


def test_an_oscillating_degradation_level_is_reported_at_growing_intervals() -> None:
    # The age of the map fix exceeds 5 s repeatedly.
    feed = every(200 * MS, lambda t: estimate(t, anchor_age_ms=t // MS % 6500), late_ns=20 * MS)
    published = fly(LinkNode(10.0), 0, 300 * S, feed)
    map_fix_texts = [t for t in texts(published) if "map fix" in t]
    assert 2 <= len(map_fix_texts) <= 14  # the level changed 46 times in each direction


def test_degradation_warnings_are_not_delayed_by_the_debounce() -> None:
    feed = every(200 * MS, lambda t: estimate(t, anchor_age_ms=t // MS % 40_000), late_ns=20 * MS)
    published = fly(LinkNode(10.0), 0, 130 * S, feed)
    for seconds in (15, 35):
        at = [x.t_ns / S for x in published if isinstance(x, m.StatusText) and f"for {seconds} s" in x.text]
        assert at == pytest.approx([seconds, seconds + 40, seconds + 80], abs=0.5)


def test_the_last_reported_state_is_the_true_one() -> None:
    draw = random.Random(1)
    for _ in range(50):
        debounce, reported, now_ns, state = Debounce[bool](), None, 0, False
        for _ in range(200):
            now_ns += draw.randint(1, 20) * S
            state = draw.random() < 0.5
            reported = state if debounce.due(state, now_ns) else reported
        assert debounce.due(state, now_ns + MAX_TEXT_INTERVAL_NS) or reported == state


def test_after_a_stable_period_the_debounce_interval_is_short_again() -> None:
    debounce = Debounce[int]()
    assert [debounce.due(i, i * 6 * S) for i in range(4)] == [True, True, False, True]
    assert debounce.due(9, 18 * S + RESET_AFTER_NS)
    assert debounce.due(8, 18 * S + RESET_AFTER_NS + 5 * S)


def test_the_end_of_a_warning_is_reported_after_five_seconds() -> None:
    debounce, now_ns = Debounce[int](), 0
    debounce.reported = 0
    for level in (1, 2, 3, 1, 2, 3):
        now_ns += 15 * S
        assert debounce.due(level, now_ns, urgent=True)
    assert not debounce.due(0, now_ns + 4 * S, clears=True)
    assert debounce.due(0, now_ns + 5 * S, clears=True)
    assert not debounce.due(1, now_ns + 10 * S)  # the next warning that is not urgent waits


def test_named_values_are_sent_once_a_second_after_an_autopilot_is_connected() -> None:
    link = WiredEdge()
    (sent,) = gps(list(LinkNode(10.0).tick(0)))
    known = msgspec.structs.replace(sent, fix_type=3, horiz_accuracy_m=6.5, degradation=1, unanchored_s=7.25)
    for tenth in range(20):
        link.edge.on_message(msgspec.structs.replace(known, t_ns=tenth * 100 * MS))
    assert link.wire.take("NAMED_VALUE_FLOAT") == []
    link.receives(0, heartbeat())
    for tenth in range(25):
        link.edge.on_message(msgspec.structs.replace(known, t_ns=tenth * 100 * MS))
    values = [(x.name, x.value) for x in link.wire.take("NAMED_VALUE_FLOAT")]
    assert values == [("TFX_FIX", 3.0), ("TFX_ACC_M", 6.5), ("TFX_MAP_S", 7.25), ("TFX_CAUT", 1.0)] * 2
    link.receives(4 * S, heartbeat())
    link.edge.on_message(msgspec.structs.replace(sent, t_ns=5 * S))
    lost = {x.name: x.value for x in link.wire.take("NAMED_VALUE_FLOAT")}
    assert lost["TFX_FIX"] == 1.0
    assert math.isnan(lost["TFX_ACC_M"]) and math.isnan(lost["TFX_MAP_S"])


def texts_on(fault: m.CalibrationFault, lasts_ns: int = 6 * S) -> list[m.StatusText]:
    """Texts about a fault that begins, and ends ``lasts_ns`` later."""
    node, end_ns = LinkNode(10.0), fault.t_ns + lasts_ns
    published = [*node.on(fault), *node.on(msgspec.structs.replace(fault, t_ns=end_ns, active=False))]
    return [message for message in published if isinstance(message, m.StatusText)]


@pytest.mark.parametrize(
    ("quantity", "factor"),
    [
        ("scale", 3.28),
        ("heading", -179.6),
        ("mount yaw", 180.0),
        ("mirrored picture", None),
        ("registration", None),
        ("aspect ratio", 0.75),
        ("aspect ratio", 32 / 27),
    ],
)
def test_a_calibration_fault_and_its_end_are_reported_to_the_pilot(quantity: str, factor: float | None) -> None:
    began, ended = texts_on(m.CalibrationFault(t_ns=S, quantity=quantity, factor=factor, detail="", active=True))
    assert is_known(began.text) and began.text.endswith("no fix") and began.severity == 2
    assert is_known(ended.text) and "no fix" not in ended.text and ended.severity == 6


@pytest.mark.parametrize(
    ("quantity", "factor"), [("picture upside down", None), ("picture turned", -90.0), ("picture mirrored", None)]
)
def test_a_picture_that_turns_in_flight_is_reported_to_the_pilot_as_not_used(
    quantity: str, factor: float | None
) -> None:
    began, ended = texts_on(m.CalibrationFault(t_ns=S, quantity=quantity, factor=factor, detail="", active=True))
    assert is_known(began.text) and quantity in began.text and began.text.endswith("not used") and began.severity == 2
    assert ended.text == "Terrafix: the picture is right again" and ended.severity == 6


@pytest.mark.parametrize(
    ("quantity", "factor", "text"),
    [("focal length", 1.28, "focal or ground height seems x1.28 off"), ("picture not on the map", None, None)],
)
def test_a_fault_that_the_claim_contains_is_reported_without_a_word_of_the_fix(
    quantity: str, factor: float | None, text: str | None
) -> None:
    began, ended = texts_on(m.CalibrationFault(t_ns=S, quantity=quantity, factor=factor, detail="", active=True))
    assert began.text == f"Terrafix: {text or quantity}" and ended.severity == 6
    assert is_known(began.text) and is_known(ended.text)


@pytest.mark.parametrize("quantity", LINK_FAULTS)
def test_telemetry_and_frames_that_are_left_out_are_a_warning_by_their_cause(quantity: str) -> None:
    detail = "6 of 10 frames late"
    began, ended = texts_on(m.CalibrationFault(t_ns=S, quantity=quantity, factor=None, detail=detail, active=True))
    assert is_known(began.text) and quantity in began.text and began.severity == 4
    assert is_known(ended.text) and ended.severity == 6


def test_a_fault_that_comes_and_goes_is_reported_seldom_and_its_last_state_is() -> None:
    fault = m.CalibrationFault(t_ns=0, quantity=TWO_SENDERS, factor=None, detail="", active=True)

    def feed(now_ns: int) -> list[m.Message]:
        if now_ns % S or now_ns >= 61 * S:
            return []
        return [msgspec.structs.replace(fault, t_ns=now_ns, active=now_ns // S % 2 == 0)]

    sent = [text for text in texts(fly(LinkNode(10.0), 0, 130 * S, feed)) if "sender" in text]
    assert len(sent) <= 8 and sent[-1] == f"Terrafix: {TWO_SENDERS}, one ignored"


def test_a_text_has_the_time_at_which_it_is_sent_not_that_at_which_its_fault_began() -> None:
    fault = m.CalibrationFault(t_ns=S, quantity=TWO_SENDERS, factor=None, detail="", active=True)
    node = LinkNode(10.0)
    list(node.tick(9 * S))
    (text,) = [x for x in node.on(fault) if isinstance(x, m.StatusText)]
    assert text.t_ns == 9 * S
