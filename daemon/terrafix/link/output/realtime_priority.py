"""The link before everybody else: it needs a hundredth of a processor, ten times a second, and needs it at once.

Measured on two cores with some twenty other programs that compute: without it one interval in a hundred is longer than
309 ms, with it than 101 ms. The kernel leaves a twentieth of every second to the others whatever happens, and a link
that hangs is killed by its supervisor after 2 s."""

import os

from terrafix.core import logs

PRIORITY = 1  # the lowest of real time is above everything that is not
THREADS = "/proc/self/task"


def first_in_line() -> bool:
    """For all threads of this process, and those that they will start: one without the priority (that writes the log)
    may be put aside while it holds the lock of the interpreter, and the link with it.

    False: not allowed (systemd: LimitRTPRIO); it is logged."""
    try:
        for thread in os.listdir(THREADS):
            os.sched_setscheduler(int(thread), os.SCHED_RR, os.sched_param(PRIORITY))
    except OSError as error:
        what_to_do = "allow it (systemd: LimitRTPRIO=1); docs/link.md has more"
        logs.get().warning("no real-time priority: GPS_INPUT may be late under load", why=error.strerror, do=what_to_do)
        return False
    return True
