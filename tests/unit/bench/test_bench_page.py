"""Floors of the stages and the page of the benchmark, from numbers made by hand."""

import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from terrafix.core.errors import OutputError
from terrafix.messages import Frame
from terrafix_lab.bench.comparison import compared
from terrafix_lab.bench.kernels import KernelTimes, floors, timed_kernels
from terrafix_lab.bench.page import comparison_table, page, stage_table, write_page


def spread(median: float) -> dict[str, float]:
    return {"median": median, "p95": 2.0 * median, "p99": 3.0 * median}


def accuracy(share: float) -> dict[str, Any]:
    return {"frames": 8, "within_20m": share, "within_50m": 1.0, "median_m": 2.0, "model_rate": 0.25}


FLIGHT: dict[str, Any] = {
    "frames": 8,
    "runs": {
        "weights-free": {
            "frame_ms": spread(120.0),
            "cpu_ms": spread(100.0),
            "stage_ms": {"decode": spread(5.0), "anchor": spread(90.0), "estimator": spread(9.0)},
            "stage_cpu_ms": {"anchor": spread(80.0), "estimator": spread(8.0)},
            "accuracy": accuracy(0.875),
            "first_frame_cpu_ms": 800.0,
            "start_up_s": 1.5,
            "peak_memory_mb": 300.0,
        }
    },
    "peers": {
        "SIFT <old>": {
            "cpu_ms": spread(600.0),
            "cpu_ms_with_map_points_kept": spread(200.0),
            "accuracy": accuracy(0.0),
        },
        "XFeat": {"cpu_ms": None, "cpu_ms_with_map_points_kept": None, "accuracy": accuracy(0.5)},
    },
    "missing": ["XFeat: not there"],
    "floor": {
        "anchor": {
            "kernel_cpu_ms": spread(40.0),
            "ratio": 2.0,
            "kernels": {"warps": {"cpu_ms": 9.0, "calls": 3}, "Fourier transforms": {"cpu_ms": 31.0, "calls": 9}},
        },
        "estimator": {"kernel_cpu_ms": spread(0.1), "ratio": None, "kernels": {}},
    },
}
RESULT: dict[str, Any] = {
    "machine": {"cpu": "a CPU", "cores": 2, "load_average_before": (0.5, 0, 0), "load_average_after": (0.7, 0, 0)},
    "missing": ["flight town-a: not there"],
    "flights": {"village-1": FLIGHT},
}


def test_every_method_has_a_row_with_the_frames_that_it_found() -> None:
    assert [(row.name, row.found, row.frames) for row in compared(FLIGHT)] == [
        ("Terrafix, weights-free", 7, 8),
        ("... the map matching of it", 7, 8),
        ("SIFT <old>", 0, 8),
        ("XFeat", 4, 8),
    ]
    assert comparison_table(FLIGHT)[1:4] == [
        ["Terrafix, weights-free", "7/8", "100/200/300", "-", "-", "25 %"],
        ["... the map matching of it", "7/8", "80/160/240", "-", "-", "25 %"],
        ["SIFT <old>", "0/8", "600/1200/1800", "200/400/600", "0.17/0.17", "-"],
    ]


def test_a_stage_has_its_times_beside_its_floor_and_the_largest_kernels_first() -> None:
    assert stage_table(FLIGHT)[1:] == [
        ["decode", "5.0/10.0/15.0", "-", "-", "-", ""],
        ["anchor", "90/180/270", "80/160/240", "40/80/120", "2.00", "Fourier transforms 31.0, warps 9.0"],
        ["estimator", "9.0/18.0/27.0", "8.0/16.0/24.0", "-", "-", ""],
        ["whole frame", "120/240/360", "100/200/300", "-", "-", ""],
    ]


def test_the_page_has_the_tables_the_picture_and_what_was_not_measured(tmp_path: Path) -> None:
    write_page(tmp_path / "docs" / "benchmark.md", RESULT)
    text = (tmp_path / "docs" / "benchmark.md").read_text()
    assert text == page(RESULT)
    assert "| ... the map matching of it | 7/8 | 80/160/240 | - | - | 25 % |" in text
    assert "First frame 800 ms of the processor, start-up 1.5 s by the clock, 300 MB." in text
    assert "Not measured: XFeat: not there." in text and "Not measured: flight town-a: not there." in text
    assert all(len(line) <= 160 or line.startswith("|") for line in text.splitlines())
    picture = ElementTree.parse(tmp_path / "docs" / "images" / "benchmark.svg").getroot()
    bars = [float(bar.get("width", "")) for bar in picture.iter("{http://www.w3.org/2000/svg}rect")][1:]
    ours, _, matching, _, sift, map_points, anchor, inside, estimator, _ = bars
    assert (matching / ours, sift / ours, map_points / sift) == pytest.approx((0.8, 6.0, 2 / 3), abs=0.01)
    assert (inside / anchor, estimator / anchor) == pytest.approx((0.5, 0.1), abs=0.01)
    words = [text.text for text in picture.iter("{http://www.w3.org/2000/svg}text")]
    assert "600 ms, 0 of 8" in words and "80 ms, 2.00 x the floor" in words and "SIFT <old>" in words


def test_a_page_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="choose another --page"):
        write_page(tmp_path / "file" / "benchmark.md", RESULT)


def frame(frame_id: int) -> Frame:
    return Frame(t_ns=frame_id, frame_id=frame_id, file="", width=1, height=1)


def test_the_floor_of_a_stage_is_the_time_inside_of_its_kernels_without_the_first_frame() -> None:
    times = KernelTimes()
    for i, scale in enumerate((100.0, 1.0, 3.0)):
        times.add_kernel("imread", 5.0)  # before the frame is known
        times.begin(frame(i))
        times.stage = "vision"
        times.add_kernel("dft", 2.0 * scale)
        times.add_kernel("dft", 1.0 * scale)
        times.add_kernel("anything", 1.0 * scale)
        times.stage = ""
        times.add("vision", 20.0, 6.0 * scale)
        times.add("estimator", 20.0, 7.0)
    found = floors(times)
    assert found["vision"]["cpu_ms"]["median"] == 12.0 and found["vision"]["kernel_cpu_ms"]["median"] == 8.0
    assert found["vision"]["ratio"] == 1.5
    assert found["vision"]["kernels"] == {
        "Fourier transforms": {"cpu_ms": 6.0, "calls": 2.0},
        "filters and others": {"cpu_ms": 2.0, "calls": 1.0},
    }
    assert found["estimator"]["ratio"] is None and found["estimator"]["kernel_cpu_ms"]["median"] == 0.0


def test_calls_of_opencv_are_timed_and_give_the_same_results_and_afterwards_it_is_as_before() -> None:
    before, sift_class = cv2.dft, cv2.SIFT
    image = np.random.default_rng(1).random((200, 200), np.float32)
    seen: list[tuple[str, float]] = []
    began_s = time.process_time()
    with timed_kernels(lambda name, cpu_ms: seen.append((name, cpu_ms))):
        spectrum = cv2.dft(image)
        keypoints, _ = cv2.SIFT.create(50).detectAndCompute((255 * image).astype(np.uint8), None)
    cpu_ms = (time.process_time() - began_s) * 1e3
    assert [name for name, _ in seen] == ["dft", "SIFT.detectAndCompute"]
    assert seen[0][1] > 0.0 and sum(ms for _, ms in seen) <= cpu_ms
    assert len(keypoints) > 10 and np.array_equal(spectrum, before(image))
    assert cv2.dft is before and cv2.SIFT is sift_class
