"""Growing caution, visible everywhere: record, screen, named values; whole sentences, and no flood of them."""

import math
import random
import re

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_rig import MS, S, estimate, every, fly, gps, texts
from link_wire import MemoryWire, heartbeat, packed
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.edge import MavlinkEdge
from terrafix.link.node import LinkNode
from terrafix.link.pilot_text.debounce import CALM_NS, LONGEST_NS, Debounce

SCREEN = 50  # characters of STATUSTEXT
SENTENCES = [  # everything that Terrafix can say to a pilot; a new text belongs here
    r"3D fix",
    r"no fix: (the estimate is too old|neither map nor odometry|worse than \d+ m|the speed is too uncertain)",
    r"no fix: (suddenly less accurate|the position has jumped|no estimate yet|estimator (died|stuck|gave up))",
    r"no map fix for (5|15|35) s",
    r"map fix again",
    r"silent: no estimate for 35 s",
    r"estimator (died|stuck|gave up)",
    r"computer is (normal|hot|critical)(, -?\d+ C)?",
    r"GPS \d is \d+ m off the map",
    r"GPS \d and the map disagree",
    r"GPS \d is lost",
    r"GPS \d agrees with the map again",
    r"flying on the (map|GPS) now",
    r"lost, send a position hint",
    r"whole map searched, send a hint",
    r"hint (taken, searching within|agrees,|is|not used,) [\d.]+ k?m( from us| off, searching| outside the map)?",
    r"hint is no position, not used",
    r"the map is found (nowhere: no fix|again)",
    r"height/focal seems x[\d.]+ off: no fix",
    r"(heading|mount yaw) off by -?\d+ deg: no fix",
    r"mirrored picture: no fix",
    r"(scale|heading|mount yaw|mirrored picture) is plausible again",
    r"autopilot (does not use the position|uses a position again)",
]


def whole(text: str) -> bool:
    return len(text) <= SCREEN and any(re.fullmatch(f"Terrafix: {sentence}", text) for sentence in SENTENCES)


def test_whatever_happens_the_pilot_reads_whole_sentences() -> None:
    draw = random.Random(4)
    labels = list(m.SourceLabel)
    said: list[m.Message] = []
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
                said += node.on(estimate(now_ns - 100 * MS, sigma_m=sigma, east_m=east, **claims))  # type: ignore[arg-type]
            if draw.random() < 0.01:
                event = draw.choice(("died", "stuck", "gave_up", "restarted"))
                said += node.on(m.ProcessEvent(t_ns=now_ns, process="estimator", event=event))
            if draw.random() < 0.01:
                band = draw.choice(list(m.ThermalBand))
                said += node.on(
                    m.Health(
                        t_ns=now_ns,
                        band=band,
                        temperature_c=105.4,
                        throttled=True,
                        disk_free_mb=None,
                        cause="a long cause",
                    )
                )
            said += node.tick(now_ns)
    heard = set(texts(said))
    assert len(heard) >= 12
    assert [text for text in heard if not whole(text)] == []


