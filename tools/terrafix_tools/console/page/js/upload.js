// Photos in batches. A batch that got no answer is sent again as it is: the service takes it once.

import {Problem, uploadBatch} from "./api.js";
import {h, say} from "./dom.js";
import {bytes, number, seconds} from "./format.js";
import {t} from "./texts.js";

export const BATCH = [10, 50];
const TRIES = 8;

/** Sizes of the batches for n images: as few as possible, as equal as possible. */
export function batchSizes(n) {
  const count = Math.ceil(n / BATCH[1]);
  return Array.from({length: count}, (_, i) => Math.floor((n + i) / count));
}

/** Header and rows of a frames.csv by file name. Throws an Error: a column or a row is missing. */
export function readTable(text, photos) {
  const lines = text.replace(/^\uFEFF/, "").split(/\r?\n/).filter((line) => line.trim());
  if (!/^file\s*,/.test(lines[0] ?? "")) throw new Error(t("no_file_column"));
  const rows = new Map(lines.slice(1).map((line) => [line.slice(0, line.indexOf(",")).trim(), line.slice(line.indexOf(",") + 1)]));
  const missing = photos.find((photo) => !rows.has(photo.name));
  if (missing) throw new Error(t("no_row", missing.name));
  return {header: lines[0], rows};
}

export class Upload {
  /** photos: as of photos.js; table: of ``readTable`` or null. ``element`` shows the progress. */
  constructor(flightId, photos, table) {
    this.flightId = flightId;
    this.images = photos;
    this.table = table;
    this.total = photos.reduce((sum, photo) => sum + photo.size, 0);
    this.stop = new AbortController();
    this.cancel = h("button", {type: "button", onclick: () => this.stop.abort()}, t("cancel"));
    this.bar = h("progress", {max: 1, value: 0, "aria-label": t("upload")});
    this.line = h("p", {});
    this.element = h("section", {class: "upload card"}, h("header", {}, h("strong", {}, t("upload")), this.cancel), this.bar, this.line);
  }

  async run() {
    const began = performance.now();
    const sizes = batchSizes(this.images.length);
    let at = 0;
    let done = 0;
    for (const [i, size] of sizes.entries()) {
      const batch = this.images.slice(at, at + size);
      const weight = batch.reduce((sum, photo) => sum + photo.size, 0);
      const show = (sent) => this.show(done + Math.min(sent, weight), i, sizes.length, (performance.now() - began) / 1000);
      show(0);
      await this.send(batch, show);
      at += size;
      done += weight;
    }
    this.show(this.total, sizes.length - 1, sizes.length, (performance.now() - began) / 1000);
    this.cancel.hidden = true;
    this.line.textContent = t("upload_done", number(this.images.length), bytes(this.total));
    say(this.line.textContent);
  }

  async send(batch, show) {
    for (let attempt = 0; ; attempt++) {
      try {
        return await uploadBatch(this.flightId, await this.form(batch), show, this.stop.signal);
      } catch (error) {
        const again = error instanceof Problem && [0, 429, 503].includes(error.status) && !this.stop.signal.aborted;
        if (!again || attempt === TRIES) {
          this.cancel.hidden = true;
          this.line.textContent = this.stop.signal.aborted ? t("cancelled") : error.message;
          this.element.classList.add("bad");
          throw error;
        }
        this.line.textContent = t("upload_again", error.message);
        await new Promise((resolve) => setTimeout(resolve, Math.min(500 * 2 ** attempt, 8000)));
      }
    }
  }

  async form(batch) {
    const form = new FormData();
    for (const {name, get} of batch) form.append("images", await get(), name);
    if (this.table) {
      const rows = batch.map(({name}) => `${name},${this.table.rows.get(name)}`);
      form.append("telemetry", new Blob([[this.table.header, ...rows].join("\n")], {type: "text/csv"}), "frames.csv");
    }
    return form;
  }

  show(sent, batch, batches, time) {
    this.bar.value = this.total ? sent / this.total : 0;
    const left = sent > 0 && sent < this.total ? t("remaining", seconds(time / sent * (this.total - sent))) : "";
    this.line.textContent = [t("upload_line", number(batch + 1), number(batches), bytes(sent), bytes(this.total)), left].filter(Boolean).join(" · ");
  }
}

/** Uploads that run, by flight: the view of the flight shows them. */
export const uploads = new Map();
const warn = (event) => event.preventDefault();

export async function startUpload(flightId, photos, table) {
  const upload = new Upload(flightId, photos, table);
  uploads.set(flightId, upload);
  upload.running = true;
  addEventListener("beforeunload", warn);
  try {
    await upload.run();
    return true;
  } catch {
    return false; // the card tells why
  } finally {
    upload.running = false;
    if (![...uploads.values()].some((one) => one.running)) removeEventListener("beforeunload", warn);
    setTimeout(() => { if (uploads.get(flightId) === upload) uploads.delete(flightId); }, 8000);
  }
}
