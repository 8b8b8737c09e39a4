"""Runs one case in this process: python -m terrafix_lab.golden.one CASE DATA OUT."""

import sys
import tempfile
from pathlib import Path

import cv2
import msgspec

from terrafix.core.errors import TerrafixError
from terrafix_lab.golden.cases import CASES


def main() -> None:
    name, data, out = sys.argv[1:]
    cv2.setNumThreads(1)
    case = next(case for case in CASES if case.name == name)
    with tempfile.TemporaryDirectory() as work:
        try:
            digests = case.digests(Path(data), Path(work))
        except TerrafixError as error:
            sys.exit(str(error))
    Path(out).write_bytes(msgspec.json.encode(digests))


if __name__ == "__main__":
    main()
