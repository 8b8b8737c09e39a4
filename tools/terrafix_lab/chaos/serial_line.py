"""A serial line between Terrafix and the simulated autopilot, which speaks UDP: a pair of pseudo-terminals."""

import os
import select
import socket
import threading
import tty
from contextlib import suppress

import numpy as np

READ_BYTES = 1024
WAIT_S = 0.1


class SerialLine:
    """A context manager. ``device`` is for `[link] device`.

    ``other_baud``: the two ends have different baud rates: as many bytes arrive, and each is a wrong one. A
    pseudo-terminal has no rate, so this is what a wrong one does, not the rate itself."""

    def __init__(self, port: int) -> None:
        """``port``: of the autopilot, on 127.0.0.1."""
        self.other_baud = False
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.device = os.ttyname(self._slave)
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.connect(("127.0.0.1", port))
        os.set_blocking(self._master, False)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="serial-line", daemon=True)

    def __enter__(self) -> "SerialLine":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()
        self._udp.close()
        os.close(self._master)
        os.close(self._slave)

    def _run(self) -> None:
        noise = np.random.default_rng(1)
        while not self._stopping.is_set():
            ready, _, _ = select.select([self._master, self._udp.fileno()], [], [], WAIT_S)
            for end in ready:
                with suppress(OSError):  # nobody listens, or the buffer of the line is full: the bytes are lost
                    data = os.read(end, READ_BYTES)
                    os.write(
                        self._udp.fileno() if end == self._master else self._master,
                        noise.bytes(len(data)) if self.other_baud else data,
                    )
