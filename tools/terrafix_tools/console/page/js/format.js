// Numbers as text, always with their unit. "–" is "not known".

import {FORMATS, written} from "./coordinates.js";
import {locale} from "./texts.js";

export const NONE = "–";
const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

export function number(value, digits = 0) {
  if (!known(value)) return NONE;
  return value.toLocaleString(locale(), {minimumFractionDigits: digits, maximumFractionDigits: digits});
}

export const unit = (value, digits, name) => (known(value) ? `${number(value, digits)} ${name}` : NONE);

/** Metres: one decimal below 100 m; kilometres from 10 km. */
export function metres(value) {
  if (!known(value)) return NONE;
  if (Math.abs(value) >= 10000) return unit(value / 1000, 1, "km");
  return unit(value, Math.abs(value) < 100 ? 1 : 0, "m");
}

let format = FORMATS[0];
export const coordinateFormat = () => format;
export const setCoordinateFormat = (name) => { format = FORMATS.includes(name) ? name : FORMATS[0]; };

/** ``accuracy``: its radius [m], which decides on the digits. */
export const coordinate = (gps, accuracy) => (gps ? written(gps, format, accuracy) : NONE);

export const degrees = (value) => (known(value) ? `${number((value % 360 + 360) % 360)}°` : NONE);

export function bytes(value) {
  if (value >= 1e9) return unit(value / 1e9, 1, "GB");
  return value >= 1e6 ? unit(value / 1e6, 1, "MB") : unit(value / 1e3, 0, "kB");
}

export function seconds(value) {
  if (!known(value)) return NONE;
  if (value < 10) return unit(value, 1, "s");
  if (value < 120) return unit(value, 0, "s");
  return value < 7200 ? unit(value / 60, 0, "min") : unit(value / 3600, 1, "h");
}

export const clock = (ms) => new Date(ms).toLocaleTimeString(locale());
export const dateTime = (iso) => new Date(iso).toLocaleString(locale(), {dateStyle: "medium", timeStyle: "short"});
