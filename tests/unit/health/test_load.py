"""Load of the cores and of the processes of a run, from a tree like proc, and from the real one."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from terrafix.health.load import CpuLoad

PARENT = 70


def write_proc(proc: Path, cores: list[list[int]], children: dict[int, tuple[str, int, int]]) -> None:
    """``cores``: ticks of each core by state; ``children``: name, user and system ticks by process id."""
    total = [sum(column) for column in zip(*cores, strict=True)]
    lines = [f"cpu  {' '.join(map(str, total))}"]
    lines += [f"cpu{i} {' '.join(map(str, times))}" for i, times in enumerate(cores)]
    proc.mkdir(exist_ok=True)
    (proc / "stat").write_text("\n".join([*lines, "intr 1 2 3"]) + "\n")
    task = proc / str(PARENT) / "task" / str(PARENT)
    task.mkdir(parents=True, exist_ok=True)
    (task / "children").write_text(" ".join(map(str, children)) + " ")
    for pid, (name, user, system) in children.items():
        (proc / str(pid)).mkdir(exist_ok=True)
        before = f"{pid} ({name}) S {PARENT} 1 1 0 -1 4194560 9 0 0 0"
        (proc / str(pid) / "stat").write_text(f"{before} {user} {system} 0 0 20 0 1 0 5 0\n")


def test_load_is_the_share_since_the_reading_before(tmp_path: Path) -> None:
    load = CpuLoad(tmp_path, PARENT)
    # user, nice, system, idle, iowait, irq, softirq, steal, guest, guest_nice
    write_proc(
        tmp_path, [[100, 0, 50, 800, 50, 0, 0, 0, 40, 0]] * 2, {71: ("vision", 900, 100), 72: ("an chor)", 5, 5)}
    )
    assert load.read() == {}
    later = [[150, 5, 60, 820, 60, 2, 2, 1, 90, 0], [100, 0, 50, 900, 50, 0, 0, 0, 40, 0]]
    write_proc(tmp_path, later, {71: ("vision", 930, 120), 72: ("an chor)", 5, 9), 73: ("link", 7, 7)})
    # 200 ticks of two cores have passed, of which 70 were busy: user 50, nice 5, system 10, then 2, 2, 1.
    assert load.read() == {"all": 0.35, "vision": 0.5, "an chor)": 0.04}
    write_proc(
        tmp_path, [[200, 5, 60, 870, 60, 2, 2, 1, 90, 0], [200, 0, 50, 900, 50, 0, 0, 0, 40, 0]], {73: ("link", 57, 7)}
    )
    assert load.read() == {"all": 0.75, "link": 0.5}


def test_restarted_process_has_no_negative_load(tmp_path: Path) -> None:
    load = CpuLoad(tmp_path, PARENT)
    write_proc(tmp_path, [[0, 0, 0, 100, 0, 0, 0, 0]], {71: ("link", 500, 0)})
    load.read()
    write_proc(tmp_path, [[50, 0, 0, 150, 0, 0, 0, 0]], {80: ("link", 3, 0)})
    assert load.read() == {"all": 0.5, "link": 0.0}


@pytest.mark.parametrize("content", [None, "", "cpu a b", "garbled"])
def test_without_a_readable_proc_there_is_no_load(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "stat").write_text(content)
    load = CpuLoad(tmp_path, PARENT)
    assert load.read() == {} and load.read() == {}


def test_a_busy_child_of_this_process_is_seen_with_its_load() -> None:
    code = "import time\nend = time.monotonic() + 5\nwhile time.monotonic() < end: pass"
    load = CpuLoad(parent=os.getpid())
    with subprocess.Popen([sys.executable, "-c", code]) as child:
        name = Path(f"/proc/{child.pid}/stat").read_text().partition("(")[2].rpartition(")")[0]
        time.sleep(0.2)
        load.read()
        time.sleep(0.5)
        found = load.read()
        child.kill()
    assert 0.0 < found["all"] <= 1.0
    assert 0.0 < found[name] <= 1.2
