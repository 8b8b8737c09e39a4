// The tabs beside the map.

import {download, get} from "./api.js";
import {fill, h, toast} from "./dom.js";
import {NONE, bytes, clock, coordinate, metres, number, unit} from "./format.js";
import {freshFacts} from "./glance.js";
import {t} from "./texts.js";
import {words} from "./words.js";

const SHOWN = 200; // lines of a log

const pairs = (rows) => h("dl", {class: "pairs"}, rows.filter(Boolean).map(([label, value, mood]) => [h("dt", {}, label), h("dd", {class: mood ?? ""}, value)]));

function table(heads, rows, empty) {
  if (!rows.length) return h("p", {class: "soft"}, empty);
  return h("div", {class: "scroll", tabindex: 0}, h("table", {}, h("thead", {}, h("tr", {}, heads.map((one) => h("th", {scope: "col"}, one)))),
    h("tbody", {}, rows.map((cells) => h("tr", {}, cells.map((one) => (one instanceof Node && one.tagName === "TD" ? one : h("td", {}, one))))))));
}

/** Says that facts are old, above them. */
const oldFacts = (model) => (freshFacts(model) ? null : h("p", {class: "old"}, t("facts_old", clock(model.factsAt))));

const td = (mood, ...content) => h("td", {class: mood}, ...content);
const percent = (share) => unit(share === null || share === undefined ? null : 100 * share, 0, "%");

export class OverviewPanel {
  constructor(actions) {
    this.actions = actions;
    this.element = h("div", {});
    this.figures = h("div", {});
    this.element.append(this.figures, actions);
  }

  update(model) {
    const {flight, statistics} = model;
    const rows = [
      [t("map"), flight.map.state === "ready" ? flight.map.name : `${flight.map.name} ${t(`map_${flight.map.state}`)} ${flight.map.detail}`, flight.map.state === "failed" ? "bad" : ""],
      model.isLive ? null : [t("images"), t("images_done", number(flight.images.processed), number(flight.images.uploaded))],
      [t("frames_shown"), number(model.results.size)],
      flight.start ? [t("start"), `${coordinate(flight.start, flight.start.sigma_m)} ± ${metres(flight.start.sigma_m)} (1 σ)`] : [t("start"), t(model.isLive ? "live_start" : "no_start")],
    ];
    if (statistics) {
      rows.push([t("localised"), t("of", number(statistics.localised), number(statistics.frames))], [t("refined"), number(statistics.refined)],
        [t("median95"), metres(statistics.median_radius95_m)]);
    }
    const parts = flight.fragments.map((one) => [number(one.fragment_id), `${one.first_frame} – ${one.last_frame}`, number(one.frames),
      one.joined ? t("joined") : td("warn", t("not_joined"))]);
    const source = model.facts?.source;
    const said = source ? [h("h2", {}, t("source_said")), pairs(source.map((one) => [one.topic, one.text]))] : null;
    fill(this.figures, pairs(rows), h("h2", {}, t("fragments")), table([t("fragment"), t("frames"), t("count"), t("tie")], parts, t("none_yet")), said);
  }
}

export class VerdictPanel {
  constructor() {
    this.only = h("input", {type: "checkbox", onchange: () => this.draw()});
    this.list = h("div", {});
    this.element = h("div", {}, h("label", {class: "check"}, this.only, h("span", {}, t("only_rejected"))), this.list);
  }

  update(model) {
    this.model = model;
    this.draw();
  }

  draw() {
    const wanted = this.model.verdicts.filter((one) => !this.only.checked || one.verdict !== "accepted");
    const rows = wanted.slice(-SHOWN).reverse().map((one) => [one.file || number(one.frame_id), t(`measurement_${one.measurement.replaceAll(" ", "_")}`),
      td(one.verdict === "accepted" ? "good" : "bad", one.verdict === "accepted" ? "✓ " : "✕ ", t(`verdict_${one.verdict}`)), number(one.test_ratio, 2), words(one.detail)]);
    fill(this.list, table([t("frame"), t("measurement"), t("verdict"), t("ratio"), t("detail")], rows, t("no_verdicts")));
  }
}

