"""Allocator of the C library: freed blocks are used again without page faults."""

import resource
import subprocess
import sys

import pytest

FAULTS = """
import resource
{first}
import numpy as np

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        held = [np.ones(1_250_000) for _ in range(6)]  # 60 MB, 14648 pages
        del held
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
print(faults())
"""


def page_faults(first: str) -> int:
    """-> page faults of 20 times six temporary arrays of 10 MB in a new process, after the statement ``first``."""
    done = subprocess.run(
        [sys.executable, "-c", FAULTS.format(first=first)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


@pytest.mark.skipif(sys.platform != "linux" or resource.getpagesize() != 4096, reason="counts pages of 4 kB of glibc")
def test_arrays_of_a_frame_are_allocated_without_page_faults_once_terrafix_is_imported() -> None:
    assert page_faults("import terrafix") < 500
    assert page_faults("") > 5_000  # else this test cannot fail


RESIDENT = """
import numpy as np
from terrafix.core.allocator import EXCESS_BYTES, return_excess_memory

def work(size):
    kept = []
    for _ in range(size >> 20):
        held = np.ones(131_072)  # 1 MB
        kept.append((held, np.zeros(10)))  # a small array behind it, which stays
    return [small for _, small in kept]

def resident_mb():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1]) >> 10

small = work(EXCESS_BYTES // 2)
first = return_excess_memory()
before = resident_mb()
more = work(3 * EXCESS_BYTES)  # less than KEPT_BYTES, which the allocator returns itself
after = return_excess_memory()
again = return_excess_memory()  # the same free memory, which the kernel has by now
print(int(first), int(after), int(again), int(resident_mb() < before + (EXCESS_BYTES >> 20)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="mallinfo2 and malloc_trim of glibc")
def test_memory_is_returned_after_work_much_larger_than_usual_and_kept_otherwise() -> None:
    done = subprocess.run([sys.executable, "-c", RESIDENT], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["0", "1", "0", "1"]


FLAT = """
import threading
import numpy as np
from terrafix.core.allocator import return_free_memory

def work():
    held = [np.ones(131_072) for _ in range(100)]  # 100 MB
    kept.append(np.zeros(10))  # behind them: their memory is not at the end of the heap

def resident_mb():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1]) >> 10

kept = []
before = resident_mb()
print(int(return_free_memory()))  # there is little
for _ in range(3):
    work()
    between = resident_mb()
    print(int(return_free_memory()))
    print(int(resident_mb() < before + 10), int(between > before + 90))
thread = threading.Thread(target=work)
thread.start()
thread.join()
print(int(return_free_memory()), int(resident_mb() < before + 10))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="mallinfo2 and malloc_trim of glibc")
def test_all_free_memory_is_returned_each_time_also_that_of_threads_unless_there_is_little() -> None:
    done = subprocess.run([sys.executable, "-c", FLAT], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["0", *("1", "1", "1") * 3, "1", "1"]
