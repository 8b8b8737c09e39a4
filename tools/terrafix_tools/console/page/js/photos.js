// Photos as they are given: files, a folder, a zip file, a flight folder with flight.toml and frames.csv, by choosing or by
// dropping them. A photo is {name, path, size, get()}: its bytes are read when they are sent.

import {t} from "./texts.js";

const IMAGE = /\.(jpe?g|png)$/i;

/** By names, IMG_9 before IMG_10; as the service orders them. */
export function compareNames(one, other) {
  const [a, b] = [one, other].map((name) => name.split(/([0-9]+)/));
  for (let i = 0; i < Math.min(a.length, b.length); i++) {
    let [x, y] = [a[i], b[i]];
    if (i % 2) {
      [x, y] = [x, y].map((digits) => digits.replace(/^0+(?=.)/, ""));
      if (x.length !== y.length) return x.length - y.length;
    }
    if (x !== y) return x < y ? -1 : 1;
  }
  return a.length - b.length || (one < other ? -1 : Number(one > other));
}

/** The files of a zip file, also of one above 4 GB (APPNOTE 6.3.10, 4.3 and 4.5.3). */
async function unzipped(file) {
  const view = async (from, size) => new DataView(await file.slice(from, from + size).arrayBuffer());
  const broken = () => new Error(t("bad_zip", file.name));
  const begin = Math.max(0, file.size - 66000); // the end record with the longest comment
  const tail = await view(begin, 66000);
  let end = tail.byteLength - 22;
  while (end >= 0 && tail.getUint32(end, true) !== 0x06054b50) end--;
  if (end < 0) throw broken();
  let [size, from] = [tail.getUint32(end + 12, true), tail.getUint32(end + 16, true)];
  if (from === 0xffffffff || size === 0xffffffff) {
    const last = await view(Number(tail.getBigUint64(end - 12, true)), 56);
    [size, from] = [Number(last.getBigUint64(40, true)), Number(last.getBigUint64(48, true))];
  }
  const list = await view(from, size);
  const found = [];
  for (let at = 0; at + 46 <= list.byteLength;) {
    if (list.getUint32(at, true) !== 0x02014b50 || list.getUint16(at + 8, true) & 1) throw broken(); // or encrypted
    const method = list.getUint16(at + 10, true);
    const [nameSize, extraSize, commentSize] = [28, 30, 32].map((i) => list.getUint16(at + i, true));
    const path = new TextDecoder().decode(new Uint8Array(list.buffer, at + 46, nameSize));
    let [packed, plain, offset] = [20, 24, 42].map((i) => list.getUint32(at + i, true));
    const extra = at + 46 + nameSize;
    for (let i = extra; i + 4 <= extra + extraSize; i += 4 + list.getUint16(i + 2, true)) {
      if (list.getUint16(i, true) !== 1) continue;
      let next = i + 4;
      const long = (value) => { if (value !== 0xffffffff) return value; next += 8; return Number(list.getBigUint64(next - 8, true)); };
      plain = long(plain);
      packed = long(packed);
      offset = long(offset);
    }
    const get = async () => {
      const head = await view(offset, 30);
      const start = offset + 30 + head.getUint16(26, true) + head.getUint16(28, true);
      const bytes = file.slice(start, start + packed);
      if (method === 0) return bytes;
      if (method !== 8) throw broken();
      return new Response(bytes.stream().pipeThrough(new DecompressionStream("deflate-raw"))).blob();
    };
    if (!path.endsWith("/")) found.push({path, size: plain, get});
    at = extra + extraSize + commentSize;
  }
  return found;
}

async function inFolder(entry) {
  if (entry instanceof File) return [{path: entry.name, file: entry}];
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
    return [{path: entry.fullPath.slice(1), file}];
  }
  const reader = entry.createReader();
  const found = [];
  for (;;) { // a hundred at a time
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) return found;
    for (const one of some) found.push(...await inFolder(one));
  }
}

/** What was dropped, with the files of folders. To be called while the event is handled. */
export async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.() ?? item.getAsFile()).filter(Boolean);
  return (await Promise.all(entries.map(inFolder))).flat();
}

/** ``files``: a FileList, or [{path, file}] -> {photos, table, description}: photos in order, texts of frames.csv and
    flight.toml or null. Names are those of the files; folders come before them where names occur twice. */
export async function sorted(files) {
  const all = [];
  for (const one of files) {
    const file = one.file ?? one;
    const path = one.path ?? (file.webkitRelativePath || file.name);
    if (/\.zip$/i.test(file.name)) all.push(...await unzipped(file));
    else all.push({path, size: file.size, get: async () => file});
  }
  const nameOf = (path) => path.slice(path.lastIndexOf("/") + 1);
  const kept = all.filter(({path}) => !/(^|\/)(\.|__MACOSX\/)/.test(path));
  const text = async (name) => {
    const found = kept.find(({path}) => nameOf(path).toLowerCase() === name);
    return found ? (await found.get()).text() : null;
  };
  const photos = kept.filter(({path}) => IMAGE.test(path));
  const single = new Set(photos.map(({path}) => nameOf(path))).size === photos.length;
  const named = photos.map((photo) => ({...photo, name: single ? nameOf(photo.path) : photo.path.replaceAll("/", "_")}));
  return {photos: named.sort((a, b) => compareNames(a.name, b.name)), table: await text("frames.csv"), description: await text("flight.toml")};
}