def test_the_record_has_the_rung_and_the_seconds() -> None:
    feed = every(200 * MS, lambda t: estimate(t, anchor_age_ms=t // MS), late_ns=20 * MS)
    sent = gps(fly(LinkNode(10.0), 0, 40 * S, feed))
    for seconds, rung in ((3, 0), (10, 1), (20, 2), (38, 3)):
        at = next(g for g in sent if g.t_ns >= seconds * S)
        assert at.caution == rung
        assert at.unanchored_s == pytest.approx(seconds, abs=0.3)


def test_before_anything_is_known_nothing_is_claimed_about_the_map() -> None:
    (first,) = gps(list(LinkNode(10.0).tick(0)))
    assert (first.caution, first.unanchored_s) == (0, None)


def test_a_ladder_that_is_climbed_again_and_again_becomes_quiet() -> None:
    feed = every(200 * MS, lambda t: estimate(t, anchor_age_ms=t // MS % 6500), late_ns=20 * MS)  # 5 s, again and again
    said = fly(LinkNode(10.0), 0, 300 * S, feed)
    about_the_map = [t for t in texts(said) if "map fix" in t]
    assert 2 <= len(about_the_map) <= 14  # it went up and down 46 times


def test_warnings_of_the_ladder_do_not_wait() -> None:
    feed = every(200 * MS, lambda t: estimate(t, anchor_age_ms=t // MS % 40_000), late_ns=20 * MS)
    said = fly(LinkNode(10.0), 0, 130 * S, feed)
    for seconds in (15, 35):
        at = [x.t_ns / S for x in said if isinstance(x, m.StatusText) and f"for {seconds} s" in x.text]
        assert at == pytest.approx([seconds, seconds + 40, seconds + 80], abs=0.5)


def test_the_last_word_is_always_true() -> None:
    draw = random.Random(1)
    for _ in range(50):
        announcer, told, now_ns, state = Debounce[bool](), None, 0, False
        for _ in range(200):
            now_ns += draw.randint(1, 20) * S
            state = draw.random() < 0.5
            told = state if announcer.due(state, now_ns) else told
        assert announcer.due(state, now_ns + LONGEST_NS) or told == state


def test_calm_makes_the_first_word_quick_again() -> None:
    announcer = Debounce[int]()
    assert [announcer.due(i, i * 6 * S) for i in range(4)] == [True, True, False, True]
    assert announcer.due(9, 18 * S + CALM_NS)
    assert announcer.due(8, 18 * S + CALM_NS + 5 * S)


def test_that_it_is_well_again_is_told_after_five_seconds_whatever_was_said_before() -> None:
    announcer, now_ns = Debounce[int](), 0
    announcer.told = 0
    for rung in (1, 2, 3, 1, 2, 3):
        now_ns += 15 * S
        assert announcer.due(rung, now_ns, urgent=True)
    assert not announcer.due(0, now_ns + 4 * S, clears=True)
    assert announcer.due(0, now_ns + 5 * S, clears=True)
    assert not announcer.due(1, now_ns + 10 * S)  # ... and the next bad word that is not urgent waits


def test_named_values_once_a_second_and_only_to_an_autopilot() -> None:
    wire = MemoryWire()
    edge = MavlinkEdge(LinkSection(), wire, lambda: 0)
    (sent,) = gps(list(LinkNode(10.0).tick(0)))
    known = msgspec.structs.replace(sent, fix_type=3, horiz_accuracy_m=6.5, caution=1, unanchored_s=7.25)
    for tenth in range(20):
        edge.heard(msgspec.structs.replace(known, t_ns=tenth * 100 * MS))
    assert wire.take("NAMED_VALUE_FLOAT") == []
    wire.arrive(packed(heartbeat(), mavlink.MAVLink(None, 7, 1)))
    list(edge.poll(0))
    for tenth in range(25):
        edge.heard(msgspec.structs.replace(known, t_ns=tenth * 100 * MS))
    values = [(x.name, x.value) for x in wire.take("NAMED_VALUE_FLOAT")]
    assert values == [("TFX_FIX", 3.0), ("TFX_ACC_M", 6.5), ("TFX_MAP_S", 7.25), ("TFX_CAUT", 1.0)] * 2
    wire.arrive(packed(heartbeat(), mavlink.MAVLink(None, 7, 1)))
    list(edge.poll(4 * S))
    edge.heard(msgspec.structs.replace(sent, t_ns=5 * S))
    lost = {x.name: x.value for x in wire.take("NAMED_VALUE_FLOAT")}
    assert lost["TFX_FIX"] == 1.0
    assert math.isnan(lost["TFX_ACC_M"]) and math.isnan(lost["TFX_MAP_S"])


@pytest.mark.parametrize(
    ("quantity", "factor"),
    [("scale", 3.28), ("heading", -179.6), ("mount yaw", 180.0), ("mirrored picture", None), ("registration", None)],
)
def test_the_pilot_reads_what_seems_miscalibrated_and_when_it_is_plausible_again(
    quantity: str, factor: float | None
) -> None:
    node = LinkNode(10.0)
    fault = m.CalibrationFault(t_ns=S, quantity=quantity, factor=factor, detail="", active=True)
    said = [*node.on(fault), *node.on(msgspec.structs.replace(fault, active=False))]
    began, ended = (message for message in said if isinstance(message, m.StatusText))
    assert whole(began.text) and began.text.endswith("no fix") and began.severity == 2
    assert whole(ended.text) and "no fix" not in ended.text and ended.severity == 6
