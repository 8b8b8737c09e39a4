"""The section of the worst moments: a list with links, then each with frame, map, matches and reasons."""

import shlex
from pathlib import Path

from terrafix.core.geodesy import LocalFrame
from terrafix_tools.pages.charts import stamp
from terrafix_tools.pages.document import kit, macros
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.map_crop import open_map
from terrafix_tools.report.moment_picture import Pictures, pictures
from terrafix_tools.report.moment_record import FrameRecord, read_frames, shown_frame
from terrafix_tools.report.moment_text import facts as words_of
from terrafix_tools.report.moments import Moment
from terrafix_tools.report.sections_run import picture_rows

OWN = macros("terrafix_tools/report.html")
AROUND_S = 1.0  # `terrafix log show` of a moment: this much before and after it
RULE = (
    "Chosen by what the record says, in turns: longest loss of the fix, faults, links and processes lost, largest "
    "error (if there is truth: above 20 m, or beyond 3 sigma), measurements farthest beyond their gate, stated 95 % "
    "radius above 122 m. Of a flight that can be trusted rejected measurements alone are no moment."
)


def moments_sections(view: FlightView, moments: list[Moment], map_path: Path | None) -> tuple[str, str]:
    """-> list with links, details. Reads what the record holds of the moments, and the pictures of the page into
    ``view.thumbnails``."""
    shown = [shown_frame(view, moment) for moment in moments]
    needed = {*shown, *(moment.frame_id for moment in moments)}
    frames, view.thumbnails = read_frames(view, needed, picture_rows(view))
    if not moments:
        return "", ""
    blocks = _blocks(view, moments, [frames[frame_id] for frame_id in shown], frames, map_path)
    listed = [(stamp(moment.t_s), _headline(moment)) for moment in moments]
    name = "moment" if len(moments) == 1 else f"{len(moments)} moments"
    return OWN.worst(f"The worst {name}", RULE, listed), kit.section(f"The worst {name} in detail", "", *blocks)


def _blocks(
    view: FlightView,
    moments: list[Moment],
    shown: list[FrameRecord],
    frames: dict[int, FrameRecord],
    map_path: Path | None,
) -> list[str]:
    origin = view.origin
    opened = open_map(map_path, LocalFrame(origin.lat_deg, origin.lon_deg)) if origin is not None else None
    row_of = {frame_id: row for frame_id, row in zip(view.frame_ids, view.rows, strict=False)}
    try:
        blocks = []
        for number, (moment, record) in enumerate(zip(moments, shown, strict=True), 1):
            drawn = None
            if origin is not None and (row := row_of.get(record.frame_id)) is not None:
                compared = view.compared.get(row.file)
                drawn = pictures(
                    record,
                    view.thumbnails.get(record.frame_id),
                    origin,
                    row,
                    compared.truth if compared is not None else None,
                    opened[1] if opened is not None else None,
                )
            blocks.append(_block(view, number, moment, record, frames[moment.frame_id], drawn))
        return blocks
    finally:
        if opened is not None:
            opened[0].close()


def _block(
    view: FlightView, number: int, moment: Moment, shown: FrameRecord, own: FrameRecord, drawn: Pictures | None
) -> str:
    row = view.rows[moment.row]
    return OWN.moment(
        number=number,
        headline=_headline(moment),
        time=stamp(moment.t_s),
        frame=f"frame {moment.frame_id}" + (f" · {row.file}" if row.file else ""),
        row=moment.row,
        reasons=list(moment.reasons.values())[1:],
        pictures=_pair(view, shown, drawn) if drawn is not None else [],
        ratio=drawn.ratio if drawn is not None else 1.0,
        facts=kit.facts(words_of(view, moment, own, shown)),
        commands=_commands(view, moment),
    )


def _pair(view: FlightView, shown: FrameRecord, drawn: Pictures) -> list[tuple[str, str]]:
    """Frame and map: SVG, caption."""
    notes = [f"Frame {shown.frame_id}"]
    if shown.frame_id not in view.thumbnails:
        notes.append("no readable picture of it in the record")
    if drawn.matches is None:
        notes.append("no matches with the map")
    elif drawn.matches.inlier is None:
        notes.append(f"{len(drawn.matches.xy)} matches, without a pose that agrees with them")
    else:
        inliers = int(drawn.matches.inlier.sum())
        notes.append(f"{inliers} matches agree with the pose, {len(drawn.matches.xy) - inliers} do not")
    ground = ["Map, turned like the frame and at its scale" if drawn.has_map else "No map here"]
    ground.append("solid: the frame where the estimate puts it, with its 95 % ellipse")
    if drawn.shows_rejected:
        ground.append("dashed: where the map match that was not used puts it")
    return [(svg, "; ".join(words)) for svg, words in ((drawn.frame, notes), (drawn.ground, ground)) if svg]


def _commands(view: FlightView, moment: Moment) -> str:
    record, at_s = shlex.quote(str(view.folder)), view.log_s(moment.t_s)
    show = f"terrafix log show {record} --from {at_s - AROUND_S:.1f} --to {at_s + AROUND_S:.1f}"
    if view.origin is None or moment.frame_id < 0:
        return show
    camera = view.origin.camera
    pixel = f"{camera.width // 2},{camera.height // 2}"
    return f"{show}\nterrafix locate {record} --frame {moment.frame_id} --pixel {pixel}"


def _headline(moment: Moment) -> str:
    return next(iter(moment.reasons.values()))
