"use strict";
// Plans: one storey at a time, zoom and layers; and what is pointed at lights up wherever the page shows it.

const places = new Map(); // "room a12" or "edge a3" -> the elements that show it

function placeOf(element) {
  return element.dataset.room !== undefined ? "room " + element.dataset.room : "edge " + element.dataset.edge;
}

function indexPlaces() {
  for (const element of document.querySelectorAll("[data-room], [data-edge]")) {
    if (element.matches("a")) continue; // links point at a room, they don't show it
    const place = placeOf(element);
    if (!places.has(place)) places.set(place, []);
    places.get(place).push(element);
  }
}

export let lit = null;

export function light(place) {
  if (place === lit) return;
  for (const element of places.get(lit) || []) element.classList.remove("on");
  lit = place;
  for (const element of places.get(lit) || []) element.classList.add("on");
  document.dispatchEvent(new CustomEvent("lit", { detail: lit }));
}

function startHighlights() {
  indexPlaces();
  const pointed = (event) => (event.target.closest ? event.target.closest("[data-room], [data-edge]") : null);
  document.addEventListener("pointerover", (event) => {
    const element = pointed(event);
    if (element || (lit && !event.target.closest(".stage"))) light(element ? placeOf(element) : null);
  });
  document.addEventListener("focusin", (event) => {
    const element = pointed(event);
    if (element) light(placeOf(element));
  });
  const go = (event) => {
    const element = pointed(event);
    if (!element) return;
    if (element.matches("a")) event.preventDefault();
    light(placeOf(element));
    document.dispatchEvent(new CustomEvent("go", { detail: { place: placeOf(element), from: element } }));
    if (element.closest("svg")) showRow(placeOf(element));
  };
  document.addEventListener("click", go);
  document.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target.matches("tr[tabindex]")) go(event);
  });
}

function showRow(place) {
  const row = (places.get(place) || []).find((element) => element.matches("tr"));
  const frame = row && row.closest(".scroller");
  if (frame) frame.scrollTop = row.offsetTop - frame.clientHeight / 2; // the frame only: the page must not jump
}

function wordsOf(place) {
  const row = (places.get(place) || []).find((element) => element.matches("tr"));
  if (!row) return "";
  const heads = [...row.closest("table").tHead.rows[0].cells].map((cell) => cell.dataset.name || cell.textContent);
  const parts = [...row.cells].map((cell, i) => [heads[i], cell.textContent.trim()]).filter(([, text]) => text && text !== "–");
  return parts.map(([head, text]) => {
    const unit = /^(.*) (m|m²)$/.exec(head);
    return unit ? `${unit[1]} ${text} ${unit[2]}` : `${head} ${text}`;
  }).join(" · ");
}

export function roundLength(most) {
  const ten = 10 ** Math.floor(Math.log10(most));
  return [5, 2, 1].map((step) => step * ten).find((length) => length <= most);
}

