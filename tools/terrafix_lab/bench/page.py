"""The page of the benchmark for people: Markdown with a picture, from the results of one run."""

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from terrafix.core.errors import OutputError
from terrafix_lab.bench import scaling
from terrafix_lab.bench.comparison import Row, compared, percent_text, spread_text

PICTURE = "benchmark.svg"
WIDTH, ROW, GUTTER, BARS, TOP, BELOW = 920, 22, 260, 470, 48, 32  # pixels of the picture
INK, FAINT = "#1d2430", "#68727f"
OURS, FLOOR, PEER, PALE = "#5b9bd9", "#1d5288", "#c9853c", "#ecd3b8"

HEAD = """# Benchmark

Written by `terrafix bench --page docs/benchmark.md` from one run. Its [JSON](outputs.md#benchjson) has more.

{cpu}, {cores} cores, load {load} before and after: compare processor times, and those of one run. All are of one
frame in milliseconds, without the first frame: median/95 %/99 %.

![Processor time of each method and stage](images/{picture})

## Beside other methods

The same frames and predictions. A peer matches points of the orthorectified frame with those of the map up to 70 m
around it and fits a homography by RANSAC. It begins at the position that our estimator predicts, and has no odometry,
filter or covariance of its own. *Points kept*: without the time for the points of the map;
*ours by it*: ratio of processor times, median/95 %."""
STAGES = """## Stages and their floor

The floor of a stage is the processor time inside of OpenCV functions that it calls, in another replay of the same
run; the ratio is that of the sums over all frames. Estimator and smoother (iSAM2) have no such floor. Decoding
is measured by the clock alone. What the anchor takes beside it:
[decision 075](decisions/075-a-frame-is-halved-before-it-is-rectified.md#left)."""

Table = list[list[str]]  # the first row is the head


def write_page(path: Path, result: dict[str, Any]) -> None:
    """Writes the page ``path`` and images/PICTURE beside it. Raises OutputError."""
    images = path.parent / "images"
    try:
        images.mkdir(parents=True, exist_ok=True)
        path.write_text(page(result), encoding="utf-8")
        (images / PICTURE).write_text(picture(result), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --page") from None


def page(result: dict[str, Any]) -> str:
    machine = result["machine"]
    load = " and ".join(f"{machine[f'load_average_{when}'][0]:.1f}" for when in ("before", "after"))
    parts = [HEAD.format(cpu=machine["cpu"], cores=machine["cores"], load=load, picture=PICTURE)]
    for name, flight in result["flights"].items():
        parts += [f"**{name}**", markdown(comparison_table(flight))]
        parts += [f"Not measured: {what}." for what in flight["missing"]]
    parts.append(STAGES)
    for name, flight in result["flights"].items():
        run = next(iter(flight["runs"].values()))
        parts += [f"**{name}**", markdown(stage_table(flight)), first_frame(run)]
    if "growth" in result:
        parts += ["## As the map grows", markdown(scaling.map_table(result["growth"]))]
        parts += ["## As the flight grows", markdown(scaling.flight_table(result["growth"]))]
    parts += [f"Not measured: {what}." for what in result["missing"]]
    return "\n\n".join(parts) + "\n"


def first_frame(run: dict[str, Any]) -> str:
    return (
        f"First frame {run['first_frame_cpu_ms']:.0f} ms of the processor, start-up {run['start_up_s']:.1f} s by the "
        f"clock, {run['peak_memory_mb']:.0f} MB."
    )


def markdown(table: Table) -> str:
    head, *rows = table
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---", *["---:"] * (len(head) - 1)], *rows))


def comparison_table(flight: dict[str, Any]) -> Table:
    table = [["", "within 20 m", "processor time", "... points kept", "ours by it", "frames with the model"]]
    for row in compared(flight):
        found, ratio = (
            f"{row.found}/{row.frames}",
            "-" if row.ratio is None else "/".join(f"{r:.2f}" for r in row.ratio),
        )
        times = spread_text(row.cpu_ms), spread_text(row.kept_ms)
        table.append([row.name, found, *times, ratio, percent_text(row.model_rate)])
    return table


def stage_table(flight: dict[str, Any]) -> Table:
    run, floor = next(iter(flight["runs"].values())), flight["floor"]
    table = [["", "by the clock", "processor", "floor: kernels", "stage / floor", "kernels, mean ms"]]
    for stage, wall_ms in run["stage_ms"].items():
        own = floor.get(stage, {})
        kernels = sorted(own.get("kernels", {}).items(), key=lambda item: -item[1]["cpu_ms"])
        words = ", ".join(f"{group} {one['cpu_ms']:.1f}" for group, one in kernels if one["cpu_ms"] >= 0.05)
        ratio = f"{own['ratio']:.2f}" if own.get("ratio") else "-"
        inside = spread_text(own["kernel_cpu_ms"]) if own.get("ratio") else "-"
        table.append([stage, spread_text(wall_ms), spread_text(run["stage_cpu_ms"].get(stage)), inside, ratio, words])
    table.append(["whole frame", spread_text(run["frame_ms"]), spread_text(run["cpu_ms"]), "-", "-", ""])
    return table


@dataclass(frozen=True)
class Bar:
    """``part_ms``: from and to, of the part in another colour."""

    name: str
    ms: float
    text: str
    colour: str
    part_ms: tuple[float, float] = (0.0, 0.0)
    part_colour: str = FLOOR


def picture(result: dict[str, Any]) -> str:
    """SVG: for each flight the processor time of each method with the frames that it finds, and of each stage."""
    marks: list[str] = []
    y = 0
    for name, flight in result["flights"].items():
        methods = [_method_bar(row, row.cpu_ms["median"]) for row in compared(flight) if row.cpu_ms]
        note = "pale: points of the map, which a system could keep"
        y = _chart(marks, y, f"{name}: processor time of a frame, and frames within 20 m", note, methods)
        run = next(iter(flight["runs"].values()))
        stages = [_stage_bar(stage, one["median"], flight) for stage, one in run["stage_cpu_ms"].items()]
        y = _chart(marks, y, f"{name}: processor time of a frame by stage", "dark: inside of kernels", stages)
    style = f"text{{font:13px sans-serif;fill:{INK}}} .title{{font-size:15px;font-weight:bold}} .note{{fill:{FAINT}}}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y}" width="{WIDTH}" height="{y}">'
        f'<style>{style}</style><rect width="{WIDTH}" height="{y}" fill="#ffffff"/>{"".join(marks)}</svg>\n'
    )


