// The flight asks where a frame was taken: its image and the five best places side by side. A pixel and the place that it
// shows make a user fix; a place alone makes a hint with a radius.

import {post} from "./api.js";
import {fill, h, toast} from "./dom.js";
import {coordinate, number} from "./format.js";
import {FrameView} from "./frame_view.js";
import {square} from "./geo.js";
import {L, baseMap} from "./map_view.js";
import {t} from "./texts.js";
import {words} from "./words.js";

const HINT_M = 500; // default radius of a hint

export class AskView {
  /** ``file``: name of the image; ``heading``: of its top, null: not known. */
  constructor(flight, request, info, file, heading) {
    Object.assign(this, {flight, request, info, heading, pixel: null, place: null, small: []});
    this.frame = new FrameView((at) => { this.pixel = at; this.update(); });
    this.mapBox = h("div", {class: "ask-map", role: "application", "aria-label": t("map")});
    this.line = h("p", {class: "ask-line", role: "status"});
    this.send = h("button", {class: "primary", onclick: () => this.fix()}, t("send_fix"));
    this.radius = h("input", {type: "number", id: "hint-radius", min: 100, max: 100000, step: 100, value: HINT_M});
    this.hint = h("button", {onclick: () => this.coarse()}, t("send_hint"));
    this.tiles = h("ol", {class: "places", "aria-label": t("best_places")});
    this.dialog = h("dialog", {class: "ask", "aria-labelledby": "ask-title"},
      h("header", {}, h("h1", {id: "ask-title"}, t("ask_title", file || number(request.frame_id))), h("button", {onclick: () => this.close(), "aria-label": t("close")}, "×")),
      h("p", {class: "soft"}, t("ask_how")),
      h("div", {class: "ask-panes"}, h("section", {}, h("h2", {}, t("ask_step1")), this.frame.element), h("section", {}, h("h2", {}, t("ask_step2")), this.mapBox)),
      this.tiles,
      h("footer", {}, this.line, h("div", {class: "ask-send"}, this.send, h("span", {class: "or"}, t("or_hint")),
        h("label", {for: "hint-radius"}, t("radius")), this.radius, h("span", {}, "m"), this.hint)));
    this.dialog.addEventListener("close", () => this.remove());
    this.dialog.addEventListener("keydown", (event) => {
      const rank = Number(event.key);
      if (rank >= 1 && rank <= 5 && event.target !== this.radius) this.choose(rank - 1);
    });
    this.mapBox.addEventListener("keydown", (event) => {
      if (event.target === this.mapBox && event.key === "Enter") this.at(this.map.getCenter());
    });
  }

  open() {
    document.body.append(this.dialog);
    this.dialog.showModal();
    const {frame_id: frame, image_url: url, candidate_tiles: places} = this.request;
    this.frame.show(url ?? `/flights/${this.flight.flight_id}/frames/${frame}/image`, t("frame_alt", number(frame)), this.heading);
    this.frame.turn(true);
    this.map = baseMap(this.mapBox, this.info);
    L.control.zoom({zoomInTitle: t("zoom_in"), zoomOutTitle: t("zoom_out")}).addTo(this.map);
    L.control.scale({imperial: false}).addTo(this.map);
    this.map.on("click", ({latlng}) => this.at(latlng));
    this.mapBox.append(h("div", {class: "map-cross", "aria-hidden": "true"}));
    this.showPlaces(places);
    this.update();
    this.frame.focus();
  }

  /** The best places, which may come after the request itself. */
  showPlaces(places) {
    this.squares?.remove();
    const look = {color: "#fff", weight: 2, dashArray: "5 5", fill: false, interactive: false};
    this.squares = L.layerGroup(places.map((place) => L.rectangle(square(place.gps, place.half_size_m), look))).addTo(this.map);
    for (const {map} of this.small) map.remove();
    fill(this.tiles, places.length ? null : h("li", {class: "soft"}, t("no_places")));
    this.small = places.map((place, i) => this.thumbnail(place, i));
  }

  /** One of the best places, as a small map that can be chosen. */
  thumbnail(place, i) {
    const box = h("div", {class: "thumb"});
    const button = h("button", {class: "place", "aria-pressed": "false", onclick: () => this.choose(i)},
      h("span", {class: "rank"}, String(place.rank)), box, h("span", {class: "mono"}, coordinate(place.gps)));
    this.tiles.append(h("li", {}, button));
    const still = {dragging: false, keyboard: false, scrollWheelZoom: false, doubleClickZoom: false, touchZoom: false, boxZoom: false, attributionControl: false};
    const map = baseMap(box, this.info, {...still, zoomSnap: 0});
    box.removeAttribute("tabindex");
    map.fitBounds(square(place.gps, place.half_size_m), {animate: false});
    return {button, map, place};
  }

  choose(i) {
    if (!this.small[i]) return;
    this.small.forEach(({button}, j) => button.setAttribute("aria-pressed", String(i === j)));
    const {place} = this.small[i];
    this.map.fitBounds(square(place.gps, place.half_size_m), {animate: false});
  }

  at(latlng) {
    this.place = {lat: latlng.lat, lon: latlng.wrap().lng};
    this.marker?.remove();
    this.marker = L.circleMarker([this.place.lat, this.place.lon], {radius: 9, color: "#0a0e12", weight: 3, fillColor: "#ffe14d", fillOpacity: 0.9, interactive: false});
    this.marker.addTo(this.map);
    this.update();
  }

  update() {
    const pixel = this.pixel ? `${number(this.pixel.u)}, ${number(this.pixel.v)}` : null;
    this.line.textContent = pixel && this.place ? t("ask_ready", pixel, coordinate(this.place))
      : pixel ? t("ask_need_place", pixel) : this.place ? t("ask_need_pixel", coordinate(this.place)) : t("ask_need_both");
    this.send.disabled = !(this.pixel && this.place);
    this.hint.disabled = !this.place;
  }

  fix() {
    return this.answer("user-fix", {frame_id: this.request.frame_id, pixel: this.pixel, ...this.place});
  }

  coarse() {
    return this.answer("hint", {...this.place, radius_m: Number(this.radius.value) || HINT_M});
  }

  async answer(path, body) {
    this.send.disabled = this.hint.disabled = true;
    try {
      const {detail} = await post(`/flights/${this.flight.flight_id}/${path}`, body);
      this.onSent?.(path, body);
      this.close();
      toast(t("fix_sent", words(detail)));
    } catch (error) {
      this.update();
      this.line.textContent = error.message;
    }
  }

  close() {
    this.dialog.close();
  }

  remove() {
    if (!this.dialog.isConnected) return;
    this.map.remove();
    this.small.forEach(({map}) => map.remove());
    this.dialog.remove();
    this.onClosed?.();
  }
}

