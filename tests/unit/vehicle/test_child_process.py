"""Programs that a command starts beside itself are ended in order, or killed."""

import signal
import subprocess
import sys

import pytest

from terrafix_tools import child_process

DEAF = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('deaf', flush=True); time.sleep(60)"


@pytest.mark.parametrize(
    ("program", "limit_s", "code"),
    [("print('up', flush=True); import time; time.sleep(60)", 20.0, -signal.SIGTERM), (DEAF, 0.1, -signal.SIGKILL)],
)
def test_a_child_ends_by_sigterm_and_one_that_ignores_it_by_sigkill(program: str, limit_s: float, code: int) -> None:
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        child_process.end(process, limit_s)
        assert process.poll() == code
        child_process.end(process, limit_s)  # one that has ended
