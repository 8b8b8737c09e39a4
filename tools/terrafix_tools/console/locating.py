"""The process that finds the position of a pixel, as the service sees it."""

import asyncio
import os
import sys

import msgspec

from terrafix_tools.console.problems import Refusal

ANSWER_S = 60.0  # longest wait for an answer: the record of a long flight is read first
IDLE_S = 120.0  # after which the process ends, and frees the memory of the last flight


class Question(msgspec.Struct):
    """``out``: folder with the record of a flight."""

    out: str
    map: str
    pixels: list[tuple[int, tuple[float, float]]]  # frame, and pixel of the frame as it was read


class LocateAnswer(msgspec.Struct):
    """``refused``: why there is no position; ""  with one."""

    refused: str = ""
    lat_deg: float = 0.0
    lon_deg: float = 0.0
    alt_amsl_m: float | None = None
    radius95_m: float = 0.0
    surface: str = ""
    consistent: bool = True


class LocatingProcess:
    """Starts with the first question. One question at a time; at most ``most`` wait."""

    def __init__(self, most: int) -> None:
        self._most, self._waiting = most, 0
        self._process: asyncio.subprocess.Process | None = None
        self._one = asyncio.Lock()
        self._idle: asyncio.TimerHandle | None = None

    async def ask(self, question: Question) -> LocateAnswer:
        """Raises Refusal: too many questions, or the process failed."""
        if self._waiting >= self._most:
            raise Refusal(429, f"{self._most} positions are being computed; try again later")
        self._waiting += 1
        try:
            async with self._one:
                return await self._ask(question)
        finally:
            self._waiting -= 1

    async def _ask(self, question: Question) -> LocateAnswer:
        if self._idle is not None:
            self._idle.cancel()
        if self._process is None or self._process.returncode is not None:
            self._process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "terrafix_tools.console.compute.locating", "--parent", str(os.getpid())),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                env={"OMP_NUM_THREADS": "1", **os.environ},
            )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(msgspec.json.encode(question) + b"\n")
        try:
            line = await asyncio.wait_for(self._process.stdout.readline(), ANSWER_S)
        except TimeoutError:
            line = b""
        if not line:
            await self.stop()
            raise Refusal(503, "the position could not be computed; the log of the console has the reason")
        self._idle = asyncio.get_running_loop().call_later(IDLE_S, self._process.stdin.close)
        return msgspec.json.decode(line, type=LocateAnswer)

    async def stop(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
        if self._process is not None and self._process.returncode is None:
            self._process.kill()
            await self._process.wait()
        self._process = None
