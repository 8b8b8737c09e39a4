// Where a position comes from: each source has a colour, a shape and a stroke, because colours alone are not enough.

import {svg} from "./dom.js";

export const SOURCES = {
  satellite_anchored: {shape: "circle", colour: "#2f81f0", dash: []},
  visual_propagated: {shape: "diamond", colour: "#f2a51f", dash: [8, 5]},
  dead_reckoned: {shape: "triangle", colour: "#e0487c", dash: [2, 5]},
};
export const UNKNOWN = {shape: "circle", colour: "#9aa1a9", dash: [2, 5]};
export const styleOf = (source) => SOURCES[source] ?? UNKNOWN;

// Steps of the search in which the images contradict the position that was carried on.
const SEARCHING = ["widen", "whole_map", "ask"];

/** State of the position of a frame: "placed" (on the map, by a match of its own or by the flight solved as a whole),
    "propagated" (carried on from there), "unknown". */
export function placement(result) {
  if (!result?.gps) return "unknown";
  if (result.refined_by === "finalised" || result.refined_by === "flight") return "placed";
  if (SEARCHING.includes(result.search) || (result.source === "not_placed" && !result.refined)) return "unknown";
  return result.source === "satellite_anchored" ? "placed" : "propagated";
}

/** Adds the outline of a shape to the path of a canvas. */
export function trace(context, shape, x, y, r) {
  context.beginPath();
  if (shape === "diamond") {
    context.moveTo(x, y - 1.3 * r);
    context.lineTo(x + 1.3 * r, y);
    context.lineTo(x, y + 1.3 * r);
    context.lineTo(x - 1.3 * r, y);
  } else if (shape === "triangle") {
    context.moveTo(x, y - 1.3 * r);
    context.lineTo(x + 1.25 * r, y + r);
    context.lineTo(x - 1.25 * r, y + r);
  } else {
    context.arc(x, y, r, 0, 2 * Math.PI);
  }
  context.closePath();
}

const POINTS = {diamond: "8,1 15,8 8,15 1,8", triangle: "8,1 15,14 1,14"};

/** The sign of a source beside its name. */
export function sign(source) {
  const {shape, colour} = styleOf(source);
  const form = POINTS[shape]
    ? svg("polygon", {points: POINTS[shape], fill: colour})
    : svg("circle", {cx: 8, cy: 8, r: 6.5, fill: colour});
  return svg("svg", {viewBox: "0 0 16 16", class: "sign", "aria-hidden": "true"}, form);
}
