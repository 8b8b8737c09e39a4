// The map with the track: one layer draws all frames on the canvas of Leaflet, so that thousands of them stay fluent.

import {bearing, distance, square} from "./geo.js";
import {coordinate, degrees, metres} from "./format.js";
import {h} from "./dom.js";
import {placement, styleOf, trace} from "./sources.js";
import {t} from "./texts.js";

const L = window.L;
const RAD = Math.PI / 180;
const NEAR_PX = 16; // of a frame, within which a click selects it
const STILL = matchMedia("(prefers-reduced-motion: reduce)");

/** A map over the tiles of one package. ``info``: of GET /maps/{name}; null: the service does not have it. */
export function baseMap(element, info, options = {}) {
  const map = L.map(element, {
    zoomControl: false, maxZoom: 23, zoomSnap: 0.5, preferCanvas: true,
    zoomAnimation: !STILL.matches, fadeAnimation: !STILL.matches, markerZoomAnimation: !STILL.matches, inertia: !STILL.matches,
    ...options,
  });
  map.attributionControl?.setPrefix(false);
  const resized = new ResizeObserver(() => map.invalidateSize({animate: false}));
  resized.observe(element);
  map.on("unload", () => resized.disconnect());
  if (info) {
    const [west, south, east, north] = info.bounds;
    const bounds = L.latLngBounds([south, west], [north, east]);
    const about = [info.source, info.date, info.licence].filter(Boolean).join(" · ");
    L.tileLayer(info.tiles_url, {
      maxZoom: 23, maxNativeZoom: info.max_zoom, minNativeZoom: 0, bounds, noWrap: true, attribution: escaped(about),
    }).addTo(map);
    map.fitBounds(bounds, {animate: false});
  } else {
    map.setView([0, 0], 2);
  }
  return map;
}

function escaped(text) {
  return text.replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
}

const Track = L.Path.extend({
  initialize(options) {
    L.setOptions(this, {interactive: false, ...options});
    this.results = [];
    this.selected = null;
    this.all = true; // ellipses of all frames, or of the newest alone
    this.lost = false; // the vehicle is somewhere in the newest ellipse, if at all
  },
  show(results, selected, lost) {
    this.lost = lost;
    this.results = results.filter((r) => r.gps);
    this.selected = selected;
    if (this._map) { this._project(); this.redraw(); }
  },
  _project() {
    let bounds = this._pxBounds ? [this._pxBounds] : [];
    this._points = this.results.map((r) => this._map.latLngToLayerPoint([r.gps.lat, r.gps.lon]));
    const perMetre = this.perMetre();
    const now = L.bounds(this._points.length ? this._points : [[0, 0]]);
    const largest = Math.max(0, ...this.results.map((r) => r.ellipse?.semi_major_m ?? 0));
    const pad = L.point(1, 1).multiplyBy(30 + Math.min(largest * perMetre, 4000));
    this._pxBounds = L.bounds(now.min.subtract(pad), now.max.add(pad));
    for (const before of bounds) this._pxBounds.extend(before.min).extend(before.max); // what was drawn is wiped, too
  },
  _reset() { this._pxBounds = null; this._project(); this._update(); },
  _update() { this._updatePath(); },
  _updatePath() { if (this._renderer._drawing) this.draw(this._renderer._ctx); },
  _containsPoint() { return false; },
  /** Pixels of one metre at the middle of the view. */
  perMetre() {
    const lat = this._map.getCenter().lat;
    return 256 * 2 ** this._map.getZoom() / (2 * Math.PI * 6378137 * Math.cos(lat * RAD));
  },
  draw(c) {
    const {results, _points: points} = this;
    if (!results.length) return;
    c.save();
    c.lineJoin = c.lineCap = "round";
    this.ellipses(c);
    for (const casing of [true, false]) this.lines(c, casing);
    c.setLineDash([]);
    this.marks(c);
    this.vehicle(c);
    c.restore();
  },
  /** One path for each stretch of one source; points that lie on each other are left out. */
  lines(c, casing) {
    const {results, _points: points} = this;
    let style = null;
    let at = points[0];
    const end = () => { if (style) c.stroke(); };
    for (let i = 1; i < points.length; i++) {
      const next = styleOf(results[i].source);
      const isGap = results[i].fragment_id !== results[i - 1].fragment_id && !results[i].joined;
      if (isGap || next !== style) {
        end();
        style = next;
        at = points[isGap ? i : i - 1];
        c.setLineDash(casing ? [] : style.dash);
        c.strokeStyle = casing ? "rgba(10,14,18,.7)" : style.colour;
        c.lineWidth = casing ? 6 : 3.2;
        c.beginPath();
        c.moveTo(at.x, at.y);
        if (isGap) continue;
      } else if (i < points.length - 1 && at.distanceTo(points[i]) < 2) {
        continue;
      }
      at = points[i];
      c.lineTo(at.x, at.y);
    }
    end();
  },
  ellipses(c) {
    const perMetre = this.perMetre();
    const last = this.results.length - 1;
    let before = null;
    for (let i = 0; i <= last; i++) {
      const {ellipse, source, frame_id: frame} = this.results[i];
      const strong = i === last || frame === this.selected;
      if (!ellipse || !(this.all || strong)) continue;
      const point = this._points[i];
      const [a, b] = [ellipse.semi_major_m * perMetre, ellipse.semi_minor_m * perMetre];
      if (!strong && before && before.distanceTo(point) < Math.max(12, b)) continue; // they would hide the ground
      before = point;
      const {x, y} = point;
      c.beginPath();
      c.ellipse(x, y, a, b, (ellipse.bearing_deg - 90) * RAD, 0, 2 * Math.PI);
      const {colour} = styleOf(source);
      c.fillStyle = `${colour}${strong && b < 500 ? "38" : "14"}`; // one that fills the view would hide the ground
      c.fill();
      c.lineWidth = strong ? 4.5 : 2.6;
      c.strokeStyle = `rgba(10,14,18,${strong ? 0.75 : 0.35})`;
      c.stroke();
      c.lineWidth = strong ? 2.4 : 1.4;
      c.strokeStyle = strong ? "#fff" : `${colour}d0`;
      c.stroke();
    }
  },
  marks(c) {
    let before = null;
    this.results.forEach((result, i) => {
      const point = this._points[i];
      const isSelected = result.frame_id === this.selected;
      if (!isSelected && before && before.distanceTo(point) < 9) return; // too dense to tell apart
      before = point;
      const {shape, colour} = styleOf(result.source);
      trace(c, shape, point.x, point.y, isSelected ? 7 : 4.5);
      c.fillStyle = colour;
      c.fill();
      c.lineWidth = isSelected ? 3 : 1.5;
      c.strokeStyle = "#fff";
      c.stroke();
    });
  },
  vehicle(c) {
    const newest = this.results[this.results.length - 1];
    const {x, y} = this._points[this._points.length - 1];
    c.translate(x, y);
    if (this.lost) {
      c.font = "bold 34px sans-serif";
      c.textAlign = "center";
      c.textBaseline = "middle";
      c.lineWidth = 6;
      c.strokeStyle = "#0a0e12";
      c.strokeText("?", 0, 0);
      c.fillStyle = "#ffb7c4";
      c.fillText("?", 0, 0);
      return;
    }
    if (newest.heading === null) {
      trace(c, "circle", 0, 0, 8);
    } else {
      c.rotate(newest.heading * RAD);
      c.beginPath();
      c.moveTo(0, -17);
      c.lineTo(11, 13);
      c.lineTo(0, 7);
      c.lineTo(-11, 13);
      c.closePath();
    }
    c.fillStyle = styleOf(newest.source).colour;
    c.strokeStyle = "#0a0e12";
    c.lineWidth = 5;
    c.stroke();
    c.strokeStyle = "#fff";
    c.lineWidth = 2.5;
    c.stroke();
    c.fill();
  },
});

