// Results as files.

import {ellipseRing} from "./geo.js";

const COLUMNS = ["frame_id", "frame_uid", "file", "t_s", "lat", "lon", "altitude", "agl_m", "heading", "heading_sigma", "confidence", "semi_major_m", "semi_minor_m",
  "bearing_deg", "source", "match", "inliers", "search", "fragment_id", "joined", "refined",
  "refined_by", "qw", "qx", "qy", "qz", "covariance", "m_per_unit", "error"];

const flat = (result) => {
  const [qw, qx, qy, qz] = result.orientation ?? [];
  return {...result, ...result.gps, ...result.ellipse, qw, qx, qy, qz, covariance: result.covariance?.join(" ")};
};
const cell = (value) => {
  const text = value === null || value === undefined ? "" : String(value);
  return /[",\n]/.test(text) ? `"${text.replaceAll("\"", "\"\"")}"` : text;
};

export function csv(results) {
  const lines = results.map(flat).map((row) => COLUMNS.map((name) => cell(row[name])).join(","));
  return [COLUMNS.join(","), ...lines, ""].join("\n");
}

/** The track, a point for each frame and its 95 % ellipse (RFC 7946: longitude first). */
export function geoJson(results) {
  const placed = results.filter((result) => result.gps);
  const feature = (geometry, properties) => ({type: "Feature", geometry, properties});
  const properties = ({gps, ellipse, ...rest}) => ({...rest, ...ellipse});
  const features = placed.map((r) => feature({type: "Point", coordinates: [r.gps.lon, r.gps.lat]}, {kind: "frame", ...properties(r)}));
  for (const r of placed) {
    if (r.ellipse) features.push(feature({type: "Polygon", coordinates: [ellipseRing(r.gps, r.ellipse)]}, {kind: "ellipse95", frame_id: r.frame_id}));
  }
  if (placed.length > 1) {
    features.unshift(feature({type: "LineString", coordinates: placed.map((r) => [r.gps.lon, r.gps.lat])}, {kind: "track"}));
  }
  return JSON.stringify({type: "FeatureCollection", features});
}
