// What the service says in its own terms, as people say it: [its text with {} for each number, English, German]. The
// numbers are put in where {0}, {1} stand. A text that is not here is shown as it came.

import {language} from "./texts.js";

const same = (text, german) => [text, text, german];
const number = (text) => text.replace("{}", "{0}").replace("{}", "{1}");
const LINES = [
  // weight of a map match
  ["information share {}", "weight {0} (1: all of its ground was new)", "Gewicht {0} (1: sein ganzer Boden war neu)"],
  // verdict on a flight
  same("no frame", "kein Bild"),
  same("no position", "keine Position"),
  same("not found on the map", "auf der Karte nicht gefunden"),
  ["claims worse than {} m", "its own accuracy is worse than {0} m", "die eigene Genauigkeit ist schlechter als {0} m"],
  ["no map match has confirmed the start", "the map has never confirmed the start", "die Karte hat den Start nie bestätigt"],
  ["no map match for over {} s", "nothing matched the map for over {0} s", "über {0} s lang passte nichts zur Karte"],
  ["{} of {} map matches were rejected", "{0} of {1} places found on the map contradicted the flight", "{0} von {1} Fundstellen auf der Karte widersprachen dem Flug"],
  same("start and map contradict each other: one of them is in the wrong place", "Startpunkt und Karte widersprechen sich: einer von beiden liegt falsch"),
  ["the map is found nowhere", "the images match the map nowhere", "die Bilder passen nirgends zur Karte"],
  ["take-off moved: no fix before the map", "the vehicle stood on something that moved at take-off", "das Fahrzeug stand beim Start auf etwas, das sich bewegte"],
  ["height/focal seems x{} off", "height or focal length seems wrong by a factor of {0}", "Höhe oder Brennweite scheint um den Faktor {0} falsch"],
  ["heading off by {} deg", "the heading is wrong by {0} degrees", "der Steuerkurs ist um {0} Grad falsch"],
  ["mount yaw off by {} deg", "the camera is turned in its mount by {0} degrees", "die Kamera ist in der Halterung um {0} Grad verdreht"],
  same("the map does not show where the flight is said to be: start or map is wrong", "die Karte zeigt den angegebenen Ort nicht: Startpunkt oder Karte ist falsch"),
  same("the frames are too low above the ground, or the height is wrong", "die Bilder sind zu tief über dem Boden aufgenommen, oder die Höhe ist falsch"),
  // why the autopilot gets no position
  ["no GPS_INPUT", "Terrafix sends nothing", "Terrafix sendet nichts"],
  same("not found on the map yet", "noch nicht auf der Karte gefunden"),
  same("no estimate yet", "noch keine Schätzung"),
  same("started in flight, and no map fix yet", "im Flug gestartet, und noch nicht auf der Karte gefunden"),
  ["nothing has measured that the start stands, and no map fix yet", "the start is not certain, and the map has not confirmed it", "der Startpunkt ist nicht gesichert, und die Karte hat ihn nicht bestätigt"],
  ["estimate is {} s old", "the newest position is {0} s old", "die neueste Position ist {0} s alt"],
  ["no map and no odometry, {} s without a map fix", "neither map nor odometry for {0} s", "seit {0} s weder Karte noch optische Wegmessung"],
  ["accuracy {} m is worse than {} m", "accuracy of {0} m, the limit is {1} m", "Genauigkeit {0} m, die Grenze ist {1} m"],
  ["speed accuracy {} m/s is worse than {} m/s", "speed known to {0} m/s only, the limit is {1} m/s", "Geschwindigkeit nur auf {0} m/s bekannt, die Grenze ist {1} m/s"],
  // what became of a given position
  ["no photo says its focal length; write a flight.toml with [camera] beside the photos", "no photo says its focal length: give it below", "kein Foto gibt die Brennweite an: unten angeben"],
  ["all images are computed; it is used with the next images, or when the flight is computed again", "all photos are computed: compute the flight again to use it", "alle Fotos sind berechnet: den Flug erneut berechnen, um sie zu verwenden"],
  same("used with the next frame; hint_answered tells what came of it", "wird mit dem nächsten Bild verwendet; das Ergebnis steht unter Ereignisse"),
  same("the position is lost and the whole map was searched; a user fix or a hint would help", "die Position ist verloren, und die ganze Karte wurde durchsucht; eine angegebene Position würde helfen"),
  same("all images are computed and the position is not found; a user fix or a hint would help", "alle Bilder sind berechnet, und die Position ist nicht gefunden; eine angegebene Position würde helfen"),
];
const TABLE = new Map(LINES.map(([text, english, german]) => [text, {en: number(english), de: german}]));

export function words(text) {
  const values = [];
  const key = (text ?? "").replace(/[-+]?\d+(?:\.\d+)?/g, (value) => { values.push(value); return "{}"; });
  const found = TABLE.get(key)?.[language()];
  return found === undefined ? text ?? "" : found.replace(/\{(\d)\}/g, (_, i) => values[Number(i)]);
}
