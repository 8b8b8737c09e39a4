// One flight: the first line, the map with the track, the frame, and the tabs.

import {allResults, get, post} from "./api.js";
import {AskView} from "./ask_view.js";
import {fill, h, say, toast} from "./dom.js";
import {clock, coordinate, metres, number, seconds} from "./format.js";
import {FrameView} from "./frame_view.js";
import {Glance} from "./glance.js";
import {stateBadge} from "./list_view.js";
import {MapView} from "./map_view.js";
import {FlightModel} from "./model.js";
import {ExportPanel, LogPanel, ObjectPanel, OverviewPanel, VehiclePanel, VerdictPanel} from "./panels.js";
import {mayAct} from "./session.js";
import {SOURCES, sign} from "./sources.js";
import {EventStream} from "./stream.js";
import {t} from "./texts.js";
import {words} from "./words.js";
import {compareNames, sorted} from "./photos.js";
import {BATCH, readTable, startUpload, uploads} from "./upload.js";

const EARLIER_EVENTS = 1000; // that are read again when a flight is opened: the logs keep as many
const REFRESH_MS = 1000; // between two readings of the flight itself, and of live images
const TICK_MS = 500; // ages are shown anew

export class FlightView {
  constructor(main, middle, flightId) {
    Object.assign(this, {main, middle, flightId, selected: null, dirty: false, refreshAt: 0, timers: []});
  }

  async open() {
    const flight = await get(`/flights/${this.flightId}`);
    const [results, maps, config] = await Promise.all([allResults(this.flightId, true), get("/maps"), get(`/flights/${this.flightId}/config`)]);
    this.mountYaw = config.flight.mount?.yaw_deg;
    if (this.closed) return;
    this.info = maps.maps.find((one) => one.name === flight.map.name) ?? null;
    this.model = new FlightModel(flight, results);
    document.title = `${flight.name || flight.flight_id} · Terrafix`;
    this.build();
    const after = flight.request ? 0 : Math.max(0, flight.last_event_id - EARLIER_EVENTS);
    this.stream = new EventStream(this.flightId, after, (event) => this.event(event), (state, status) => this.connection(state, status));
    this.timers = [setInterval(() => this.tick(), TICK_MS)];
    this.draw();
  }

  close() {
    this.closed = true;
    this.stream?.close();
    this.timers.forEach(clearInterval);
    this.mapView?.destroy();
    this.ask?.close();
    document.body.classList.remove("is-lost");
  }

  // --- parts ---------------------------------------------------------------------------------------

  build() {
    this.glance = new Glance(() => this.draw());
    this.lost = h("p", {class: "banner lost", role: "alert", hidden: true});
    this.asking = h("div", {class: "banner ask-banner", role: "alert", hidden: true});
    this.problem = h("p", {class: "banner failed", role: "alert", hidden: true});
    this.through = h("div", {class: "banner through", role: "status", hidden: true});
    this.mapBox = h("div", {class: "map", role: "application", "aria-label": t("map_help")});
    const main = h("div", {class: "flight"}, this.lost, this.problem, this.asking, this.through, this.glance.element,
      h("div", {class: "stage"}, this.mapBox, this.tools(), this.legend(), this.info ? null : h("p", {class: "no-map"}, t("no_such_map", this.model.flight.map.name))),
      h("aside", {class: "side", "aria-label": t("details")}, this.frameCard(), this.uploadSlot = h("div", {}), this.tabs()));
    fill(this.main, main);
    this.mapView = new MapView(this.mapBox, this.info, (id) => this.select(id));
    this.mapView.onFollow = () => this.followButton.setAttribute("aria-pressed", "false");
    this.mapView.map.on("resize", () => { this.dirty = true; }); // what it has to show is fitted anew
    this.mapView.onMeasure = (text) => { this.measured.textContent = text; };
  }

  tools() {
    const toggle = (text, on, act) => {
      const button = h("button", {"aria-pressed": String(on)}, text);
      button.addEventListener("click", () => {
        const now = button.getAttribute("aria-pressed") !== "true";
        button.setAttribute("aria-pressed", String(now));
        act(now);
      });
      return button;
    };
    this.measured = h("span", {class: "unseen", role: "status"});
    this.followButton = toggle(t("follow"), true, (on) => { this.mapView.follow = on; this.draw(); });
    this.measureButton = toggle(t("measure"), false, (on) => {
      this.mapView.measure(on);
      if (on) { toast(t("measure_how")); this.mapBox.focus(); }
    });
    this.escape = (event) => {
      if (event.key === "Escape" && this.measureButton.getAttribute("aria-pressed") === "true") this.measureButton.click();
    };
    this.mapBox.addEventListener("keydown", this.escape);
    return h("div", {class: "tools", role: "toolbar", "aria-label": t("tools")}, this.followButton,
      h("button", {onclick: () => this.mapView.fit()}, t("fit")),
      toggle(t("all_ellipses"), true, (on) => { this.mapView.track.all = on; this.mapView.track.redraw(); }), this.measureButton,
      this.glance.format, this.glance.copy, this.measured);
  }

