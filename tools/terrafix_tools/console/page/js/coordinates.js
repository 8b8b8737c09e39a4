// A position as people write it: decimal degrees, degrees with minutes and seconds, UTM, MGRS. The last digit is worth a
// third of the accuracy at most, and a thirtieth at least: digits that nothing supports are taken for accuracy.
// UTM: Krueger's series to the third order, exact to some millimetres within a zone (Karney 2011, "Transverse Mercator
// with an accuracy of a few nanometers", equations 7 to 9). Zones and letters: DMA TM 8358.1.

const RAD = Math.PI / 180;
const F = 1 / 298.257223563; // flattening of WGS84
const A = 6378137;
const M_PER_DEGREE = 111320;
const BANDS = "CDEFGHJKLMNPQRSTUVWX";
export const FORMATS = ["degrees", "dms", "utm", "mgrs"];

function zoneOf(lat, lon) {
  if (lat >= 56 && lat < 64 && lon >= 3 && lon < 12) return 32; // the west coast of Norway
  if (lat >= 72 && lon >= 0 && lon < 42) return lon < 9 ? 31 : lon < 21 ? 33 : lon < 33 ? 35 : 37; // Svalbard
  return Math.floor((lon + 180) / 6) % 60 + 1;
}

/** {zone, band, east, north} [m]; null: beyond the latitudes of UTM. */
export function utm({lat, lon}) {
  if (lat < -80 || lat > 84) return null;
  const zone = zoneOf(lat, lon);
  const n = F / (2 - F);
  const radius = A / (1 + n) * (1 + n ** 2 / 4 + n ** 4 / 64);
  const alpha = [n / 2 - 2 * n ** 2 / 3 + 5 * n ** 3 / 16, 13 * n ** 2 / 48 - 3 * n ** 3 / 5, 61 * n ** 3 / 240];
  const e = 2 * Math.sqrt(n) / (1 + n);
  const sin = Math.sin(lat * RAD);
  const t = Math.sinh(Math.atanh(sin) - e * Math.atanh(e * sin));
  const dLon = (lon - (6 * zone - 183)) * RAD;
  const xi = Math.atan2(t, Math.cos(dLon));
  const eta = Math.atanh(Math.sin(dLon) / Math.hypot(1, t));
  const sum = (f, g) => alpha.reduce((found, a, i) => found + a * f(2 * (i + 1) * xi) * g(2 * (i + 1) * eta), 0);
  const east = 500000 + 0.9996 * radius * (eta + sum(Math.cos, Math.sinh));
  const north = (lat < 0 ? 1e7 : 0) + 0.9996 * radius * (xi + sum(Math.sin, Math.cosh));
  return {zone, band: BANDS[Math.min(Math.floor((lat + 80) / 8), 19)], east, north};
}

function mgrs(at, digits) {
  const {zone, band, east, north} = at;
  const column = "ABCDEFGHJKLMNPQRSTUVWXYZ"[8 * ((zone - 1) % 3) + Math.floor(east / 1e5) - 1];
  const row = "ABCDEFGHJKLMNPQRSTUV"[(Math.floor(north / 1e5) + (zone % 2 ? 0 : 5)) % 20];
  const part = (value) => String(Math.floor(value % 1e5 / 10 ** (5 - digits))).padStart(digits, "0");
  return `${String(zone).padStart(2, "0")}${band} ${column}${row} ${part(east)} ${part(north)}`;
}

function dms(value, letters, decimals) {
  const unit = 10 ** decimals;
  const all = Math.round(Math.abs(value) * 3600 * unit);
  const seconds = (all % (60 * unit) / unit).toFixed(decimals).padStart(decimals ? decimals + 3 : 2, "0");
  const minutes = Math.floor(all / (60 * unit));
  return `${Math.floor(minutes / 60)}°${String(minutes % 60).padStart(2, "0")}′${seconds}″${letters[value < 0 ? 1 : 0]}`;
}

/** ``accuracy``: radius in metres; undefined: as of 1 m. Always with decimal points: it is copied into other programs. */
export function written(gps, format, accuracy = 1) {
  const clamp = (value, least, most) => Math.min(Math.max(value, least), most);
  const step = Math.log10(Math.max(accuracy, 0.01) / 3); // of the last digit, as a power of ten of a metre
  const at = format === "utm" || format === "mgrs" ? utm(gps) : null;
  if (at && format === "mgrs") return mgrs(at, clamp(5 - Math.floor(step), 1, 5));
  if (at) {
    const last = 10 ** Math.max(Math.floor(step), -1);
    const round = (value) => (Math.round(value / last) * last).toFixed(last < 1 ? 1 : 0);
    return `${at.zone}${at.band} ${round(at.east)} ${round(at.north)}`;
  }
  if (format === "dms") {
    const decimals = clamp(Math.ceil(Math.log10(M_PER_DEGREE / 3600) - step), 0, 3);
    return `${dms(gps.lat, "NS", decimals)} ${dms(gps.lon, "EW", decimals)}`;
  }
  const decimals = clamp(Math.ceil(Math.log10(M_PER_DEGREE) - step), 2, 7);
  return `${gps.lat.toFixed(decimals)}, ${gps.lon.toFixed(decimals)}`;
}
