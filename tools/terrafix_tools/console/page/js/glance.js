// The first line of the display: where it is, how sure that is, how old, and what the autopilot has of it.

import {fill, h, svg} from "./dom.js";
import {NONE, clock, coordinate, degrees, metres, number, seconds, unit} from "./format.js";
import {sign} from "./sources.js";
import {t} from "./texts.js";

const FACTS_OLD_MS = 4000; // facts come once a second
const OLD_FIX_S = 5; // of flight, after which the position of an earlier frame is no longer that of the vehicle
const WORRYING_S = 30; // without a map fix: what odometry alone drifts meanwhile is worth a look

function cell(label, value, below, mood = "", extra = null) {
  return h("div", {class: `cell ${mood}`}, h("span", {class: "label"}, label), h("span", {class: "value"}, value, extra), h("span", {class: "below"}, below));
}

/** The facts of a live flight while they are new; null: there are none, or they are old. */
export const freshFacts = (model) => (model.facts && Date.now() - model.factsAt < FACTS_OLD_MS ? model.facts : null);

/** The ellipse itself, north up. */
function ellipseSign(ellipse) {
  const rx = 13;
  const ry = Math.max(1.5, rx * ellipse.semi_minor_m / ellipse.semi_major_m);
  return svg("svg", {viewBox: "0 0 32 32", class: "ellipse-sign", "aria-hidden": "true"},
    svg("path", {d: "M16 0v4M16 28v4M0 16h4M28 16h4", stroke: "currentColor", "stroke-width": 1.5, opacity: 0.5}),
    svg("ellipse", {cx: 16, cy: 16, rx, ry, transform: `rotate(${ellipse.bearing_deg - 90} 16 16)`,
      fill: "currentColor", "fill-opacity": 0.18, stroke: "currentColor", "stroke-width": 2}));
}

export class Glance {
  constructor() {
    this.element = h("section", {class: "glance", "aria-label": t("glance")});
  }

  update(model) {
    const frame = model.newest;
    const fresh = freshFacts(model);
    const stale = model.connection === "lost" || (model.isLive && model.flight.state !== "completed" && model.facts && !fresh);
    this.element.classList.toggle("stale", Boolean(stale));
    if (!frame) {
      fill(this.element, cell(t("position"), NONE, t("no_frames_yet")));
      return;
    }
    const fix = model.newestFix;
    const age = fix ? frame.t_s - fix.t_s : 0; // a frame may have no position: it was left out, or is not placed yet
    const ellipse = fix?.ellipse;
    const digits = ellipse && ellipse.semi_major_m >= 100 ? 0 : 1;
    const cells = [
      fix ? cell(t("position"), coordinate(fix.gps), [sign(fix.source), t(`source_${fix.source || "none"}`), age > 0 ? ` · ${t("ago", seconds(age))}` : ""],
        age > OLD_FIX_S ? "wide bad" : "wide") : cell(t("position"), t("no_position"), frame.error || t(`state_${model.flight.state}`), "wide bad"),
      cell(t("ellipse95"), ellipse ? `${number(ellipse.semi_major_m, digits)} × ${number(ellipse.semi_minor_m, digits)} m` : NONE,
        ellipse ? t("within20", unit(fix.confidence === null ? null : 100 * fix.confidence, 0, "%")) : t("not_known"),
        `ell ${ellipse && ellipse.semi_major_m > 100 ? "warn" : ""}`, ellipse ? ellipseSign(ellipse) : null),
      this.lastMatch(model, fresh),
      cell(t("height"), unit(fix?.agl_m, 0, "m"), t("amsl", unit(fix?.altitude, 0, "m"))),
      cell(t("heading"), degrees(fix?.heading), fresh ? t("speed", unit(fresh.position.speed_mps, 1, "m/s")) : t("true_north")),
    ];
    if (model.isLive && model.flight.state !== "completed") cells.push(this.autopilot(fresh));
    cells.push(cell(t("frame"), number(frame.frame_id), stale ? t("as_of", clock(model.updatedAt ?? model.openedAt)) : this.age(model), stale ? "bad" : ""));
    fill(this.element, cells, stale ? h("strong", {class: "stale-sign"}, t("stale")) : null);
  }

  age(model) {
    if (model.flight.state === "completed") return t("completed_line");
    if (model.updatedAt === null) return t("no_news");
    return t("updated", seconds(Math.max(0, Math.round((Date.now() - model.updatedAt) / 1000))));
  }

  lastMatch(model, fresh) {
    const since = fresh ? fresh.position.since_map_fix_s : model.sinceMatch_s;
    if (since === null || since === undefined) return cell(t("last_match"), NONE, t("no_match_yet"), "warn");
    const search = model.newest.search;
    const below = search && search !== "normal" ? t(`search_${search}`) : model.lastMatch ? t("of_frame", number(model.lastMatch.frame_id)) : "";
    return cell(t("last_match"), since < 0.05 ? t("now") : t("ago", seconds(since)), below, since > WORRYING_S ? "warn" : "");
  }

  autopilot(fresh) {
    if (!fresh) return cell(t("sent_fix"), NONE, t("no_facts"), "bad");
    const {fix, accuracy_m: accuracy, reason} = fresh.position;
    return fix === "3D" ? cell(t("sent_fix"), t("fix_3d"), `± ${metres(accuracy)}`, "good") : cell(t("sent_fix"), t("fix_none"), reason, "bad");
  }
}
