"""Programs that a command starts beside itself."""

import subprocess


def end(process: "subprocess.Popen[bytes]", limit_s: float) -> None:
    """Ends ``process`` in order with SIGTERM, and after ``limit_s`` with SIGKILL. One that has ended is left alone."""
    process.terminate()
    try:
        process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
