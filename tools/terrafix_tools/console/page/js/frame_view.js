// The image of a frame: click a pixel, or move the cross with the arrow keys and press Enter. Wheel, two fingers, plus and
// minus zoom, dragging moves; it can be turned so that north is up, as on the map.

import {h} from "./dom.js";
import {t} from "./texts.js";

const MAX_ZOOM = 8; // screen pixels of an image pixel
const STEP = 1.5; // of the zoom
const DRAG_PX = 6; // on the screen, from which a press is no click
const RAD = Math.PI / 180;

export class FrameView {
  /** onPick({u, v}): a pixel of the image was chosen. */
  constructor(onPick) {
    Object.assign(this, {onPick, at: null, heading: null, isNorthUp: false, zoom: 1, middle: null, pointers: new Map()});
    this.image = h("img", {alt: "", draggable: "false"});
    this.cross = h("div", {class: "cross", hidden: true, "aria-hidden": "true"});
    this.note = h("p", {class: "frame-note", hidden: true});
    this.north = h("button", {type: "button", "aria-pressed": "false", title: t("north_up"), "aria-label": t("north_up"), onclick: () => this.turn(!this.isNorthUp)}, "N↑");
    const button = (text, label, by) => h("button", {type: "button", "aria-label": t(label), title: t(label), onclick: () => this.zoomBy(by, this.at)}, text);
    this.view = h("div", {class: "frame-view", tabindex: 0, role: "application", "aria-label": t("frame_help")}, this.image, this.cross);
    this.element = h("div", {class: "frame"}, this.view, h("div", {class: "frame-tools"}, button("+", "zoom_in", STEP), button("−", "zoom_out", 1 / STEP), this.north), this.note);
    this.image.addEventListener("load", () => {
      this.note.hidden = true;
      this.image.hidden = false;
      this.place();
    });
    this.image.addEventListener("error", () => this.none(t("frame_gone")));
    this.view.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(STEP ** (-event.deltaY / 100), this.pixel(event), event);
    }, {passive: false});
    this.view.addEventListener("pointerdown", (event) => this.press(event));
    this.view.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) this.view.addEventListener(name, (event) => this.release(event));
    this.view.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.place()).observe(this.view);
  }

  /** ``heading``: of the top of the image, degrees from true north; null: not known. */
  show(url, alt, heading = null) {
    this.heading = heading;
    this.north.hidden = heading === null;
    if (this.url === url) return this.place();
    Object.assign(this, {url, at: null, zoom: 1, middle: null});
    this.image.alt = alt;
    this.image.src = url;
    this.place();
  }

  turn(on) {
    this.isNorthUp = on;
    this.north.setAttribute("aria-pressed", String(on));
    this.place();
  }

  none(text) {
    this.image.hidden = this.cross.hidden = true;
    this.note.hidden = false;
    this.note.textContent = text;
  }

  focus() {
    this.view.focus();
  }

  get ready() {
    return this.image.complete && this.image.naturalWidth > 0 && !this.image.hidden;
  }

  get angle() {
    return this.isNorthUp && this.heading !== null ? this.heading * RAD : 0;
  }

  /** Screen pixels of an image pixel at which the whole image is seen. */
  get fit() {
    const [width, height] = [this.image.naturalWidth, this.image.naturalHeight];
    const [cos, sin] = [Math.abs(Math.cos(this.angle)), Math.abs(Math.sin(this.angle))];
    return Math.min(this.view.clientWidth / (width * cos + height * sin), this.view.clientHeight / (width * sin + height * cos));
  }

  get scale() {
    return this.fit * this.zoom;
  }

  /** A vector of the image on the screen. */
  turned(x, y, angle = this.angle) {
    return [x * Math.cos(angle) - y * Math.sin(angle), x * Math.sin(angle) + y * Math.cos(angle)];
  }

  /** Pixel under a pointer: the centre of the first one is 0. null: beside the image. */
  pixel(event) {
    if (!this.ready) return null;
    const box = this.view.getBoundingClientRect();
    const [x, y] = this.turned(event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2, -this.angle);
    const [u, v] = [this.middle.u + x / this.scale - 0.5, this.middle.v + y / this.scale - 0.5];
    const inside = u >= -0.5 && v >= -0.5 && u <= this.image.naturalWidth - 0.5 && v <= this.image.naturalHeight - 0.5;
    return inside ? {u: Math.round(u * 10) / 10, v: Math.round(v * 10) / 10} : null;
  }

  /** Where a pixel is on the screen, from the middle of the view. */
  onScreen(at) {
    return this.turned((at.u + 0.5 - this.middle.u) * this.scale, (at.v + 0.5 - this.middle.v) * this.scale);
  }

  place() {
    this.cross.hidden = !this.at || !this.ready;
    if (!this.ready || !this.view.clientWidth) return;
    const {naturalWidth: width, naturalHeight: height} = this.image;
    if (!this.middle || this.zoom <= 1) this.middle = {u: width / 2, v: height / 2};
    const [w, h2] = [this.view.clientWidth / 2, this.view.clientHeight / 2];
    this.image.style.width = `${width}px`;
    this.image.style.transform = `translate(${w}px, ${h2}px) rotate(${this.angle}rad) scale(${this.scale}) translate(${-this.middle.u}px, ${-this.middle.v}px)`;
    this.image.style.imageRendering = this.scale > 2 ? "pixelated" : "auto";
    if (!this.at) return;
    const [x, y] = this.onScreen(this.at);
    this.cross.style.left = `${w + x}px`;
    this.cross.style.top = `${h2 + y}px`;
  }

  /** Around a pixel, which stays where it is; null: around the middle. */
  zoomBy(by, around) {
    if (!this.ready) return;
    const zoom = Math.min(Math.max(this.zoom * by, 1), Math.max(1, MAX_ZOOM / this.fit));
    const share = this.zoom / zoom;
    const fixed = around ? {u: around.u + 0.5, v: around.v + 0.5} : this.middle;
    this.middle = {u: fixed.u + (this.middle.u - fixed.u) * share, v: fixed.v + (this.middle.v - fixed.v) * share};
    this.zoom = zoom;
    this.place();
  }

  drag(x, y) {
    const [u, v] = this.turned(x, y, -this.angle);
    const within = (value, size) => Math.min(Math.max(value, 0), size);
    this.middle = {u: within(this.middle.u - u / this.scale, this.image.naturalWidth), v: within(this.middle.v - v / this.scale, this.image.naturalHeight)};
    this.place();
  }

  // --- pointers and keys ---------------------------------------------------------------------------

  press(event) {
    this.view.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, {x: event.clientX, y: event.clientY});
    this.isClick = this.pointers.size === 1;
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before || !this.ready) return;
    const now = {x: event.clientX, y: event.clientY};
    const [x, y] = [now.x - before.x, now.y - before.y];
    if (this.pointers.size === 1 && this.isClick && Math.hypot(x, y) < DRAG_PX) return;
    this.isClick = false;
    if (this.pointers.size === 2) {
      const [other] = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const apart = (at) => Math.max(1, Math.hypot(at.x - other.x, at.y - other.y));
      this.zoomBy(apart(now) / apart(before), this.pixel({clientX: (now.x + other.x) / 2, clientY: (now.y + other.y) / 2}));
    }
    this.drag(x / this.pointers.size, y / this.pointers.size);
    this.pointers.set(event.pointerId, now);
  }

  release(event) {
    if (!this.pointers.delete(event.pointerId) || !this.isClick || event.type !== "pointerup") return;
    this.isClick = false;
    this.choose(this.pixel(event));
  }

  choose(at) {
    if (!at) return;
    this.at = at;
    this.place();
    this.onPick(at);
  }

  key(event) {
    const steps = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};
    if (!this.ready) return;
    const {naturalWidth: width, naturalHeight: height} = this.image;
    if (steps[event.key]) {
      const step = event.shiftKey ? 1 : Math.max(1, Math.round(width / 80 / this.zoom));
      const from = this.at ?? {u: Math.round(width / 2), v: Math.round(height / 2)};
      const [x, y] = this.turned(...steps[event.key], -this.angle); // as it is seen
      const within = (value, size) => Math.min(Math.max(Math.round(value * 10) / 10, 0), size - 1);
      this.at = {u: within(from.u + x * step, width), v: within(from.v + y * step, height)};
      const [right, down] = this.onScreen(this.at);
      if (Math.abs(right) > this.view.clientWidth / 2 || Math.abs(down) > this.view.clientHeight / 2) this.middle = {...this.at};
      this.place();
    } else if (event.key === "Enter" && this.at) this.choose(this.at);
    else if (event.key === "+" || event.key === "-") this.zoomBy(event.key === "+" ? STEP : 1 / STEP, this.at);
    else return;
    event.preventDefault();
  }
}