export class MapView {
  /** onFrame(frame id): a frame of the track was clicked. */
  constructor(element, info, onFrame) {
    this.map = baseMap(element, info);
    L.control.zoom({position: "topleft", zoomInTitle: t("zoom_in"), zoomOutTitle: t("zoom_out")}).addTo(this.map);
    L.control.scale({imperial: false, position: "bottomleft", maxWidth: 140}).addTo(this.map);
    this.track = new Track().addTo(this.map);
    this.drawn = L.layerGroup().addTo(this.map); // measurement
    this.objects = L.layerGroup().addTo(this.map);
    this.hints = L.layerGroup().addTo(this.map);
    this.start = L.layerGroup().addTo(this.map);
    this.whole = info && [[info.bounds[1], info.bounds[0]], [info.bounds[3], info.bounds[2]]];
    this.onFrame = onFrame;
    this.follow = true;
    this.pick = null; // takes the next click
    this.vertices = null; // of a measurement
    this.crosshair = h("div", {class: "map-cross", "aria-hidden": "true"});
    element.append(this.crosshair);
    this.map.on("click", (event) => this.clicked(event.latlng));
    this.map.on("dragstart", () => { this.follow = false; this.onFollow?.(); });
    element.addEventListener("keydown", (event) => {
      if (event.target === element && event.key === "Enter") this.clicked(this.map.getCenter());
    });
  }

  destroy() {
    this.map.remove();
  }

  clicked(latlng) {
    const gps = {lat: latlng.lat, lon: latlng.wrap().lng};
    if (this.vertices) this.measureAt(gps);
    else if (this.pick) this.pick(gps);
    else {
      const at = this.map.latLngToLayerPoint(latlng);
      let best = null;
      this.track.results.forEach((result, i) => {
        const d = this.track._points[i].distanceTo(at);
        if (d <= NEAR_PX && (!best || d <= best.d)) best = {d, id: result.frame_id};
      });
      if (best) this.onFrame(best.id);
    }
  }

  /** ``pick``: function of a position that takes clicks; null: none. */
  setPick(pick) {
    this.pick = pick;
    this.map.getContainer().classList.toggle("picking", Boolean(pick || this.vertices));
  }

