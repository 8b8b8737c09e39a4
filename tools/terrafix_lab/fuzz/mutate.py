"""Mutations of an input, as coverage-blind fuzzers make them: deterministic for a random generator."""

import random

MAX_BYTES = 1 << 20  # of a mutated input
INTERESTING = (
    b"\x00", b"\xff", b"\x7f\xff\xff\xff", b"\xff\xff\xff\xff", b"\x80\x00\x00\x00", b"\x00" * 8, b"\xff" * 8,
    b"nan", b"inf", b"-1", b"0", b"1e308", b"1e999", b"-0.0", b"9" * 400, b"\xc3\x28", b"\xef\xbb\xbf", b"\r\n", b"\"",
    b",", b"[", b"{", b"=", b"../", b"/etc/passwd", b"%s%n", b"\xfd", b"\xfe",
)  # fmt: skip
MOST_STEPS = 6  # mutations of one input


def mutated(seeds: list[bytes], rng: random.Random) -> bytes:
    """One of the seeds, changed one to MOST_STEPS times."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(1, MOST_STEPS)):
        _change(data, seeds, rng)
    return bytes(data[:MAX_BYTES])


def _change(data: bytearray, seeds: list[bytes], rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    size = min(len(data) - at, 1 << rng.randint(0, 8))
    match rng.randint(0, 7):
        case 0 if data:
            data[min(at, len(data) - 1)] ^= 1 << rng.randint(0, 7)
        case 1 if data:
            data[min(at, len(data) - 1)] = rng.randint(0, 255)
        case 2:
            del data[at : at + size]
        case 3:
            data[at:at] = data[at : at + size] * rng.randint(1, 4)
        case 4:
            data[at:at] = rng.choice(INTERESTING)
        case 5:
            new = rng.choice(INTERESTING)
            data[at : at + len(new)] = new
        case 6:
            del data[at:]
        case _:
            other = rng.choice(seeds)
            start = rng.randint(0, len(other))
            data[at : at + size] = other[start : start + size]
