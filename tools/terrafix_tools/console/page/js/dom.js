// Elements. Text is always set as text, never as HTML: names and reasons come from others.

/** h("button", {class: "x", onclick: f}, "text", child): an element. Attributes that are null or false are left out. */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "style") element.style.cssText = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** The same for SVG. */
export function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

export function fill(element, ...children) {
  element.replaceChildren(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
}

/** Tells a screen reader, and nobody else. */
export function say(text) {
  document.getElementById("said").textContent = text;
}

let toastTimer = 0;
/** A message at the edge of the window. Errors stay until they are closed. */
export function toast(text, isError = false) {
  document.querySelector(".toast")?.remove();
  clearTimeout(toastTimer);
  const box = h("div", {class: `toast${isError ? " bad" : ""}`, role: isError ? "alert" : "status"}, h("span", {}, text));
  const close = h("button", {class: "plain", "aria-label": "×", onclick: () => box.remove()}, "×");
  box.append(close);
  document.body.append(box);
  if (!isError) toastTimer = setTimeout(() => box.remove(), 6000);
}
