// The image of a frame: click a pixel, or move the cross with the arrow keys and press Enter. A loupe shows the pixels
// around the cross, because an image of 26 megapixels is shown on a few hundred.

import {h} from "./dom.js";
import {t} from "./texts.js";

const LOUPE_PX = 132; // its side on the screen
const LOUPE_ZOOM = 2; // screen pixels of an image pixel

export class FrameView {
  /** onPick({u, v}): a pixel of the image was chosen. */
  constructor(onPick) {
    this.onPick = onPick;
    this.at = null; // {u, v}: the cross
    this.image = h("img", {alt: "", draggable: "false"});
    this.cross = h("div", {class: "cross", hidden: true, "aria-hidden": "true"});
    this.loupe = h("canvas", {class: "loupe", width: LOUPE_PX, height: LOUPE_PX, hidden: true, "aria-hidden": "true"});
    this.note = h("p", {class: "frame-note", hidden: true});
    this.element = h("div", {class: "frame", tabindex: 0, role: "group", "aria-label": t("frame_help"), title: t("frame_help")},
      this.image, this.cross, this.loupe, this.note);
    this.image.addEventListener("load", () => {
      this.note.hidden = true;
      this.image.hidden = false;
      this.place();
    });
    this.image.addEventListener("error", () => this.none(t("frame_gone")));
    this.element.addEventListener("pointermove", (event) => {
      if (event.pointerType !== "touch") this.move(this.pixel(event), true);
    });
    this.element.addEventListener("pointerleave", () => { this.loupe.hidden = true; });
    this.element.addEventListener("click", (event) => this.choose(this.pixel(event)));
    this.element.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.place()).observe(this.element);
  }

  show(url, alt) {
    if (this.url === url) return;
    this.url = url;
    this.at = null;
    this.cross.hidden = this.loupe.hidden = true;
    this.image.alt = alt;
    this.image.src = url;
  }

  none(text) {
    this.image.hidden = true;
    this.cross.hidden = this.loupe.hidden = true;
    this.note.hidden = false;
    this.note.textContent = text;
  }

  get ready() {
    return this.image.complete && this.image.naturalWidth > 0 && !this.image.hidden;
  }

  /** Pixel under the pointer: the centre of the first one is 0. null: beside the image. */
  pixel(event) {
    if (!this.ready) return null;
    const box = this.image.getBoundingClientRect();
    const u = (event.clientX - box.left) / box.width * this.image.naturalWidth - 0.5;
    const v = (event.clientY - box.top) / box.height * this.image.naturalHeight - 0.5;
    const inside = u >= -0.5 && v >= -0.5 && u <= this.image.naturalWidth - 0.5 && v <= this.image.naturalHeight - 0.5;
    return inside ? {u: Math.round(u * 10) / 10, v: Math.round(v * 10) / 10} : null;
  }

  move(at, withLoupe) {
    if (!at) return;
    if (withLoupe) this.magnify(at);
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
      const step = event.shiftKey ? 1 : Math.max(1, Math.round(width / 80));
      const from = this.at ?? {u: Math.round(width / 2), v: Math.round(height / 2)};
      const [x, y] = steps[event.key];
      const within = (value, size) => Math.min(Math.max(value, 0), size - 1);
      this.at = {u: within(from.u + x * step, width), v: within(from.v + y * step, height)};
      this.place();
      this.magnify(this.at);
      event.preventDefault();
    } else if (event.key === "Enter" && this.at) {
      this.choose(this.at);
      event.preventDefault();
    }
  }

  /** Screen position of a pixel, relative to the element. */
  onScreen(at) {
    const box = this.image.getBoundingClientRect();
    const frame = this.element.getBoundingClientRect();
    return {
      x: box.left - frame.left - this.element.clientLeft + (at.u + 0.5) / this.image.naturalWidth * box.width,
      y: box.top - frame.top - this.element.clientTop + (at.v + 0.5) / this.image.naturalHeight * box.height,
    };
  }

  place() {
    this.cross.hidden = !this.at || !this.ready;
    if (this.cross.hidden) return;
    const {x, y} = this.onScreen(this.at);
    this.cross.style.left = `${x}px`;
    this.cross.style.top = `${y}px`;
  }

  magnify(at) {
    const {x, y} = this.onScreen(at);
    const c = this.loupe.getContext("2d");
    const side = LOUPE_PX / LOUPE_ZOOM;
    c.imageSmoothingEnabled = false;
    c.fillStyle = "#000";
    c.fillRect(0, 0, LOUPE_PX, LOUPE_PX);
    c.drawImage(this.image, at.u + 0.5 - side / 2, at.v + 0.5 - side / 2, side, side, 0, 0, LOUPE_PX, LOUPE_PX);
    c.strokeStyle = "#ffe14d";
    c.lineWidth = 1.5;
    c.strokeRect(LOUPE_PX / 2 - 4, LOUPE_PX / 2 - 4, 8, 8);
    this.loupe.style.left = `${x + (x > this.element.clientWidth / 2 ? -LOUPE_PX - 20 : 20)}px`;
    this.loupe.style.top = `${y > this.element.clientHeight / 2 ? Math.max(0, y - LOUPE_PX - 10) : y + 10}px`;
    this.loupe.hidden = false;
  }
}
