"""`terrafix` as a child process that receives SIGTERM when its parent ends for any reason.

``python -m terrafix_lab.sim.sitl.child_process PID ARGUMENTS``; PID: of the parent. A killed flight cannot stop
its children, and without this Terrafix would wait for autopilot and camera to return.
"""

import signal
import sys

from terrafix.runtime.fork_server import set_parent_death_signal
from terrafix_tools import program


def main() -> None:
    parent_pid = int(sys.argv.pop(1))
    if set_parent_death_signal(parent_pid, signal.SIGTERM):
        program.main()


if __name__ == "__main__":
    main()
