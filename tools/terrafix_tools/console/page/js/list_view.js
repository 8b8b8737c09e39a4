// All flights, and what to do when there is none.

import {get, remove} from "./api.js";
import {fill, h, toast} from "./dom.js";
import {bytes, dateTime, number} from "./format.js";
import {mayAct} from "./session.js";
import {t} from "./texts.js";

const POLL_MS = 3000;

export function stateBadge(flight) {
  const broken = flight.error ? "failed" : flight.state;
  return h("span", {class: `badge ${broken}`}, t(`state_${broken}`));
}

export class ListView {
  constructor(main) {
    this.main = main;
  }

  async open() {
    await this.read();
    this.timer = setInterval(() => this.read().catch(() => this.lost()), POLL_MS);
  }

  close() {
    clearInterval(this.timer);
    this.closed = true;
  }

  lost() {
    this.text = "";
    if (!this.main.querySelector(".lost")) this.main.prepend(h("p", {class: "banner lost", role: "alert"}, t("list_lost")));
  }

  async read() {
    const [{flights}, health] = await Promise.all([get("/flights"), get("/health")]);
    const text = JSON.stringify([flights, health.waiting, health.workers]);
    if (this.closed || text === this.text) return; // the focus stays where it is
    this.text = text;
    fill(this.main, h("div", {class: "page"}, h("h1", {}, t("flights")), flights.length ? this.table(flights) : this.empty(),
      h("p", {class: "soft"}, t("service_line", health.version, number(health.workers), number(health.max_workers),
        number(health.waiting), bytes(health.disk_free_mb * 1e6)))));
  }

  empty() {
    return h("section", {class: "card empty"}, h("h2", {}, t("no_flights")), h("p", {}, t("no_flights_why")),
      mayAct() ? h("p", {}, h("a", {class: "button primary", href: "#/new"}, t("new_flight"))) : null,
      h("p", {}, t("or_live")), h("pre", {}, "terrafix serve --bus auto --maps FOLDER"));
  }

  table(flights) {
    const row = (flight) => h("li", {class: "card flight-row"},
      h("a", {href: `#/flight/${flight.flight_id}`, class: "stretched"}, flight.name || flight.flight_id),
      h("span", {}, stateBadge(flight), flight.kind === "live" ? h("span", {class: "badge live"}, t("kind_live")) : null,
        flight.request ? h("span", {class: "badge blocked"}, t("asks")) : null,
        flight.verdict ? h("span", {class: "badge completed"}, t(`whole_${flight.verdict.verdict.replaceAll(" ", "_")}`)) : null),
      h("span", {class: "soft"}, flight.kind === "live" ? "" : t("images_done", number(flight.images.processed), number(flight.images.uploaded))),
      h("span", {class: "soft"}, dateTime(flight.created_at)),
      mayAct() && flight.kind !== "live" && flight.images.uploaded ? h("a", {class: "button above", href: `#/new/${flight.flight_id}`}, t("duplicate")) : null,
      mayAct() ? h("button", {class: "above", onclick: () => this.remove(flight), "aria-label": t("delete_named", flight.name || flight.flight_id)},
        t("delete")) : null);
    return h("ul", {class: "flights"}, flights.map(row));
  }

  async remove(flight) {
    if (!confirm(t("delete_sure", flight.name || flight.flight_id))) return;
    try {
      await remove(`/flights/${flight.flight_id}`);
      await this.read();
    } catch (error) {
      toast(error.message, true);
    }
  }
}
