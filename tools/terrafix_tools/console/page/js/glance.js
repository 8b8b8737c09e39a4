// The first lines of the display: what the autopilot has (live) or the verdict (completed), then where it is, how sure
// that is, and how old.

import {FORMATS} from "./coordinates.js";
import {fill, h, svg, toast} from "./dom.js";
import {NONE, clock, coordinate, coordinateFormat, degrees, metres, number, seconds, setCoordinateFormat, unit} from "./format.js";
import {placement, sign} from "./sources.js";
import {t} from "./texts.js";
import {words} from "./words.js";

const FACTS_OLD_MS = 4000; // facts come once a second
const OLD_FIX_S = 5; // of flight, after which the position of an earlier frame is no longer that of the vehicle
const WORRYING_S = 30; // without a map fix: what odometry alone drifts meanwhile is worth a look
const CHI2_95 = 5.991; // two degrees of freedom
const NEAR_M = 20; // of docs/console.md, `confidence`

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

/** Probability that the position is within NEAR_M, by the ellipse that is shown. */
const within20 = (ellipse) => -Math.expm1(-(NEAR_M ** 2) * CHI2_95 / (2 * ellipse.semi_major_m ** 2));

export class Glance {
  /** onFormat(): another way to write positions was chosen. ``format`` and ``copy`` are for the toolbar. */
  constructor(onFormat) {
    this.format = h("select", {class: "format", "aria-label": t("position_format"), title: t("position_format"), onchange: () => {
      setCoordinateFormat(this.format.value);
      onFormat();
    }}, FORMATS.map((one) => h("option", {value: one, selected: one === coordinateFormat()}, t(`format_${one}`))));
    this.copy = h("button", {title: t("copy"), onclick: () => this.copied()}, t("copy_short"));
    this.more = h("button", {class: "more", "aria-expanded": "false", "aria-label": t("more"), title: t("more"), onclick: () => {
      this.more.setAttribute("aria-expanded", String(this.element.classList.toggle("open")));
    }}, "⋯");
    this.cells = h("div", {class: "cells"});
    this.element = h("section", {class: "glance", "aria-label": t("glance")}, this.cells, this.more);
  }

  async copied() {
    try {
      await navigator.clipboard.writeText(this.text);
      toast(t("copied", this.text));
    } catch {
      toast(this.text); // pages over plain http from another computer may not write to the clipboard
    }
  }

  update(model) {
    const frame = model.newest;
    const fresh = freshFacts(model);
    const stale = model.connection === "lost" || (model.isLive && model.flight.state !== "completed" && model.facts && !fresh);
    this.element.classList.toggle("stale", Boolean(stale));
    const fix = model.newestFix;
    this.text = fix ? coordinate(fix.gps, fix.ellipse?.semi_major_m) : "";
    this.copy.disabled = this.format.disabled = !fix;
    const cells = [this.headline(model, fresh), this.position(model)];
    if (frame) {
      const ellipse = fix?.ellipse;
      const digits = ellipse && ellipse.semi_major_m >= 100 ? 0 : 1;
      cells.push(
        cell(t("ellipse95"), ellipse ? `${number(ellipse.semi_major_m, digits)} × ${number(ellipse.semi_minor_m, digits)} m` : NONE,
          ellipse ? t("within20", unit(100 * within20(ellipse), 0, "%")) : t("not_known"),
          ellipse && ellipse.semi_major_m > 100 ? "warn" : "", ellipse ? ellipseSign(ellipse) : null),
        model.flight.state === "completed" ? null : this.lastMatch(model, fresh),
        cell(t("height_heading"), `${unit(fix?.agl_m, 0, "m")} · ${degrees(fix?.heading)}`,
          fresh ? t("speed", unit(fresh.position.speed_mps, 1, "m/s")) : t("amsl", unit(fix?.altitude, 0, "m"))),
        cell(t("frame"), h("span", {class: "name", title: frame.file}, frame.file || number(frame.frame_id)), stale ? t("as_of", clock(model.updatedAt ?? model.openedAt)) : this.age(model), stale ? "bad" : ""));
    }
    fill(this.cells, cells, stale ? h("strong", {class: "stale-sign"}, t("stale")) : null);
  }