/** What the autopilot is sent and does with it, then the computer, of a live flight. */
export class VehiclePanel {
  constructor() {
    this.element = h("div", {});
  }

  update(model) {
    const {facts} = model;
    fill(this.element, facts ? [oldFacts(model), this.autopilot(facts), this.computer(facts)] : h("p", {class: "soft"}, t("no_facts")));
  }

  autopilot({autopilot, position, texts}) {
    const has = position.fix === "3D";
    const gnss = Object.entries(autopilot.gnss).map(([receiver, one]) => [receiver,
      td(one.state === "spoofed" ? "bad" : one.state === "trusted" ? "good" : "", t(`gnss_${one.state}`)), metres(one.distance_m), words(one.why)]);
    return [h("h2", {}, t("sent_title")), pairs([
      [t("sent_fix"), has ? t("fix_3d") : `${t("fix_none")}: ${words(position.reason)}`, has ? "good" : "bad"],
      [t("accuracy"), has ? `± ${metres(position.accuracy_m)}` : NONE], [t("estimate_age"), unit(position.estimate_age_ms, 0, "ms")],
      [t("degradation"), position.degradation || NONE], [t("covariance"), position.covariance_mode ?? NONE], [t("resets"), number(position.resets)],
      [t("messages"), t("messages_line", number(autopilot.sent), number(autopilot.received), number(autopilot.bad_bytes), number(autopilot.refused))]]),
    h("h2", {}, t("autopilot")), pairs([
      [t("link"), autopilot.connected ? autopilot.autopilot : t("no_autopilot"), autopilot.connected ? "good" : "bad"],
      [t("uses"), autopilot.uses_position === null ? NONE : autopilot.uses_position ? t("yes") : t("no"), autopilot.uses_position === false ? "bad" : ""],
      [t("ekf_ratio"), number(autopilot.position_test_ratio, 2)], [t("ekf_source"), autopilot.position_source ?? NONE]]),
    h("h2", {}, t("gnss")), table([t("receiver"), t("state"), t("distance"), t("why")], gnss, t("no_gnss")),
    texts.length ? [h("h2", {}, t("texts")), h("ul", {class: "lines"}, texts.map((text) => h("li", {}, text)))] : null];
  }

  computer(facts) {
    const {computer} = facts;
    const hot = computer.throttled || computer.band === "critical";
    const processes = facts.processes.map((one) => [one.name, td(one.state === "running" ? "good" : "bad", one.state === "running" ? "● " : "▲ ", t(`process_${one.state.replace(" ", "_")}`)),
      unit(one.idle_s, 1, "s"), percent(one.load), number(one.restarts), one.last_event]);
    const rates = Object.entries(facts.rates_hz).map(([name, rate]) => [name, unit(rate, 1, "Hz")]);
    const dropped = Object.entries(facts.dropped).map(([name, count]) => [name, number(count), "warn"]);
    return [h("h2", {}, t("processes")), table([t("process"), t("state"), t("progress"), t("load"), t("restarts"), t("last_event")], processes, t("none_yet")),
      h("h2", {}, t("heat")), pairs([
        [t("temperature"), [unit(computer.temperature_c, 1, "°C"), computer.band ? ` · ${computer.band}` : ""], hot ? "bad" : ""],
        [t("throttled"), computer.throttled === null ? NONE : computer.throttled ? t("yes") : t("no"), computer.throttled ? "bad" : ""],
        [t("load"), percent(computer.load)], [t("power"), unit(computer.power_w, 1, "W")],
        [t("disk"), computer.disk_free_mb === null ? NONE : bytes(computer.disk_free_mb * 1e6)]]),
      h("h2", {}, t("rates")), pairs([...rates, [t("delay"), unit(facts.delay_ms, 0, "ms")], [t("accepted_share"), percent(facts.map_matches_accepted)]]),
      h("h2", {}, t("dropped")), dropped.length ? pairs(dropped) : h("p", {class: "soft"}, t("nothing_dropped"))];
  }
}

