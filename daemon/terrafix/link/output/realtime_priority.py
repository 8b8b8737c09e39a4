"""Real-time priority of the link. It needs a hundredth of a processor, ten times a second, without delay.

Measured on two cores with some twenty other programs that compute: without the priority one interval in a hundred is
longer than 309 ms, with it longer than 101 ms (docs/link.md). The kernel reserves a twentieth of every second for other
programs, and the supervisor kills a link that hangs after 2 s."""

import os

from terrafix.core import logs

REALTIME_PRIORITY = 1  # lowest priority of SCHED_RR, above all normal processes [spec: sched(7)]
THREADS = "/proc/self/task"


def set_realtime_priority() -> bool:
    """Sets SCHED_RR for all threads of this process and those that they start. A thread without it, such as the writer
    of the log, may be preempted while it holds the interpreter lock, and would delay the link.

    -> False when the system does not allow it (systemd: LimitRTPRIO); a warning is logged."""
    try:
        for thread in os.listdir(THREADS):
            os.sched_setscheduler(int(thread), os.SCHED_RR, os.sched_param(REALTIME_PRIORITY))
    except OSError as error:
        remedy = "allow it (systemd: LimitRTPRIO=1); docs/link.md has more"
        logs.get().warning("no real-time priority: GPS_INPUT may be late under load", why=error.strerror, do=remedy)
        return False
    return True
