// Requests to the service (docs/console.md). A refusal is a Problem with the service's own words.

import {h} from "./dom.js";

const HEAD_BYTES = 256 * 1024; // of a photo: EXIF and XMP are before them

export class Problem extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status; // 0: no answer
  }
}

async function problemOf(response) {
  let detail = response.statusText;
  try {
    const body = await response.json();
    const where = (body.errors ?? []).map((e) => `${e.where}: ${e.what}`).join("; ");
    detail = [body.detail || body.title, where].filter(Boolean).join(": ");
  } catch { /* no JSON: the status line has to do */ }
  return new Problem(response.status, detail);
}

/** The answer of the service. Throws Problem. */
async function answer(path, options = {}) {
  const response = await fetch(path, {credentials: "same-origin", ...options}).catch(() => { throw new Problem(0, "the service does not answer"); });
  if (!response.ok) throw await problemOf(response);
  return response;
}

async function request(method, path, body) {
  const json = body === undefined ? {} : {headers: {"content-type": "application/json"}, body: JSON.stringify(body)};
  const response = await answer(path, {method, ...json});
  return response.status === 204 ? null : response.json();
}

/** What photos state; ``photos``: as of photos.js, ``description``: text of a flight.toml or null. */
export async function photoFacts(photos, description) {
  const form = new FormData();
  for (const {name, get: bytes} of photos) form.append("images", (await bytes()).slice(0, HEAD_BYTES), name);
  if (description !== null) form.append("description", new Blob([description]), "flight.toml");
  return (await answer("/photos", {method: "POST", body: form})).json();
}

/** Saves what the service makes, by the name that it gives. -> the name. A refusal is not saved. */
export async function download(path) {
  const response = await answer(path);
  const given = response.headers.get("content-disposition");
  const name = decodeURIComponent(/filename\*=utf-8''(.*)/.exec(given)?.[1] ?? /filename="(.*)"/.exec(given)[1]);
  const url = URL.createObjectURL(await response.blob());
  h("a", {href: url, download: name}).click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
  return name;
}

export const get = (path) => request("GET", path);
export const post = (path, body) => request("POST", path, body);
export const remove = (path) => request("DELETE", path);

/** All results of a flight, over as many pages as it takes. */
export async function allResults(flightId, refined) {
  const found = [];
  let from = 0;
  while (from !== null) {
    const page = await get(`/flights/${flightId}/results?refined=${refined}&from=${from}`);
    found.push(...page.results);
    from = page.next_from;
  }
  return found;
}

/** One batch of images. onBytes(sent) tells the progress, which fetch does not. */
export function uploadBatch(flightId, form, onBytes, signal) {
  return new Promise((resolve, reject) => {
    const sending = new XMLHttpRequest();
    sending.open("POST", `/flights/${flightId}/images/batch`);
    sending.responseType = "text";
    sending.upload.onprogress = (event) => onBytes(event.loaded);
    sending.onerror = () => reject(new Problem(0, "the service does not answer"));
    sending.onload = () => {
      let body = {};
      try { body = JSON.parse(sending.responseText); } catch { /* as above */ }
      if (sending.status === 202) resolve(body);
      else reject(new Problem(sending.status, body.detail || sending.statusText));
    };
    sending.onabort = () => reject(new Problem(0, "cancelled"));
    signal.addEventListener("abort", () => sending.abort());
    if (signal.aborted) return void reject(new Problem(0, "cancelled"));
    sending.send(form);
  });
}
