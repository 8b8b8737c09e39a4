// Behaviour of the flight report, inlined into the page: the pointer's moment in all charts, layers, zoom of the map.
(() => {
  const frames = JSON.parse(document.getElementById("frames").textContent);
  const map = document.getElementById("map");
  const tip = document.getElementById("tip");
  const here = document.getElementById("here");
  const charts = [...document.querySelectorAll("svg[data-t1]")];
  const dots = {}, byRow = {};
  frames.forEach((frame) => (byRow[frame.i] = frame));
  if (map) map.querySelectorAll(".dots circle").forEach((c) => (dots[c.dataset.i] = c));

  function show(i, event) {
    const frame = byRow[i], dot = dots[i];
    if (here) {
      here.setAttribute("r", dot ? 2.8 * dot.getAttribute("r") : 0);
      if (dot) for (const a of ["cx", "cy"]) here.setAttribute(a, dot.getAttribute(a));
    }
    for (const svg of charts) {
      const cursor = svg.querySelector(".cursor"), x0 = +svg.dataset.x0, x1 = +svg.dataset.x1;
      const x = x0 + (x1 - x0) * Math.min(1, Math.max(0, frame.t / svg.dataset.t1));
      cursor.setAttribute("x1", x);
      cursor.setAttribute("x2", x);
      cursor.style.strokeOpacity = 0.55;
    }
    if (!event) return;
    tip.innerHTML = frame.h;
    tip.style.opacity = 1;
    tip.style.left = Math.min(innerWidth - tip.offsetWidth - 12, event.clientX + 18) + "px";
    tip.style.top = Math.max(8, Math.min(innerHeight - tip.offsetHeight - 12, event.clientY + 18)) + "px";
  }
  const hide = () => (tip.style.opacity = 0);

  function nearest(t) {
    let best = frames[0];
    for (const f of frames) if (Math.abs(f.t - t) < Math.abs(best.t - t)) best = f;
    return best.i;
  }
  for (const svg of charts) {
    svg.addEventListener("pointermove", (event) => {
      const box = svg.getBoundingClientRect(), x0 = +svg.dataset.x0, x1 = +svg.dataset.x1;
      const x = ((event.clientX - box.left) / box.width) * svg.viewBox.baseVal.width;
      if (x < x0 || x > x1) hide();
      else show(nearest(((x - x0) / (x1 - x0)) * svg.dataset.t1), event);
    });
    svg.addEventListener("pointerleave", hide);
  }
  if (!map) return;

  document.querySelectorAll("figure[data-i], a[data-i]").forEach((item) =>
    item.addEventListener("click", (event) => {
      event.preventDefault();
      show(+item.dataset.i);
      map.scrollIntoView({ behavior: "smooth", block: "center" });
    }));
  document.querySelectorAll("[data-layer]").forEach((box) => {
    const set = () => map.querySelectorAll("." + box.dataset.layer)
      .forEach((g) => (g.style.display = box.checked ? "" : "none"));
    box.addEventListener("change", set);
    set();
  });

  const view = map.viewBox.baseVal, width = view.width, height = view.height;
  const radius = Object.values(dots).length ? +Object.values(dots)[0].getAttribute("r") : 0;
  const keepInside = () => {
    view.x = Math.max(0, Math.min(width - view.width, view.x));
    view.y = Math.max(0, Math.min(height - view.height, view.y));
  };
  const place = (event) => {
    const box = map.getBoundingClientRect();
    return [view.x + ((event.clientX - box.left) / box.width) * view.width,
      view.y + ((event.clientY - box.top) / box.height) * view.height];
  };
  function zoom(factor, x = view.x + view.width / 2, y = view.y + view.height / 2) {
    const q = Math.min(width, view.width * factor) / view.width;
    view.x = x - (x - view.x) * q;
    view.y = y - (y - view.y) * q;
    view.width *= q;
    view.height *= q;
    keepInside();
    for (const i in dots) dots[i].setAttribute("r", radius * Math.sqrt(view.width / width));
    here.setAttribute("r", 0);
  }
  document.querySelectorAll(".zoom button").forEach((b) => b.addEventListener("click", () => zoom(+b.dataset.k)));
  map.addEventListener("dblclick", (event) => zoom(0.5, ...place(event)));
  let grip = null;
  map.addEventListener("pointerdown", (event) => {
    grip = [event.clientX, event.clientY, view.x, view.y];
    map.classList.add("drag");
  });
  addEventListener("pointerup", () => {
    grip = null;
    map.classList.remove("drag");
  });
  map.addEventListener("pointerleave", hide);
  map.addEventListener("pointermove", (event) => {
    if (grip) {
      const box = map.getBoundingClientRect();
      view.x = grip[2] - ((event.clientX - grip[0]) / box.width) * view.width;
      view.y = grip[3] - ((event.clientY - grip[1]) / box.height) * view.height;
      keepInside();
      return hide();
    }
    const [x, y] = place(event);
    let best = -1, reach = 24 * view.width / map.getBoundingClientRect().width;
    for (const i in dots) {
      const d = Math.hypot(dots[i].getAttribute("cx") - x, dots[i].getAttribute("cy") - y);
      if (d < reach) [reach, best] = [d, +i];
    }
    if (best < 0) hide();
    else show(best, event);
  });
})();
