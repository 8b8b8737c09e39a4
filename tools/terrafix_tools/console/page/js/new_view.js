// A new flight: photos, camera, map and start; then the upload, which goes on beside the flight's own view.

import {get, post} from "./api.js";
import {fill, h} from "./dom.js";
import {baseMap, L} from "./map_view.js";
import {number} from "./format.js";
import {t} from "./texts.js";
import {BATCH, Upload, inOrder, isSequence, named, readTable} from "./upload.js";

/** Uploads that run, by flight: the view of the flight shows them. */
export const uploads = new Map();

export async function startUpload(flightId, files, table, first) {
  const upload = new Upload(flightId, named(files, first), table);
  uploads.set(flightId, upload);
  try {
    await upload.run();
    return true;
  } catch {
    return false; // the card tells why
  } finally {
    setTimeout(() => { if (uploads.get(flightId) === upload) uploads.delete(flightId); }, 8000);
  }
}

/** Width and height of an image file [px]. */
async function sizeOf(file) {
  const bitmap = await createImageBitmap(file, {imageOrientation: "none"});
  const size = {width: bitmap.width, height: bitmap.height};
  bitmap.close();
  return size;
}

export class NewView {
  constructor(main) {
    this.main = main;
  }

  async open() {
    const [{maps}, {service}] = await Promise.all([get("/maps"), get("/config")]);
    this.maps = maps;
    const field = (id, attributes = {}) => {
      const label = t(`f_${id}`);
      const input = h("input", {id: `f-${id}`, type: "number", step: "any", inputmode: "decimal", ...attributes});
      this[id] = input;
      return h("div", {class: "field"}, h("label", {for: `f-${id}`}, label), input);
    };
    this.map = h("select", {id: "f-map", onchange: () => this.showMap()}, this.maps.map((one) => h("option", {value: one.name}, one.name)));
    this.route = h("textarea", {id: "f-route", rows: 3, spellcheck: "false", placeholder: "48.1372, 11.5755"});
    const area = [h("p", {class: "soft"}, t("route_why")), h("div", {class: "field"}, h("label", {for: "f-route"}, t("f_route")), this.route),
      h("div", {class: "fields"}, field("corridor_m", {value: 1000, min: 100, max: 20000}))];
    this.images = h("input", {id: "f-images", type: "file", multiple: true, required: true, accept: "image/jpeg,image/png", onchange: () => this.read()});
    this.table = h("input", {id: "f-table", type: "file", accept: ".csv,text/csv"});
    this.renumber = h("input", {id: "f-renumber", type: "checkbox"});
    this.chosen = h("p", {class: "soft", role: "status"});
    this.wrong = h("p", {class: "error", role: "alert"});
    this.picture = h("div", {class: "pick-map"});
    const form = h("form", {class: "page new", onsubmit: (event) => this.submit(event)}, h("h1", {}, t("new_flight")),
      h("fieldset", {}, h("legend", {}, t("photos")), h("p", {class: "soft"}, t("photos_why", BATCH[0])),
        h("div", {class: "field"}, h("label", {for: "f-images"}, t("f_images")), this.images), this.chosen,
        h("label", {class: "check"}, this.renumber, h("span", {}, t("f_renumber"))),
        h("div", {class: "field"}, h("label", {for: "f-table"}, t("f_table")), this.table), field("name", {type: "text", maxlength: 100, inputmode: "text"})),
      h("fieldset", {}, h("legend", {}, t("camera")), h("div", {class: "fields"},
        field("width", {min: 640, max: 6252, required: true}), field("height", {min: 480, max: 4168, required: true}),
        field("fx", {min: 1}), field("focal_mm", {min: 0.1}), field("sensor_width_mm", {min: 0.1}),
        field("pitch_deg", {value: -90, min: -90, max: 0}), field("mount_yaw_deg", {value: 0}), field("tolerance_deg", {value: 12, min: 1, max: 90}))),
      h("fieldset", {}, h("legend", {}, t("map_and_start")), this.maps.length
        ? h("div", {class: "field"}, h("label", {for: "f-map"}, t("map")), this.map) : h("p", {class: service.areas ? "soft" : "error"}, t("no_maps")),
        service.areas ? area : [],
      h("p", {class: "soft"}, t("start_why")), this.picture, h("div", {class: "fields"},
        field("lat", {min: -90, max: 90}), field("lon", {min: -180, max: 180}), field("sigma_m", {value: 10, min: 0.1}),
        field("agl_m", {min: 1}), field("yaw_deg", {min: 0, max: 360}))),
      this.wrong, h("p", {}, h("button", {class: "primary", disabled: !this.maps.length && !service.areas}, t("create_and_upload"))));
    fill(this.main, form);
    if (this.maps.length) this.showMap();
    for (const input of [this.lat, this.lon]) input.addEventListener("change", () => this.mark());
  }

  close() {
    this.leaflet?.remove();
  }

  showMap() {
    this.leaflet?.remove();
    this.leaflet = baseMap(this.picture, this.maps.find((one) => one.name === this.map.value));
    L.control.zoom({zoomInTitle: t("zoom_in"), zoomOutTitle: t("zoom_out")}).addTo(this.leaflet);
    this.leaflet.on("click", ({latlng}) => {
      this.lat.value = latlng.lat.toFixed(6);
      this.lon.value = latlng.lng.toFixed(6);
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

  async read() {
    const files = inOrder(this.images.files);
    this.chosen.textContent = files.length ? t("chosen", number(files.length), files[0].name, files.at(-1).name) : "";
    if (!files.length) return;
    this.renumber.checked = !isSequence(files.map((file) => file.name));
    try {
      const {width, height} = await sizeOf(files[0]);
      this.width.value = width;
      this.height.value = height;
    } catch {
      this.wrong.textContent = t("no_image", files[0].name);
    }
  }

  body() {
    const value = (input) => (input.value === "" ? undefined : Number(input.value));
    const focal = this.fx.value !== "" ? {fx: value(this.fx)} : {focal_mm: value(this.focal_mm), sensor_width_mm: value(this.sensor_width_mm)};
    const lat = value(this.lat);
    const lon = value(this.lon);
    return {
      name: this.name.value.trim(),
      camera: {width: value(this.width), height: value(this.height), ...focal},
      mount: {yaw_deg: value(this.mount_yaw_deg) ?? 0, pitch_deg: value(this.pitch_deg) ?? -90, tolerance_deg: value(this.tolerance_deg) ?? 12},
      start: lat === undefined || lon === undefined ? undefined : {lat, lon, sigma_m: value(this.sigma_m) ?? 10},
      ...this.mapOrArea(),
      height_m: value(this.agl_m),
      yaw_deg: value(this.yaw_deg),
    };
  }

  /** The route, if there is one, else the map. */
  mapOrArea() {
    const lines = this.route.value.split("\n").map((line) => line.trim()).filter(Boolean);
    if (!lines.length) return {map: this.map.value};
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
      const files = inOrder(this.images.files);
      if (files.length < BATCH[0]) throw new Error(t("too_few", BATCH[0]));
      if (this.fx.value === "" && (this.focal_mm.value === "" || this.sensor_width_mm.value === "")) throw new Error(t("no_focal"));
      const table = this.table.files.length ? readTable(await this.table.files[0].text(), files) : null;
      const flight = await post("/flights", this.body());
      startUpload(flight.flight_id, files, table, this.renumber.checked ? 1 : null);
      location.hash = `#/flight/${flight.flight_id}`;
    } catch (error) {
      this.wrong.textContent = error.message;
    }
  }
}
