"""Monitor of the receivers in a flight without any reading, as under jamming."""

import tracemalloc

from link_rig import estimate
from terrafix.core.clock import NS_PER_S
from terrafix.link.gnss.monitor import GnssMonitor
from terrafix.link.integrity.output_predictor import InertialBuffer


def test_without_readings_the_steps_of_the_estimate_take_no_more_memory_with_time() -> None:
    monitor, inertial, held = GnssMonitor("monitor"), InertialBuffer(), list[int]()
    tracemalloc.start()
    for second in range(2000):
        monitor.on_estimate(estimate(t_ns=second * NS_PER_S), inertial)
        if second % 1000 == 500:
            held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert held[1] < held[0] + 10_000  # bytes; all steps would be 100,000
