// A new flight: photos, camera, map and start; then the upload, which goes on beside the flight's own view. What the photos
// or a flight.toml state fills the form, each value with where it comes from; what is typed wins.

import {get, photoFacts, post} from "./api.js";
import {fill, h} from "./dom.js";
import {baseMap, L} from "./map_view.js";
import {number} from "./format.js";
import {dropped, sorted} from "./photos.js";
import {t} from "./texts.js";
import {words} from "./words.js";
import {BATCH, readTable, startUpload} from "./upload.js";

/** So many of a list as may be asked about, from the first to the last. */
const spread = (list, most) => (list.length <= most ? list : Array.from({length: most}, (_, i) => list[Math.round(i * (list.length - 1) / (most - 1))]));

export class NewView {
  /** ``copied``: id of a flight whose images are computed again; undefined: photos are chosen. */
  constructor(main, copied) {
    Object.assign(this, {main, copied, given: {}, photos: [], tableText: null, notes: {}});
  }

  async open() {
    const [{maps}, {service}, old] = await Promise.all([get("/maps"), get("/config"), this.copied ? get(`/flights/${this.copied}`) : null]);
    this.maps = maps;
    this.wrong = h("p", {class: "error", role: "alert"});
    const form = h("form", {class: "page new", onsubmit: (event) => this.submit(event)}, h("h1", {}, t(old ? "copy_flight" : "new_flight")),
      this.photosPart(old), this.cameraPart(), this.placePart(service.areas),
      this.wrong, h("p", {}, h("button", {class: "primary", disabled: !this.maps.length && !service.areas}, t(old ? "compute_again" : "create_and_upload"))));
    if (!old) this.takeDrops(form);
    fill(this.main, form);
    if (old) this.fillFrom(await this.spec(), t("from_copied"));
    if (this.maps.length) this.showMap();
    for (const input of [this.lat, this.lon]) input.addEventListener("change", () => this.mark());
  }

  // --- parts ---------------------------------------------------------------------------------------

  /** A labelled number with a line that says where it comes from. */
  field(id, attributes = {}) {
    const note = h("span", {class: "from", id: `from-${id}`});
    const input = h("input", {id: `f-${id}`, type: "number", step: "any", inputmode: "decimal", "aria-describedby": `from-${id}`, ...attributes});
    input.addEventListener("input", () => { note.textContent = t("by_hand"); });
    this[id] = input;
    this.notes[id] = note;
    return h("div", {class: "field"}, h("label", {for: `f-${id}`}, t(`f_${id}`)), input, note);
  }

  chooser(id, attributes) {
    const input = h("input", {id: `f-${id}`, type: "file", multiple: true, class: "unseen", onchange: () => this.take(input.files), ...attributes});
    return [input, h("label", {class: "button", for: `f-${id}`}, t(`f_${id}`))];
  }

  photosPart(old) {
    this.complete = h("input", {id: "f-complete", type: "checkbox", checked: true});
    this.chosen = h("p", {role: "status"}, old ? t("copied_photos", number(old.images.uploaded), old.name) : t("drop_here"));
    this.facts = h("details", {hidden: true});
    return h("fieldset", {class: "drop"}, h("legend", {}, t("photos")), old ? null : [h("p", {class: "soft"}, t("photos_why", BATCH[0])),
      h("div", {class: "actions"}, this.chooser("images", {accept: "image/jpeg,image/png,.zip,.toml,.csv"}), this.chooser("folder", {webkitdirectory: true}))],
      this.chosen, this.facts, this.field("name", {type: "text", maxlength: 100, inputmode: "text"}),
      old ? null : h("label", {class: "check"}, this.complete, h("span", {}, t("f_complete"))));
  }

  cameraPart() {
    return h("fieldset", {}, h("legend", {}, t("camera")), h("div", {class: "fields"},
      this.field("width", {min: 640, max: 6252, required: true}), this.field("height", {min: 480, max: 4168, required: true}),
      this.field("fx", {min: 1}), this.field("focal_mm", {min: 0.1}), this.field("sensor_width_mm", {min: 0.1}),
      this.field("pitch_deg", {value: -90, min: -90, max: 0}), this.field("mount_yaw_deg", {value: 0}), this.field("tolerance_deg", {value: 10, min: 1, max: 90})));
  }

