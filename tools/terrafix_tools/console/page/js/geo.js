// Distances on the WGS84 ellipsoid, exact to some millimetres over the extent of a flight.

const A = 6378137;
const E2 = 0.00669437999014;
const RAD = Math.PI / 180;

/** East and north of b from a [m]. */
export function offset(a, b) {
  const lat = (a.lat + b.lat) / 2 * RAD;
  const w2 = 1 - E2 * Math.sin(lat) ** 2;
  const north = A * (1 - E2) / w2 ** 1.5 * (b.lat - a.lat) * RAD;
  const lon = ((b.lon - a.lon + 540) % 360) - 180;
  return {east: A / Math.sqrt(w2) * Math.cos(lat) * lon * RAD, north};
}

export function distance(a, b) {
  const {east, north} = offset(a, b);
  return Math.hypot(east, north);
}

/** Clockwise from true north, degrees. */
export function bearing(a, b) {
  const {east, north} = offset(a, b);
  return (Math.atan2(east, north) / RAD + 360) % 360;
}

/** The point that lies so many metres east and north of a. */
export function shifted(a, east, north) {
  const w2 = 1 - E2 * Math.sin(a.lat * RAD) ** 2;
  return {
    lat: a.lat + north / (A * (1 - E2) / w2 ** 1.5) / RAD,
    lon: a.lon + east / (A / Math.sqrt(w2) * Math.cos(a.lat * RAD)) / RAD,
  };
}

/** Corners of a square around a point, as [lat, lon]: south-west and north-east. */
export function square(centre, half) {
  const from = shifted(centre, -half, -half);
  const to = shifted(centre, half, half);
  return [[from.lat, from.lon], [to.lat, to.lon]];
}