function startPlan(view) {
  const sheet = view.querySelector(".sheet");
  const figures = [...sheet.querySelectorAll("figure")];
  const drawings = figures.map((figure) => figure.querySelector("svg"));
  const told = view.querySelector(".told");
  const hint = told.textContent;
  const home = drawings[0].getAttribute("viewBox").split(" ").map(Number);
  let box = [...home];
  let shown = 0;

  function draw(svg, frame, width, height) {
    const unit = Math.max(frame[2] / width, frame[3] / height);
    svg.setAttribute("viewBox", frame.map((value) => value.toFixed(1)).join(" "));
    svg.style.setProperty("--unit", unit.toFixed(4));
    for (const label of svg.querySelectorAll(".label")) {
      const clear = label.dataset.clear / unit; // pixels around the label's place
      label.classList.toggle("roomy", clear > 24);
      label.classList.toggle("tight", clear < 8);
      label.classList.toggle("tiny", clear < 3.5);
    }
    const spareX = (width * unit - frame[2]) / 2, spareY = (height * unit - frame[3]) / 2;
    const cm = roundLength(130 * unit);
    const scale = svg.querySelector(".scale");
    scale.setAttribute("transform", `translate(${frame[0] - spareX + 8 * unit} ${frame[1] + frame[3] + spareY - 12 * unit})`);
    scale.querySelector("path").setAttribute("d", `M0 ${-5 * unit}V0H${cm}V${-5 * unit}`);
    const text = scale.querySelector("text");
    text.textContent = cm >= 100 ? `${cm / 100} m` : `${cm} cm`;
    text.setAttribute("x", cm + 6 * unit);
    text.setAttribute("y", 0);
    const axes = svg.querySelector(".axes");
    axes.setAttribute("transform", `translate(${frame[0] + frame[2] + spareX - 40 * unit} ${frame[1] + frame[3] + spareY - 40 * unit})`);
    axes.firstElementChild.setAttribute("transform", `scale(${unit})`);
  }

  function redraw() {
    const svg = drawings[shown];
    if (svg.clientWidth) draw(svg, box, svg.clientWidth, svg.clientHeight);
  }

  function show(storey) {
    shown = storey;
    figures.forEach((figure, i) => { figure.hidden = i !== storey; });
    for (const button of view.querySelectorAll("button[data-storey]")) {
      button.setAttribute("aria-pressed", String(Number(button.dataset.storey) === storey));
    }
    filterParts();
    redraw();
  }

  function filterParts() { // rows of rooms of other storeys; rows and parts of the plan that are less sure than asked for
    const all = view.querySelector('input[data-layer="all"]');
    const least = Number(view.querySelector("input[data-sure]")?.value ?? 0) / 100;
    const unsure = (element) => Number(element.dataset.sure ?? 1) < least;
    for (const part of sheet.querySelectorAll("[data-sure]")) part.classList.toggle("unsure", unsure(part));
    for (const part of sheet.querySelectorAll(".label, .door")) {
      const away = part.matches(".label") && !(all && all.checked) && !figures[shown].contains(part);
      for (const element of places.get(placeOf(part)) || []) {
        if (element.matches("tr")) element.classList.toggle("off", away || unsure(element));
      }
    }
  }

  function zoom(factor, x, y) { // about a point of the paper
    const w = Math.min(Math.max(box[2] * factor, home[2] / 60), home[2] * 1.5);
    const f = w / box[2];
    box = [x - (x - box[0]) * f, y - (y - box[1]) * f, w, box[3] * f];
    redraw();
  }

  function paper(event) { // the point of the paper under the pointer, cm
    const svg = drawings[shown];
    const to = svg.getScreenCTM().inverse();
    return [to.a * event.clientX + to.e, to.d * event.clientY + to.f, to.a];
  }

  view.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    if (button.dataset.storey !== undefined) show(Number(button.dataset.storey));
    const middle = [box[0] + box[2] / 2, box[1] + box[3] / 2];
    if (button.dataset.zoom === "in") zoom(0.7, ...middle);
    if (button.dataset.zoom === "out") zoom(1 / 0.7, ...middle);
    if (button.dataset.zoom === "all") { box = [...home]; redraw(); }
  });
  view.addEventListener("change", (event) => {
    if (event.target.dataset.layer) sheet.classList.toggle("hide-" + event.target.dataset.layer, !event.target.checked);
    if (event.target.dataset.layer === "all" || event.target.dataset.sure !== undefined) filterParts();
  });
  sheet.addEventListener("wheel", (event) => {
    if (!sheet.contains(document.activeElement) && !event.ctrlKey) return; // the page scrolls until one has clicked here
    event.preventDefault();
    const [x, y] = paper(event);
    zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), x, y);
  }, { passive: false });
  sheet.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (step) {
      box[0] += step[0] * box[2] * 0.1;
      box[1] += step[1] * box[3] * 0.1;
      redraw();
    } else if ("+-=".includes(event.key)) zoom(event.key === "-" ? 1.3 : 1 / 1.3, box[0] + box[2] / 2, box[1] + box[3] / 2);
    else return;
    event.preventDefault();
  });
  startDrag(sheet, (pointers, dx, dy, pinch, event) => {
    const [x, y, unit] = paper(event);
    box[0] -= dx * unit;
    box[1] -= dy * unit;
    if (pinch !== 1) zoom(1 / pinch, x, y);
    redraw();
  });
  sheet.addEventListener("pointermove", (event) => {
    const svg = drawings[shown];
    const [x, y] = paper(event);
    const [a, b, c, d, e, f] = svg.dataset.back.split(" ").map(Number);
    const at = `x ${(a * x + b * y + c).toFixed(2)} m, y ${(d * x + e * y + f).toFixed(2)} m`;
    told.textContent = [wordsOf(lit), at].filter(Boolean).join(" · ");
  });
  sheet.addEventListener("pointerleave", () => { told.textContent = hint; });
  document.addEventListener("lit", (event) => {
    if (!sheet.matches(":hover")) told.textContent = wordsOf(event.detail) || hint;
  });
  document.addEventListener("go", (event) => {
    const element = (places.get(event.detail.place) || []).find((one) => view.contains(one) && one.closest("svg"));
    const storey = element ? figures.findIndex((figure) => figure.contains(element)) : -1;
    const here = (places.get(event.detail.place) || []).some((one) => figures[shown].contains(one));
    if (storey >= 0 && !here) show(storey);
    if (element && element.matches(".change") && !event.detail.from.closest("svg")) { // a change is shown from near by
      const { x, y, width, height } = element.getBBox(), wide = Math.min(Math.max(3 * Math.max(width, height), home[2] / 8), 0.6 * home[2]);
      box = [x + width / 2 - wide / 2, y + height / 2 - (wide * home[3]) / home[2] / 2, wide, (wide * home[3]) / home[2]];
      redraw();
    }
  });
  new ResizeObserver(redraw).observe(sheet);
  window.addEventListener("beforeprint", () => drawings.forEach((svg) => draw(svg, home, 680, 680 * Math.min(home[3] / home[2], 1.2))));
  window.addEventListener("afterprint", redraw);
  show(0);
}

// Dragging with a mouse, one finger or two: move(pointers, dx, dy, pinch, event), in pixels.
export function startDrag(area, move) {
  const held = new Map();
  const spread = () => {
    const [a, b] = [...held.values()];
    return b ? Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) : 0;
  };
  area.addEventListener("pointerdown", (event) => held.set(event.pointerId, event));
  window.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return;
    const before = spread();
    held.set(event.pointerId, event);
    const share = 1 / held.size;
    move(held.size, (event.clientX - last.clientX) * share, (event.clientY - last.clientY) * share, before ? spread() / before : 1, event);
  });
  for (const name of ["pointerup", "pointercancel"]) window.addEventListener(name, (event) => held.delete(event.pointerId));
}