  /** What the autopilot has; of a flight that is over the verdict. */
  headline(model, fresh) {
    const {flight} = model;
    if (flight.state === "completed") return flight.verdict ? this.verdict(flight.verdict) : cell(t("whole_verdict"), NONE, t("no_verdict"), "first");
    if (model.isLive) return this.autopilot(fresh);
    if (flight.error) return cell(t("flight"), t("state_failed"), words(flight.error), "first bad");
    if (flight.completing) return cell(t("flight"), t("being_solved"), model.progress ? t(`stage_${model.progress.stage}`) : "", "first");
    const {processed, uploaded} = flight.images;
    return cell(t("flight"), t("images_done", number(processed), number(uploaded)), t(`state_${flight.state}`), "first");
  }

  verdict({verdict, trusted_files: files, trusted_s: spans, reasons, cause}) {
    const mood = {"trust it": "good", "trust it in part": "warn"}[verdict] ?? "bad";
    const named = files.map(([a, b], i) => (a ? `${a} – ${b}` : `${seconds(spans[i][0])} – ${seconds(spans[i][1])}`));
    const only = mood === "warn" ? [t("only_from", named.slice(0, 2).join(", ") + (named.length > 2 ? " …" : ""))] : [];
    const why = [...only, ...reasons.map(words), cause ? t("likely", words(cause)) : ""].filter(Boolean).join(" · ");
    return cell(t("whole_verdict"), t(`whole_${verdict.replaceAll(" ", "_")}`), h("span", {title: why}, why || t("no_doubts")), `first ${mood}`);
  }

  autopilot(fresh) {
    if (!fresh) return cell(t("sent_fix"), NONE, t("no_facts"), "first bad");
    const {fix, accuracy_m: accuracy, reason} = fresh.position;
    return fix === "3D" ? cell(t("sent_fix"), `${t("fix_3d")} ± ${metres(accuracy)}`, t("one_sigma"), "first good")
      : cell(t("sent_fix"), t("fix_none"), words(reason), "first bad");
  }

  position(model) {
    const {newest: frame, newestFix: fix} = model;
    if (!frame) return cell(t("position"), NONE, t("no_frames_yet"), "wide");
    const known = placement(frame);
    if (known === "unknown" && model.flight.state !== "completed") {
      const search = t(frame.search === "normal" ? (frame.error ? "source_none" : "searching") : `search_${frame.search}`);
      const before = fix && fix !== frame ? t("last_known", coordinate(fix.gps, fix.ellipse?.semi_major_m), seconds(frame.t_s - fix.t_s)) : "";
      return cell(t("position"), t("position_unknown"), [search, before].filter(Boolean).join(" · "), "wide bad");
    }
    if (!fix) return cell(t("position"), t("position_unknown"), words(frame.error) || t("source_not_placed"), "wide bad");
    const age = frame.t_s - fix.t_s; // a frame may have no position: it was left out
    const state = placement(fix);
    const how = fix.refined_by === "finalised" ? "by_whole_flight" : state === "propagated" ? `source_${fix.source}` : "source_satellite_anchored";
    return cell(t("position"), this.text, [sign(fix.source), `${t(`is_${state}`)}: ${t(how)}`, age > 0 ? ` · ${t("ago", seconds(age))}` : ""],
      age > OLD_FIX_S || state === "unknown" ? "wide bad" : "wide");
  }

  age(model) {
    if (model.flight.state === "completed") return t("completed_line");
    if (model.updatedAt === null) return t("no_news");
    return t("updated", seconds(Math.max(0, Math.round((Date.now() - model.updatedAt) / 1000))));
  }

  lastMatch(model, fresh) {
    const since = fresh ? fresh.position.since_map_fix_s : model.sinceMatch_s;
    if (since === null || since === undefined) return cell(t("last_match"), NONE, t("no_match_yet"), "warn");
    const below = model.lastMatch ? model.lastMatch.file || t("of_frame", number(model.lastMatch.frame_id)) : "";
    return cell(t("last_match"), since < 0.05 ? t("now") : t("ago", seconds(since)), h("span", {class: "name"}, below), since > WORRYING_S ? "warn" : "");
  }
}
