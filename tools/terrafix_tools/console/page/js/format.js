// Numbers as text, always with their unit. "–" is "not known".

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

/** Latitude, longitude: six decimals are 0.1 m. Decimal points in every language: it is copied into other programs. */
export const coordinate = (gps) => (gps ? `${gps.lat.toFixed(6)}, ${gps.lon.toFixed(6)}` : NONE);

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
