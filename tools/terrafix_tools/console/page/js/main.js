// Start, session, and which view is shown: #/ flights, #/new a new flight, #/flight/ID one of them.

import {Problem, get, post, remove} from "./api.js";
import {fill, h} from "./dom.js";
import {FlightView} from "./flight_view.js";
import {ListView} from "./list_view.js";
import {NewView} from "./new_view.js";
import {coordinateFormat, setCoordinateFormat} from "./format.js";
import {mayAct, session, setSession} from "./session.js";
import {LANGUAGES, language, setLanguage, t} from "./texts.js";

const app = document.getElementById("app");
let view = null;

const THEMES = ["system", "light", "dark"];
const stored = (name) => { try { return localStorage.getItem(name); } catch { return null; } };
const store = (name, value) => { try { localStorage.setItem(name, value); } catch { /* private window */ } };

function setTheme(theme) {
  store("theme", theme);
  if (theme === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
}

function choice(label, values, value, name, onchange) {
  return h("label", {class: "choice"}, h("span", {class: "unseen"}, label),
    h("select", {onchange: (event) => onchange(event.target.value), title: label},
      values.map((one) => h("option", {value: one, selected: one === value}, name(one)))));
}

function bar() {
  const out = session.required && session.role
    ? h("button", {onclick: signOut}, `${t(`role_${session.role}`)} · ${t("sign_out")}`) : null;
  return h("header", {class: "bar"},
    h("a", {class: "brand", href: "#/", "aria-label": "Terrafix"}, h("img", {src: "icon.svg", alt: "", width: 26, height: 26}), h("span", {}, "Terrafix")),
    h("div", {class: "bar-middle", id: "bar-middle"}),
    h("button", {class: "menu", "aria-label": t("menu"), "aria-expanded": "false", onclick: (event) => {
      event.target.setAttribute("aria-expanded", String(document.querySelector(".bar nav").classList.toggle("open")));
    }}, "☰"),
    h("nav", {"aria-label": t("menu")},
      session.role ? h("a", {class: "button", href: "#/"}, t("flights")) : null,
      mayAct() ? h("a", {class: "button", href: "#/new"}, t("new_flight")) : null,
      choice(t("theme"), THEMES, stored("theme") ?? "system", (one) => t(`theme_${one}`), setTheme),
      choice(t("language"), LANGUAGES, language(), (one) => one.toUpperCase(), (one) => {
        store("language", one);
        setLanguage(one);
        route();
      }), out));
}

async function signOut() {
  await remove("/session");
  await start();
}

function signIn() {
  const field = h("input", {type: "password", autocomplete: "off", id: "token", required: true, spellcheck: "false"});
  const wrong = h("p", {class: "error", role: "alert"});
  const submit = async (event) => {
    event.preventDefault();
    try {
      setSession(await post("/session", {token: field.value.trim()}));
      field.value = "";
      route();
    } catch (error) {
      wrong.textContent = error.status === 401 ? t("wrong_token") : error.message;
    }
  };
  fill(app, bar(), h("main", {class: "narrow"}, h("form", {class: "card", onsubmit: submit},
    h("h1", {}, t("sign_in")), h("p", {}, t("sign_in_why")),
    h("label", {for: "token"}, t("token")), field, wrong, h("button", {class: "primary"}, t("sign_in")))));
  field.focus();
}

async function route() {
  view?.close();
  view = null;
  if (session.required && !session.role) return signIn();
  const [, kind, id] = location.hash.split("/");
  const main = h("main", {id: "main"});
  fill(app, bar(), main);
  const middle = document.getElementById("bar-middle");
  const opened = kind === "flight" && id ? new FlightView(main, middle, id) : kind === "new" && mayAct() ? new NewView(main, id) : new ListView(main);
  view = opened;
  document.title = "Terrafix";
  try {
    await opened.open();
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    if (error.status === 401) return start();
    if (view === opened) {
      fill(main, h("div", {class: "narrow"}, h("div", {class: "card"}, h("h1", {}, t("not_shown")), h("p", {role: "alert"}, error.message),
        h("button", {class: "primary", onclick: route}, t("again")))));
    }
  }
}

async function start() {
  document.documentElement.lang = language();
  try {
    setSession(await get("/session"));
  } catch (error) {
    fill(app, h("main", {class: "narrow"}, h("div", {class: "card"}, h("h1", {}, t("no_service")), h("p", {}, t("no_service_why")))));
    setTimeout(start, 3000);
    return;
  }
  route();
}

setLanguage(stored("language") ?? navigator.language.slice(0, 2));
setTheme(stored("theme") ?? "system");
setCoordinateFormat(stored("format"));
addEventListener("pagehide", () => {
  store("format", coordinateFormat());
  view?.close(); // a page that the browser keeps for "back" would keep its stream, and a browser has six connections
});
addEventListener("pageshow", (event) => { if (event.persisted) route(); });
addEventListener("hashchange", route);
start();
