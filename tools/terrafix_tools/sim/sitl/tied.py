"""The program `terrafix`, ended with SIGTERM when the one that started it has ended, however that ended.

``python -m terrafix_tools.sim.sitl.tied PID ARGUMENTS``; PID: of who starts it. A flight that was killed ends nobody,
and a Terrafix whose autopilot and camera are gone waits for them to come back."""

import signal
import sys

from terrafix.runtime.fork_server import end_with
from terrafix_tools import program


def main() -> None:
    parent_pid = int(sys.argv.pop(1))
    if end_with(parent_pid, signal.SIGTERM):
        program.main()


if __name__ == "__main__":
    main()