  /** Map, or route whose map is fetched, and start. */
  placePart(areas) {
    this.map = h("select", {id: "f-map", onchange: () => this.showMap()}, this.maps.map((one) => h("option", {value: one.name}, one.name)));
    this.route = h("textarea", {id: "f-route", rows: 3, spellcheck: "false", placeholder: "48.1372, 11.5755"});
    this.picture = h("div", {class: "pick-map"});
    const corridor = h("div", {class: "fields"}, this.field("corridor_m", {value: 1000, min: 100, max: 20000}));
    return h("fieldset", {}, h("legend", {}, t("map_and_start")), this.maps.length
      ? h("div", {class: "field"}, h("label", {for: "f-map"}, t("map")), this.map) : h("p", {class: areas ? "soft" : "error"}, t("no_maps")),
      areas ? [h("p", {class: "soft"}, t("route_why")), h("div", {class: "field"}, h("label", {for: "f-route"}, t("f_route")), this.route), corridor] : [],
      h("p", {class: "soft"}, t("start_why")), this.picture, h("div", {class: "fields"},
        this.field("lat", {min: -90, max: 90}), this.field("lon", {min: -180, max: 180}), this.field("sigma_m", {value: 10, min: 0.1}),
        this.field("agl_m", {min: 1}), this.field("yaw_deg", {min: 0, max: 360})));
  }

  takeDrops(form) {
    form.addEventListener("dragover", (event) => { event.preventDefault(); form.classList.add("over"); });
    form.addEventListener("dragleave", () => form.classList.remove("over"));
    form.addEventListener("drop", (event) => {
      event.preventDefault();
      form.classList.remove("over");
      dropped(event.dataTransfer).then((files) => this.take(files));
    });
  }

  close() {
    this.leaflet?.remove();
  }

  showMap() {
    this.leaflet?.remove();
    this.leaflet = baseMap(this.picture, this.maps.find((one) => one.name === this.map.value));
    L.control.zoom({zoomInTitle: t("zoom_in"), zoomOutTitle: t("zoom_out")}).addTo(this.leaflet);
    this.leaflet.on("click", ({latlng}) => {
      this.put("lat", latlng.lat.toFixed(6), t("by_hand"));
      this.put("lon", latlng.lng.toFixed(6), t("by_hand"));
      this.mark();
    });
    this.marker = null;
    this.mark();
  }

  mark() {
    this.marker?.remove();
    this.marker = null;
    if (!this.leaflet || this.lat.value === "" || this.lon.value === "") return;
    this.marker = L.circleMarker([+this.lat.value, +this.lon.value], {radius: 8, color: "#0a0e12", fillColor: "#ffe14d", fillOpacity: 1, weight: 3});
    this.marker.addTo(this.leaflet);
  }

  // --- what is given -------------------------------------------------------------------------------

  /** A value with where it comes from; undefined and null leave the field as it is. */
  put(id, value, from) {
    if (value === undefined || value === null || value === "") return;
    this[id].value = value;
    this.notes[id].textContent = from;
  }

  async take(files) {
    this.wrong.textContent = "";
    try {
      const found = await sorted(files);
      if (!found.photos.length) throw new Error(t("no_photos"));
      Object.assign(this, {photos: found.photos, tableText: found.table});
      const names = found.photos.map((photo) => photo.name);
      this.chosen.textContent = [t("chosen", number(names.length), names[0], names.at(-1)), found.table === null ? "" : "frames.csv", found.description === null ? "" : "flight.toml"].filter(Boolean).join(" · ");
      const facts = await photoFacts(spread(found.photos, BATCH[1]), found.description);
      const text = (topic) => facts.facts.filter((fact) => fact.topic === topic).map((fact) => fact.text).join("; ");
      this.fillFrom({...facts, ...facts.camera ?? {}}, (topic) => text(topic).replace(/^.*? from /, "").replace(/, principal.*/, "") || t("from_photos"));
      this.wrong.textContent = words(facts.problem);
      for (const [id, topic, value] of [["agl_m", "height", facts.height_m], ["yaw_deg", "heading", facts.yaw_deg]]) {
        this[id].value = "";
        this[id].placeholder = value ?? "";
        const inTable = found.table?.split(/\r?\n/, 1)[0].split(",").includes(id);
        this.notes[id].textContent = inTable ? t("from_table") : value === null ? t("not_stated") : text(topic);
      }
      this.facts.hidden = false;
      fill(this.facts, h("summary", {}, t("stated")), h("dl", {class: "pairs"}, facts.facts.map((fact) => [h("dt", {}, t(`topic_${fact.topic.replaceAll(" ", "_")}`)), h("dd", {}, fact.text)])));
      this.mark();
    } catch (error) {
      this.wrong.textContent = error.message;
    }
  }