def _method_bar(row: Row, ms: float) -> Bar:
    colour = OURS if row.ours else PEER
    kept_ms = ms if row.kept_ms is None else row.kept_ms["median"]
    return Bar(row.name, ms, f"{ms:.0f} ms, {row.found} of {row.frames}", colour, (kept_ms, ms), PALE)


def _stage_bar(stage: str, ms: float, flight: dict[str, Any]) -> Bar:
    own = flight["floor"].get(stage, {})
    if not own.get("ratio"):
        return Bar(stage, ms, f"{ms:.0f} ms", OURS)
    inside_ms = min(own["kernel_cpu_ms"]["median"], ms)
    return Bar(stage, ms, f"{ms:.0f} ms, {own['ratio']:.2f} x the floor", OURS, (0.0, inside_ms))


def _chart(marks: list[str], top: int, title: str, note: str, bars: list[Bar]) -> int:
    """Adds a bar chart below ``top``. -> its lower end."""
    per_ms = BARS / max(*(bar.ms for bar in bars), 1e-3)
    marks.append(f'<text class="title" x="16" y="{top + 32}">{escape(title)}</text>')
    y = top + TOP
    for bar in bars:
        end, (low, high) = GUTTER + bar.ms * per_ms, bar.part_ms
        marks.append(f'<text x="{GUTTER - 10}" y="{y + 13}" text-anchor="end">{escape(bar.name)}</text>')
        marks.append(_rectangle(GUTTER, end, y, bar.colour))
        marks.append(_rectangle(GUTTER + low * per_ms, GUTTER + high * per_ms, y, bar.part_colour))
        marks.append(f'<text x="{end + 8:.1f}" y="{y + 13}">{escape(bar.text)}</text>')
        y += ROW
    marks.append(f'<text class="note" x="{GUTTER}" y="{y + 14}">{escape(note)}</text>')
    return y + BELOW


def _rectangle(left: float, right: float, y: int, colour: str) -> str:
    return f'<rect x="{left:.1f}" y="{y}" width="{right - left:.1f}" height="{ROW - 6}" fill="{colour}"/>'