  legend() {
    return h("ul", {class: "legend", "aria-label": t("legend")}, Object.keys(SOURCES).map((name) => h("li", {}, sign(name), t(`source_${name}`))));
  }

  frameCard() {
    this.frame = new FrameView((at) => this.locate(at));
    this.frameTitle = h("strong", {});
    this.frameFacts = h("p", {class: "frame-facts"});
    this.newestButton = h("button", {onclick: () => this.select(null), "aria-pressed": "true"}, t("newest"));
    const step = (by) => () => this.step(by);
    this.card = h("section", {class: "card frame-card", "aria-label": t("frame")},
      h("header", {}, this.frameTitle, h("span", {class: "group"},
        h("button", {onclick: step(-1), "aria-label": t("previous"), title: t("previous")}, "‹"),
        h("button", {onclick: step(1), "aria-label": t("next"), title: t("next")}, "›"), this.newestButton,
        h("button", {onclick: () => this.enlarge(), "aria-label": t("enlarge"), title: t("enlarge")}, "⤢"))),
      this.frame.element, this.frameFacts);
    this.card.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.card.classList.contains("large")) this.enlarge();
    });
    return this.card;
  }

  enlarge() {
    this.card.classList.toggle("large");
    this.frame.focus();
  }

  tabs() {
    this.objects = new ObjectPanel();
    this.panels = {overview: new OverviewPanel(this.actions()), ...(this.model.isLive ? {vehicle: new VehiclePanel()} : {}),
      verdicts: new VerdictPanel(), log: new LogPanel(), objects: this.objects, export: new ExportPanel(`/flights/${this.flightId}`)};
    const names = Object.keys(this.panels);
    const list = h("div", {class: "tabs", role: "tablist"});
    const show = (name, focus = false) => {
      this.tab = name;
      for (const one of names) {
        const tab = list.children[names.indexOf(one)];
        tab.setAttribute("aria-selected", String(one === name));
        tab.tabIndex = one === name ? 0 : -1;
        this.panels[one].element.hidden = one !== name;
      }
      if (focus) list.children[names.indexOf(name)].focus();
      this.dirty = true;
      if (name === "export") this.panels.export.list();
    };
    this.showTab = show;
    names.forEach((name) => {
      list.append(h("button", {role: "tab", id: `tab-${name}`, "aria-controls": `panel-${name}`, onclick: () => show(name)}, t(`tab_${name}`)));
      const {element} = this.panels[name];
      element.id = `panel-${name}`;
      element.setAttribute("role", "tabpanel");
      element.setAttribute("aria-labelledby", `tab-${name}`);
      element.classList.add("panel");
    });
    list.addEventListener("keydown", (event) => {
      const by = {ArrowRight: 1, ArrowLeft: -1}[event.key];
      if (by) show(names[(names.indexOf(this.tab) + by + names.length) % names.length], true);
    });
    show("overview");
    return h("section", {class: "card tabbed"}, list, names.map((name) => this.panels[name].element));
  }

  actions() {
    if (!mayAct()) return h("p", {class: "soft"}, t("viewer"));
    this.more = h("input", {type: "file", multiple: true, accept: "image/jpeg,image/png,.zip,.csv", class: "unseen", id: "more", onchange: () => this.addPhotos(this.more.files)});
    this.moreLabel = h("label", {class: "button", for: "more"}, t("add_photos"));
    this.completeButton = h("button", {onclick: () => this.complete()}, t("complete"));
    this.askButton = h("button", {onclick: () => this.help()}, t("give_position"));
    const copy = this.model.isLive ? null : h("a", {class: "button", href: `#/new/${this.flightId}`}, t("duplicate"));
    return h("div", {class: "actions"}, this.more, this.moreLabel, this.completeButton, this.askButton, copy);
  }

  // --- what comes ----------------------------------------------------------------------------------

  event(event) {
    if (this.model.apply(event)) this.wantsRefresh = true;
    if (event.name === "user_input_needed" || event.name === "state_changed") this.wantsRefresh = true;
    this.dirty = true;
  }

  connection(state, status) {
    const {model} = this;
    if (status === 404) return void (location.hash = "#/");
    if (status === 401) return void location.reload();
    if (state === "lost" && model.connection !== "lost") {
      model.lostAt = Date.now();
      say(t("lost_said"));
    }
    if (state === "live" && model.connection === "lost") this.wantsRefresh = true;
    model.connection = state;
    document.body.classList.toggle("is-lost", state === "lost");
    this.dirty = true;
  }

  async tick() {
    const now = Date.now();
    if (this.wantsRefresh && now > this.refreshAt && this.model.connection === "live") {
      this.wantsRefresh = false;
      this.refreshAt = now + REFRESH_MS;
      try {
        this.model.refresh(await get(`/flights/${this.flightId}`));
        this.dirty = true;
      } catch { this.wantsRefresh = true; }
      if (this.closed) return;
    }
    const uploading = Boolean(uploads.get(this.flightId)?.running);
    if (this.dirty || uploading !== this.uploading) this.draw();
    else this.glance.update(this.model);
    this.showLost();
    this.drawThrough();
  }

  showLost() {
    const {model} = this;
    this.lost.hidden = model.connection !== "lost";
    if (!this.lost.hidden) this.lost.textContent = t("lost_line", seconds(Math.round((Date.now() - model.lostAt) / 1000)), clock(model.lostAt));
  }

  // --- drawing -------------------------------------------------------------------------------------

  draw() {
    this.dirty = false;
    this.uploading = Boolean(uploads.get(this.flightId)?.running);
    const {model} = this;
    const {flight} = model;
    fill(this.middle, h("h1", {class: "flight-name"}, flight.name || flight.flight_id), stateBadge(flight),
      h("span", {class: `badge link ${model.connection}`}, t(`link_${model.connection}`)));
    this.glance.update(model);
    this.showLost();
    this.problem.hidden = !flight.error;
    this.problem.textContent = words(flight.error);
    this.drawRequest();
    this.drawThrough();
    this.mapView.show(model, this.selected, flight.state !== "completed");
    this.drawFrame();
    this.panels[this.tab].update(model);
    if (this.more) {
      const open = !model.isLive && flight.state !== "completed";
      this.moreLabel.hidden = this.more.hidden = !open;
      this.more.disabled = !open || this.uploading;
      this.completeButton.hidden = !open || flight.completing;
      this.askButton.hidden = flight.state === "completed" || !model.newest;
    }
    fill(this.uploadSlot, uploads.get(this.flightId)?.element);
  }

  drawRequest() {
    const {request} = this.model;
    const key = request ? `${request.request_id}${request.candidate_tiles.length}` : "";
    if (key === this.requestKey) return;
    this.requestKey = key;
    this.asking.hidden = !request;
    if (!request) return void this.mapView.showCandidates([]);
    fill(this.asking, h("span", {}, t("ask_banner", this.model.results.get(request.frame_id)?.file || number(request.frame_id))), mayAct() ? h("button", {class: "primary", onclick: () => this.help()}, t("help")) : null);
    this.mapView.showCandidates(request.candidate_tiles);
    if (this.ask?.request.request_id === request.request_id) this.ask.showPlaces(request.candidate_tiles);
  }

  /** What the flight waits for: the rest of its photos, or the word that they are all; a failure to be tried again. */
  drawThrough() {
    const {flight, isLive, request} = this.model;
    const {uploaded, processed, expected} = flight.images;
    const open = mayAct() && !isLive && flight.state !== "completed" && !flight.completing && !this.uploading;
    const through = open && uploaded > 0 && processed >= uploaded && !flight.error;
    const what = !open ? "" : flight.error ? "failed" : uploaded < (expected ?? 0) ? "resume" : through && request && this.helped ? "helped" : through && !request && !expected ? "through" : "";
    if (this.waits === `${what}${uploaded}`) return;
    this.waits = `${what}${uploaded}`;
    this.through.hidden = !what;
    const button = (text, onclick) => h("button", {class: "primary", onclick}, t(text));
    const complete = uploaded ? button("complete_now", () => this.complete(true)) : null;
    fill(this.through, {
      failed: () => [h("span", {}, t("failed_why")), button("retry", () => this.again("retry"))],
      resume: () => [h("span", {}, t("resume", number(uploaded), number(expected))), h("label", {class: "button", for: "more"}, t("resume_choose")), complete],
      helped: () => [h("span", {}, t("helped")), button("compute_again", () => this.again("copy"))],
      through: () => [h("span", {}, t("through", number(uploaded))), complete],
    }[what]?.() ?? []);
  }

  drawFrame() {
    const {model} = this;
    const result = this.selected === null ? model.newest : model.results.get(this.selected);
    if (!result) {
      this.frame.none(t("no_frames_yet"));
      this.frameTitle.textContent = t("frame");
      return;
    }
    const now = Date.now();
    if (model.isLive && this.selected === null && now - (this.imageAt ?? 0) < REFRESH_MS && this.shown) {
      this.dirty = true; // a newer one follows
      return;
    }
    this.imageAt = now;
    this.shown = result;
    this.frameTitle.textContent = result.file || t("frame_number", number(result.frame_id));
    this.newestButton.setAttribute("aria-pressed", String(this.selected === null));
    this.frame.show(`/flights/${this.flightId}/frames/${result.frame_id}/image`, t("frame_alt", number(result.frame_id)), this.topOf(result));
    const verdict = model.verdicts.findLast((one) => one.frame_id === result.frame_id && one.measurement === "map");
    fill(this.frameFacts, sign(result.source), h("span", {}, t(`source_${result.source || "none"}`)),
      h("span", {}, result.match ? t("match_line", t(`verdict_${result.match}`), result.inliers ? t("inliers", number(result.inliers)) : "") : t("no_match")),
      verdict && verdict.detail ? h("span", {class: "soft"}, words(verdict.detail)) : null, result.file ? h("span", {class: "soft"}, t("frame_number", number(result.frame_id))) : null, result.error ? h("span", {class: "error"}, words(result.error)) : null);
  }

  /** Heading of the top of an image, of a camera that looks down: that of the vehicle and of the mount. */
  topOf(result) {
    return (result?.heading ?? null) === null ? null : (result.heading + (this.mountYaw ?? 0)) % 360;
  }

  select(id) {
    this.selected = id;
    this.shown = null;
    if (id !== null) {
      const {gps} = this.model.results.get(id);
      if (gps) this.mapView.centre(gps);
    }
    this.draw();
  }

  step(by) {
    const ids = [...this.model.results.keys()].sort((a, b) => a - b);
    if (!ids.length) return;
    const at = this.selected === null ? ids.length - 1 : ids.indexOf(this.selected);
    this.select(ids[Math.min(Math.max(at + by, 0), ids.length - 1)]);
  }

  // --- acts ----------------------------------------------------------------------------------------

  async locate(at) {
    if (!mayAct()) return toast(t("viewer"), true);
    const {frame_id: frame} = this.shown;
    try {
      toast(t("locating"));
      const found = await post(`/flights/${this.flightId}/frames/${frame}/object-to-gps`, {pixel_x: at.u, pixel_y: at.v});
      const name = `${t("object")} ${this.objects.rows.length + 1}`;
      this.objects.add({...found, name, frame, pixel: at});
      this.mapView.addObject(`${name} ± ${metres(found.accuracy_meters)}`, found.gps, found.accuracy_meters);
      this.mapView.centre(found.gps);
      this.showTab("objects");
      this.card.classList.remove("large");
      toast(`${name}: ${coordinate(found.gps, found.accuracy_meters)} ± ${metres(found.accuracy_meters)} (95 %)`);
    } catch (error) {
      toast(error.message, true);
    }
  }

  help() {
    if (this.ask) return;
    const request = this.model.request ?? {frame_id: this.shown.frame_id, candidate_tiles: []};
    const result = this.model.results.get(request.frame_id);
    this.ask = new AskView(this.model.flight, request, this.info, result?.file, this.topOf(result));
    this.ask.onClosed = () => { this.ask = null; };
    this.ask.onSent = (path, body) => {
      this.mapView.addMark(body, body.radius_m ?? 5);
      this.helped = true;
      this.dirty = true;
    };
    this.ask.open();
  }

  async complete(sure = false) {
    if (!sure && !confirm(t("complete_sure"))) return;
    try {
      this.model.refresh(await post(`/flights/${this.flightId}/complete`));
      this.draw();
    } catch (error) {
      toast(error.message, true);
    }
  }

  /** Further photos, or the same ones again after an upload that was broken off: those that are there are left out. */
  async addPhotos(files) {
    try {
      const found = await sorted(files);
      this.more.value = "";
      const {last_name: last} = (await get(`/flights/${this.flightId}`)).images;
      const photos = found.photos.filter((photo) => last === null || compareNames(photo.name, last) > 0);
      if (!photos.length) throw new Error(t("all_there", last));
      if (photos.length < BATCH[0]) throw new Error(t("too_few", BATCH[0]));
      const table = found.table === null ? null : readTable(found.table, photos);
      const running = startUpload(this.flightId, photos, table);
      this.draw();
      if (!await running) toast(t("upload_failed"), true);
    } catch (error) {
      toast(error.message, true);
    }
  }

  /** The same flight again, with the positions that were given meanwhile; or what has failed is tried again. */
  async again(path) {
    try {
      const {flight} = path === "copy" ? await get(`/flights/${this.flightId}/config`) : {};
      const made = await post(`/flights/${this.flightId}/${path}`, flight);
      if (path === "retry") this.model.refresh(made);
      else location.hash = `#/flight/${made.flight_id}`;
      this.draw();
    } catch (error) {
      toast(error.message, true);
    }
  }
}