const ofFrame = (d) => d.file || number(d.frame_id);
const LINES = {
  search_expanded: (d) => t("ev_search", ofFrame(d), d.grid_size === null ? t("whole_map") : t("tiles", number(d.grid_size)), t(`searching_${d.status}`)),
  user_input_needed: (d) => t("ev_input", ofFrame(d)),
  processing_blocked: (d) => t("ev_blocked", words(d.reason)),
  chunk_merged: (d) => t("ev_merged", number(d.fragment_id), number(d.frames), ofFrame(d)),
  state_changed: (d) => t("ev_state", t(`state_${d.previous}`), t(`state_${d.state}`)),
  hint_answered: (d) => t("ev_hint", t(`verdict_${d.verdict}`), words(d.text)),
  finalise_progress: (d) => t("ev_finalise", t(`stage_${d.stage}`), d.of === null ? d.done : t("of", d.done, d.of)),
  flight_completed: () => t("ev_completed"),
};

export class LogPanel {
  constructor() {
    this.element = h("div", {});
  }

  update(model) {
    const lines = model.log.slice(-SHOWN).reverse().filter((one) => LINES[one.name]);
    const mood = {processing_blocked: "bad", user_input_needed: "warn"};
    fill(this.element, lines.length
      ? h("ul", {class: "lines"}, lines.map((one) => h("li", {class: mood[one.name] ?? ""}, one.at === null ? null : h("time", {}, clock(one.at), " "), LINES[one.name](one.data))))
      : h("p", {class: "soft"}, t("no_events")));
  }
}

export class ObjectPanel {
  constructor() {
    this.rows = [];
    this.element = h("div", {});
    this.update();
  }

  add(row) {
    this.rows.push(row);
    this.update();
  }

  update() {
    fill(this.element, h("p", {class: "soft"}, t("objects_why")), table([t("fragment"), t("position"), t("accuracy95"), t("altitude"), t("surface")],
      this.rows.map((one, i) => [number(i + 1), td("mono", coordinate(one.gps, one.accuracy_meters)), metres(one.accuracy_meters), unit(one.altitude, 1, "m"), t(`surface_${one.surface}`)]), t("none_yet")));
  }
}

/** ``path``: of the flight. */
export class ExportPanel {
  constructor(path) {
    this.path = path;
    const field = (id) => {
      this[id] = h("select", {id: `export-${id}`});
      return h("div", {class: "field"}, h("label", {for: `export-${id}`}, t(`export_${id}`)), this[id]);
    };
    this.button = h("button", {class: "primary", onclick: () => this.export()}, t("export_now"));
    this.files = h("ul", {class: "lines"});
    this.element = h("div", {}, field("format"), field("which"), h("p", {class: "actions"}, this.button), h("p", {class: "soft"}, t("export_why")),
      h("h2", {}, t("recordings")), this.files);
  }

  update() {}

  /** What there is now. */
  async list() {
    try {
      const [{formats, which}, {files}] = await Promise.all([get(`${this.path}/exports`), get(`${this.path}/recordings`)]);
      for (const [select, names] of [[this.format, formats], [this.which, which]]) {
        if (select.options.length !== names.length) fill(select, names.map((name) => h("option", {value: name}, t(`export_${name}`))));
      }
      fill(this.files, files.length ? files.map((file) => h("li", {}, h("a", {href: file.url, download: file.name}, file.name), ` ${bytes(file.bytes)}`)) : h("li", {class: "soft"}, t("none_yet")));
    } catch (error) {
      fill(this.files, h("li", {class: "soft"}, error.message));
    }
  }

  async export() {
    this.button.disabled = true;
    try {
      toast(t("export_made"));
      toast(t("export_done", await download(`${this.path}/exports/${this.format.value}?which=${this.which.value}`)));
    } catch (error) {
      toast(error.message, true);
    }
    this.button.disabled = false;
  }
}
