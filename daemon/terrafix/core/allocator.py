"""Memory allocator of the C library."""

import ctypes

# mallopt(3)
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
# Blocks up to this size come from the heap, which keeps them for the next one when they are freed: intermediate results
# of a frame are 0.1 to 20 MB. glibc would return each of them to the kernel, and every new page of the next one costs a
# page fault: 10 % of the processor time of a frame. [measured: village-1, 150 and 134 ms a frame, 463 and 469 MB]
HEAP_BLOCK_BYTES = 32 * 1024 * 1024  # glibc takes no more [spec: mallopt(3), DEFAULT_MMAP_THRESHOLD_MAX]
KEPT_BYTES = 256 * 1024 * 1024  # free memory at the end of the heap that is not returned either
# One heap for all threads. Else each thread that decodes images gets its own, with free memory of its own: 23 MB of
# vision's. [measured: docs/decisions/048]
HEAPS = 1

# Free memory after a look at the map from which it is returned: a look while tracking needs 40 MB, the first one or one
# of a search several times as much. [measured: village-1, 40 and 160 MB]
EXCESS_BYTES = 64 * 1024 * 1024

# What was touched once stays with the process, although most of it is free most of the time: of vision's 134 MB 30 to
# 60 are in use. So free memory goes back once a minute: 5 ms for 67 MB, and 35 ms of page faults in the next frame that
# needs as much. [measured: docs/decisions/048]
RETURN_S = 60.0
LEAST_BYTES = 8 * 1024 * 1024  # less is not worth the system call [measured: docs/decisions/048]


def keep_freed_memory() -> bool:
    """Lets this process use freed memory again instead of returning it to the kernel. -> False where the C library has
    no mallopt, or refuses the values."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    settings = ((M_MMAP_THRESHOLD, HEAP_BLOCK_BYTES), (M_TRIM_THRESHOLD, KEPT_BYTES), (M_ARENA_MAX, HEAPS))
    return all([mallopt(*setting) for setting in settings])


class _Mallinfo2(ctypes.Structure):
    """mallinfo2(3): sizes in bytes."""

    _fields_ = (
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks")),
        *((name, ctypes.c_size_t) for name in ("uordblks", "fordblks", "keepcost")),
    )


_returned_bytes = 0  # of the free memory, what the kernel has back: mallinfo2 counts it as free all the same


def return_excess_memory() -> bool:
    """Returns freed memory to the kernel if there is more of it than EXCESS_BYTES: after work much larger than what
    follows. -> whether it did; False where the C library is not glibc 2.33 or later."""
    global _returned_bytes
    free_bytes = _free_bytes()
    _returned_bytes = min(_returned_bytes, free_bytes)  # what is in use again is not returned
    return free_bytes - _returned_bytes > EXCESS_BYTES and _return_all()


def return_free_memory() -> bool:
    """Returns freed memory to the kernel, to be called once in RETURN_S. -> whether it did; False where there is less
    than LEAST_BYTES, or the C library is not glibc 2.33 or later."""
    return _free_bytes() >= LEAST_BYTES and _return_all()


def _free_bytes() -> int:
    """Freed memory of the heap, whether the kernel has it back or not; 0 where the C library does not tell."""
    try:
        libc = ctypes.CDLL(None)
        libc.mallinfo2.restype = _Mallinfo2
    except (AttributeError, OSError):
        return 0
    return int(libc.mallinfo2().fordblks)


def _return_all() -> bool:
    global _returned_bytes
    if not ctypes.CDLL(None).malloc_trim(0):
        return False
    _returned_bytes = _free_bytes()
    return True