  /** ``moves``: the flight goes on, and the map follows it. */
  show(model, selected, moves) {
    const lost = moves && model.newest !== null && placement(model.newest) === "unknown";
    this.track.show(model.ordered, selected, lost);
    this.showStart(model.flight.start);
    const fix = model.newestFix;
    const changed = this.lost !== lost;
    this.lost = lost;
    const must = (moves && this.follow) || !this.fitted;
    if (!model.newest || !must) return;
    const ellipse = fix?.ellipse && L.latLngBounds(square(fix.gps, 1.1 * fix.ellipse.semi_major_m));
    if (lost) { // what the vehicle may be in, not the point in its middle
      const bounds = ellipse ?? this.whole;
      if (bounds && (changed || !this.map.getBounds().contains(bounds))) this.map.fitBounds(bounds, {maxZoom: 18.5, animate: false});
    } else if (fix && (!this.fitted || changed)) this.fit();
    else if (fix && ellipse && !this.map.getBounds().contains(ellipse)) {
      const view = this.map.getBounds();
      const fits = view.getNorth() - view.getSouth() > ellipse.getNorth() - ellipse.getSouth() && view.getEast() - view.getWest() > ellipse.getEast() - ellipse.getWest();
      if (!fits) this.map.fitBounds(ellipse, {animate: false});
      else if (!view.pad(-0.15).contains(fix.gps)) this.map.panTo(fix.gps, {animate: !STILL.matches});
    }
    this.fitted = true;
  }

  /** Where the flight was said to begin. */
  showStart(start) {
    if (!start || this.start.getLayers().length) return;
    L.circle(start, {radius: start.sigma_m, color: "#fff", weight: 2, dashArray: "4 4", fillOpacity: 0.08, interactive: false}).addTo(this.start);
    L.circleMarker(start, {radius: 4, color: "#0a0e12", weight: 2, fillColor: "#fff", fillOpacity: 1, interactive: false})
      .bindTooltip(t("start"), {direction: "right", offset: [6, 0], className: "measured", permanent: true}).addTo(this.start);
  }

  fit() {
    const points = this.track.results.map((r) => [r.gps.lat, r.gps.lon]);
    if (points.length) this.map.fitBounds(L.latLngBounds(points).pad(0.15), {maxZoom: 18.5, animate: false});
  }

  centre(gps) {
    this.map.panTo([gps.lat, gps.lon], {animate: !STILL.matches});
  }

  // --- measure -------------------------------------------------------------------------------------

  measure(on) {
    this.vertices = on ? [] : null;
    this.drawn.clearLayers();
    this.setPick(this.pick);
  }

  measureAt(gps) {
    this.vertices.push(gps);
    this.drawn.clearLayers();
    const points = this.vertices.map((v) => [v.lat, v.lon]);
    L.polyline(points, {color: "#0a0e12", weight: 6, interactive: false}).addTo(this.drawn);
    L.polyline(points, {color: "#fff", weight: 3, dashArray: "6 5", interactive: false}).addTo(this.drawn);
    let total = 0;
    this.vertices.forEach((vertex, i) => {
      const dot = L.circleMarker(points[i], {radius: 5, color: "#0a0e12", fillColor: "#fff", fillOpacity: 1, weight: 2, interactive: false});
      dot.addTo(this.drawn);
      const before = this.vertices[i - 1];
      if (before) total += distance(before, vertex);
      if (i < this.vertices.length - 1) return;
      const text = before
        ? `${metres(total)} · ${degrees(bearing(before, vertex))}${i > 1 ? ` (${metres(distance(before, vertex))})` : ""}`
        : coordinate(vertex);
      dot.bindTooltip(text, {permanent: true, direction: "right", offset: [8, 0], className: "measured"});
      this.onMeasure?.(text);
    });
  }

  // --- what lies where -----------------------------------------------------------------------------

  /** A circle that contains the object with 95 %. */
  addObject(name, gps, radius) {
    L.circle([gps.lat, gps.lon], {radius, color: "#fff", weight: 2, fillColor: "#35c46f", fillOpacity: 0.3, interactive: false})
      .addTo(this.objects);
    L.circleMarker([gps.lat, gps.lon], {radius: 4, color: "#0a0e12", weight: 2, fillColor: "#35c46f", fillOpacity: 1, interactive: false})
      .bindTooltip(name, {permanent: true, direction: "top", offset: [0, -6], className: "measured"}).addTo(this.objects);
  }

  showCandidates(tiles) {
    this.hints.clearLayers();
    for (const tile of tiles) {
      L.rectangle(square(tile.gps, tile.half_size_m), {color: "#fff", weight: 2, dashArray: "5 5", fill: false, interactive: false})
        .bindTooltip(String(tile.rank), {permanent: true, direction: "center", className: "measured"})
        .addTo(this.hints);
    }
  }

  addMark(gps, radius = 5) {
    return L.circle([gps.lat, gps.lon], {radius, color: "#ffe14d", weight: 3, fillOpacity: 0.2, interactive: false}).addTo(this.hints);
  }
}

export {L};