  /** What the flight is created with if nothing is changed. ``from``: a text, or a function of a topic. */
  fillFrom(spec, from) {
    const whence = (topic) => (typeof from === "function" ? from(topic) : from);
    this.given = spec;
    const {camera, mount, start} = spec;
    this.put("name", spec.name, whence("name"));
    this.put("width", camera?.width ?? spec.width, whence("size"));
    this.put("height", camera?.height ?? spec.height, whence("size"));
    for (const id of ["fx", "focal_mm", "sensor_width_mm"]) this.put(id, camera?.[id], whence("camera"));
    this.put("pitch_deg", mount?.pitch_deg, whence("mount"));
    this.put("mount_yaw_deg", mount?.yaw_deg, whence("mount"));
    this.put("tolerance_deg", mount?.tolerance_deg, whence("mount"));
    for (const id of ["lat", "lon", "sigma_m"]) this.put(id, start?.[id], whence("start"));
    if (this.maps.some((one) => one.name === spec.map)) this.map.value = spec.map;
  }

  async spec() {
    const {flight} = await get(`/flights/${this.copied}/config`);
    this.put("agl_m", flight.height_m, t("from_copied"));
    this.put("yaw_deg", flight.yaw_deg, t("from_copied"));
    return flight;
  }

  // --- what is sent --------------------------------------------------------------------------------

  body() {
    const value = (input) => (input.value === "" ? undefined : Number(input.value));
    const typed = (...ids) => ids.some((id) => this.notes[id].textContent === t("by_hand"));
    const {camera, mount, telemetry, start, override} = this.given;
    const focal = this.fx.value !== "" ? {fx: value(this.fx)} : {focal_mm: value(this.focal_mm), sensor_width_mm: value(this.sensor_width_mm)};
    const lat = value(this.lat);
    const lon = value(this.lon);
    return {
      name: this.name.value.trim(),
      camera: camera && !typed("width", "height", "fx", "focal_mm", "sensor_width_mm") ? camera : {width: value(this.width), height: value(this.height), ...focal},
      mount: {...mount, yaw_deg: value(this.mount_yaw_deg) ?? 0, pitch_deg: value(this.pitch_deg) ?? -90, tolerance_deg: value(this.tolerance_deg) ?? 10},
      telemetry: telemetry ?? undefined,
      start: lat === undefined || lon === undefined ? undefined : {...typed("lat", "lon") ? {} : start, lat, lon, sigma_m: value(this.sigma_m) ?? 10},
      ...this.mapOrArea(),
      height_m: value(this.agl_m),
      yaw_deg: value(this.yaw_deg),
      override: typed("agl_m", "yaw_deg") || Boolean(override),
      images: this.complete.checked && this.photos.length ? this.photos.length : undefined,
    };
  }

  /** The route, if there is one, else the map. */
  mapOrArea() {
    const lines = this.route.value.split("\n").map((line) => line.trim()).filter(Boolean);
    if (!lines.length) return this.given.area ? {area: this.given.area} : {map: this.map.value};
    const waypoints = lines.map((line) => {
      const [lat, lon] = line.split(/[,;\s]+/).map(Number);
      if (!Number.isFinite(lat) || !Number.isFinite(lon)) throw new Error(t("bad_waypoint", line));
      return {lat, lon};
    });
    return {area: {waypoints, corridor_m: Number(this.corridor_m.value)}};
  }

  async submit(event) {
    event.preventDefault();
    this.wrong.textContent = "";
    try {
      if (!this.copied && this.photos.length < BATCH[0]) throw new Error(t("too_few", BATCH[0]));
      if (this.fx.value === "" && (this.focal_mm.value === "" || this.sensor_width_mm.value === "")) throw new Error(t("no_focal"));
      const table = this.tableText === null ? null : readTable(this.tableText, this.photos);
      const flight = await post(this.copied ? `/flights/${this.copied}/copy` : "/flights", this.body());
      if (!this.copied) startUpload(flight.flight_id, this.photos, table);
      location.hash = `#/flight/${flight.flight_id}`;
    } catch (error) {
      this.wrong.textContent = error.message;
    }
  }
}
