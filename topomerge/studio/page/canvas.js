// A plan on a canvas: drawn once into a picture that is moved and scaled while one pans, so that a thousand rooms cost nothing then.

import { apply, boxOf, distance, invert, nearestOnSegment, parseRings } from "./geometry.js";
import { roundLength } from "./plan.js";
import { hexOf } from "./scene.js";

const MARGIN = 0.5; // of the width, that the picture reaches beyond the canvas on each side
const REST = 140; // ms without a move until the picture is drawn anew
const QUICK = 10; // ms: a picture that is drawn faster is drawn anew while one pans, too
const TAP = 6; // pixels that a finger may slip in a click
const FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif";
const NAMES = ["--paper", "--ink", "--soft", "--seen", "--wall", "--accent", "--stairs", "--fill", "--halo", "--good", "--warn", "--mark", "--of-a", "--of-b", "--link"];

export function preparePlan(plan) { // what drawing and clicks need of each room, made once
  for (const storey of plan.storeys) {
    storey.wallPath = new Path2D(storey.walls);
    storey.seenPath = new Path2D(storey.seen);
    storey.byRoom = new Map();
    for (const room of storey.rooms) {
      room.path = new Path2D(room.d);
      room.rings = parseRings(room.d);
      room.box = boxOf(room.rings);
      storey.byRoom.set(room.i, room);
    }
  }
  plan.toPaper = invert(plan.back);
  return plan;
}

export class PlanCanvas {
  // overlay(pen, view): what is drawn over the plan at each frame; on: handlers { click, hover, drag }.
  constructor(place, { overlay = () => {}, on = {}, layers = {} } = {}) {
    this.canvas = document.createElement("canvas");
    this.canvas.className = "plan-canvas";
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "application");
    place.append(this.canvas);
    Object.assign(this, { overlay, on, plan: null, storey: 0, selected: new Set(), frames: 0, cursor: null, sheets: [] });
    this.layers = { labels: true, doors: true, graph: false, landmarks: true, ...layers };
    this.view = { x: 0, y: 0, scale: 0.1 }; // paper at the canvas's corner, pixels a cm
    this.picture = null;
    this.pointers = new Map();
    this.gesture = null;
    this.listen();
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.colours = null; this.refresh(); });
  }

  setPlan(plan, keepView = false) {
    this.plan = plan;
    this.storey = Math.min(this.storey, plan.storeys.length - 1);
    if (!keepView) this.fit();
    this.refresh();
  }

  get data() { return this.plan.storeys[this.storey]; }

  show(storey) { this.storey = storey; this.selected.clear(); this.refresh(); }

  fit(box = [0, 0, ...(this.plan ? this.plan.size : [1000, 1000])]) {
    this.home = box;
    const [w, h] = [this.canvas.clientWidth || 800, this.canvas.clientHeight || 600];
    const scale = Math.min(w / (box[2] - box[0]), h / (box[3] - box[1])) * 0.92;
    this.view = { scale, x: (box[0] + box[2] - w / scale) / 2, y: (box[1] + box[3] - h / scale) / 2 };
    this.refresh();
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2), { clientWidth: w, clientHeight: h } = this.canvas;
    if (!w || !h) return;
    Object.assign(this.canvas, { width: Math.round(w * ratio), height: Math.round(h * ratio) });
    this.ratio = ratio;
    if (this.home && !this.touched) this.fit(this.home);
    this.refresh();
  }

  toPaper(x, y) { return [this.view.x + x / this.view.scale, this.view.y + y / this.view.scale]; }

  toScreen([x, y]) { return [(x - this.view.x) * this.view.scale, (y - this.view.y) * this.view.scale]; }

  toMetres(paper) { return apply(this.plan.back, paper); }

  refresh() { this.picture = null; this.ask(); }

  ask() {
    if (!this.asked) requestAnimationFrame(() => this.frame());
    this.asked = true;
  }

  frame() {
    this.asked = false;
    if (!this.plan || !this.canvas.width) return;
    const pen = this.canvas.getContext("2d", { alpha: false });
    if (!this.picture || (!this.fits() && (!this.moving || this.took < QUICK))) this.paint();
    const { view, picture, ratio } = this;
    const k = view.scale / picture.scale;
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.fillStyle = this.colour("--paper");
    pen.fillRect(0, 0, this.canvas.width, this.canvas.height);
    pen.imageSmoothingEnabled = k !== 1;
    const at = [(picture.x - view.x) * view.scale * ratio, (picture.y - view.y) * view.scale * ratio].map((v) => (k === 1 ? Math.round(v) : v));
    pen.drawImage(picture.image, ...at, picture.image.width * k, picture.image.height * k);
    this.enter(pen, view, ratio);
    this.drawSelection(pen);
    this.overlay(pen, this);
    this.drawRulers(pen);
    this.frames++;
    this.canvas.dataset.frames = this.frames;
  }

  fits() { // is the picture sharp, and does it reach as far as the canvas?
    const { picture, view } = this, [w, h] = [this.canvas.width / this.ratio / view.scale, this.canvas.height / this.ratio / view.scale];
    return picture.scale === view.scale && picture.x <= view.x && picture.y <= view.y &&
      picture.x + picture.width >= view.x + w && picture.y + picture.height >= view.y + h;
  }

  paint() {
    const began = performance.now(), { canvas, view, ratio } = this;
    const [w, h] = [canvas.width * (1 + 2 * MARGIN), canvas.height * (1 + 2 * MARGIN)].map(Math.round);
    if (!this.image || this.image.width !== w || this.image.height !== h) {
      this.image = document.createElement("canvas");
      Object.assign(this.image, { width: w, height: h });
    }
    const x = view.x - (canvas.width * MARGIN) / ratio / view.scale, y = view.y - (canvas.height * MARGIN) / ratio / view.scale;
    this.picture = { image: this.image, x, y, scale: view.scale, width: w / ratio / view.scale, height: h / ratio / view.scale };
    const pen = this.image.getContext("2d", { alpha: false });
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.fillStyle = this.colour("--paper");
    pen.fillRect(0, 0, w, h);
    this.enter(pen, this.picture, ratio);
    if (this.sheets.length) this.drawSheets(pen);
    else this.drawPlan(pen);
    this.took = performance.now() - began;
  }

  enter(pen, { x, y, scale }, ratio) {
    const k = scale * ratio;
    pen.setTransform(k, 0, 0, k, -x * k, -y * k);
    pen.lineCap = pen.lineJoin = "round";
  }

  px(pixels) { return pixels / this.view.scale; }

  colour(name) {
    this.colours ??= Object.fromEntries(NAMES.map((one) => [one, hexOf(one)]));
    return this.colours[name];
  }

  drawSheets(pen) { // walls of several maps over each other, each in its colour: [{ plan, storey, matrix, colour, share, walls }]
    pen.globalCompositeOperation = matchMedia("(prefers-color-scheme: dark)").matches ? "screen" : "multiply";
    for (const { plan, storey, matrix, colour, share, walls } of this.sheets) {
      const data = plan.storeys[storey];
      if (!data || !share) continue;
      pen.save();
      const [a, b, c, d, e, f] = matrix;
      pen.transform(a, d, b, e, c, f);
      pen.fillStyle = this.colour(colour);
      pen.globalAlpha = 0.16 * share;
      for (const room of data.rooms) pen.fill(room.path, "evenodd");
      pen.globalAlpha = share;
      pen.fill(walls || data.wallPath, "evenodd");
      pen.restore();
    }
    pen.globalCompositeOperation = "source-over";
  }

  drawPlan(pen) {
    const data = this.data, fill = Number(this.colour("--fill"));
    pen.fillStyle = this.colour("--seen");
    pen.fill(data.seenPath, "evenodd");
    for (const room of data.rooms) {
      pen.globalAlpha = room.looked ? 0.5 * fill : fill;
      pen.fillStyle = room.colour;
      pen.fill(room.path, "evenodd");
    }
    pen.globalAlpha = 1;
    pen.fillStyle = this.colour("--wall");
    pen.fill(data.wallPath, "evenodd");
    for (const window of data.windows) this.drawWindow(pen, window.line);
    pen.strokeStyle = this.colour("--ink");
    pen.lineWidth = this.px(1.2);
    pen.setLineDash([this.px(5), this.px(4)]);
    for (const line of data.narrows) this.stroke(pen, line);
    pen.setLineDash([]);
    if (this.layers.graph) this.drawGraph(pen, data);
    if (this.layers.doors) this.drawDoors(pen, data);
    if (this.layers.labels) this.drawLabels(pen, data);
    if (this.layers.landmarks) this.drawLandmarks(pen, data);
  }

  stroke(pen, [x1, y1, x2, y2]) {
    pen.beginPath();
    pen.moveTo(x1, y1);
    pen.lineTo(x2, y2);
    pen.stroke();
  }

  drawWindow(pen, line) {
    for (const [name, width] of [["--paper", 24], ["--ink", 13], ["--paper", 8]]) {
      pen.strokeStyle = this.colour(name);
      pen.lineWidth = width;
      pen.lineCap = "butt";
      this.stroke(pen, line);
    }
    pen.lineCap = "round";
  }

  drawDoors(pen, data) {
    for (const door of data.doors) {
      pen.lineCap = "butt";
      pen.strokeStyle = this.colour("--paper");
      pen.lineWidth = 24;
      this.stroke(pen, door.line);
      pen.strokeStyle = this.colour("--accent");
      pen.lineWidth = this.px(door.state === "shut" ? 5 : door.kind === "opening" ? 1.5 : 2.5);
      if (door.kind === "opening") pen.setLineDash([this.px(4), this.px(3)]);
      this.stroke(pen, door.line);
      pen.setLineDash([]);
    }
    pen.lineCap = "round";
    pen.strokeStyle = pen.fillStyle = this.colour("--stairs");
    for (const stairs of data.stairs) {
      pen.lineWidth = this.px(1.5);
      const [x1, y1, x2, y2] = stairs.line;
      this.stroke(pen, stairs.line);
      const angle = Math.atan2(y2 - y1, x2 - x1), long = Math.hypot(x2 - x1, y2 - y1) || 1;
      const half = 50 * Math.max(stairs.width, 0.6), [u, v] = [Math.cos(angle), Math.sin(angle)];
      pen.lineWidth = this.px(1);
      for (let s = 0; stairs.kind === "stairs" && s <= long; s += 30) {
        this.stroke(pen, [x1 + u * s + v * half, y1 + v * s - u * half, x1 + u * s - v * half, y1 + v * s + u * half]);
      }
      pen.font = `${this.px(10.5)}px ${FONT}`;
      pen.textAlign = "center";
      this.text(pen, `${stairs.way} to ${stairs.to}`.trim(), (x1 + x2) / 2, (y1 + y2) / 2 - this.px(8), "--stairs");
    }
  }

  drawGraph(pen, data) {
    pen.strokeStyle = this.colour("--link");
    pen.lineWidth = this.px(1.1);
    pen.globalAlpha = 0.4;
    for (const door of data.doors) {
      const middle = [(door.line[0] + door.line[2]) / 2, (door.line[1] + door.line[3]) / 2];
      for (const i of door.rooms) {
        const room = data.byRoom.get(i);
        if (room) this.stroke(pen, [room.x, room.y, ...middle]);
      }
    }
    pen.globalAlpha = 1;
  }

  text(pen, words, x, y, colour = "--ink") {
    pen.globalAlpha = 0.8;
    pen.strokeStyle = this.colour("--halo");
    pen.lineWidth = this.px(2.6);
    pen.strokeText(words, x, y);
    pen.globalAlpha = 1;
    pen.fillStyle = this.colour(colour);
    pen.fillText(words, x, y);
  }

  drawLabels(pen, data) { // as in the report: what has no room is not drawn
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    for (const room of data.rooms) {
      const clear = room.clear * this.view.scale;
      if (clear < 3.5) continue;
      const roomy = clear > 24, words = room.name || `${room.area.toFixed(1)} m²`;
      pen.font = `650 ${this.px(clear < 8 ? 9.5 : 12)}px ${FONT}`;
      this.text(pen, String(room.i), room.x, room.y - (roomy ? this.px(6) : 0));
      if (!roomy) continue;
      pen.font = `${this.px(10.5)}px ${FONT}`;
      this.text(pen, words.length > 24 ? `${words.slice(0, 23)}…` : words, room.x, room.y + this.px(8));
    }
  }

  drawLandmarks(pen, data) {
    pen.textAlign = "center";
    pen.textBaseline = "alphabetic";
    pen.font = `${this.px(9.5)}px ${FONT}`;
    for (const mark of data.landmarks) {
      if (mark.kind === "name") continue; // the label of its room says it
      pen.fillStyle = this.colour("--good");
      pen.beginPath();
      pen.arc(mark.x, mark.y, this.px(3), 0, 7);
      pen.fill();
      this.text(pen, mark.value.length > 24 ? `${mark.value.slice(0, 23)}…` : mark.value, mark.x, mark.y - this.px(6), "--good");
    }
  }

  drawSelection(pen) {
    if (this.sheets.length) return;
    for (const i of this.selected) {
      const room = this.data.byRoom.get(i);
      if (!room) continue;
      pen.globalAlpha = 0.35;
      pen.fillStyle = this.colour("--accent");
      pen.fill(room.path, "evenodd");
      pen.globalAlpha = 1;
      pen.strokeStyle = this.colour("--accent");
      pen.lineWidth = this.px(2.5);
      pen.stroke(room.path);
    }
    if (this.cursor) {
      const [x, y] = this.cursor, long = this.px(9);
      pen.strokeStyle = this.colour("--accent");
      pen.lineWidth = this.px(1.5);
      this.stroke(pen, [x - long, y, x + long, y]);
      this.stroke(pen, [x, y - long, x, y + long]);
    }
  }

  drawRulers(pen) {
    const cm = roundLength(130 / this.view.scale), { ratio } = this, h = this.canvas.height / ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.globalAlpha = 0.75;
    pen.fillStyle = this.colour("--paper");
    pen.fillRect(6, h - 28, 54 + cm * this.view.scale, 22);
    pen.globalAlpha = 1;
    pen.lineWidth = 1.5;
    pen.strokeStyle = pen.fillStyle = this.colour("--ink");
    pen.beginPath();
    pen.moveTo(14, h - 19);
    pen.lineTo(14, h - 14);
    pen.lineTo(14 + cm * this.view.scale, h - 14);
    pen.lineTo(14 + cm * this.view.scale, h - 19);
    pen.stroke();
    pen.font = `11px ${FONT}`;
    pen.textAlign = "left";
    pen.textBaseline = "alphabetic";
    pen.fillText(cm >= 100 ? `${cm / 100} m` : `${cm} cm`, 20 + cm * this.view.scale, h - 14);
  }

  // What is where.

  roomAt(point) {
    const pen = this.hitPen ??= document.createElement("canvas").getContext("2d");
    return this.data.rooms.find(({ box, path }) => point[0] >= box[0] && point[0] <= box[2] && point[1] >= box[1] && point[1] <= box[3] && pen.isPointInPath(path, ...point, "evenodd")) || null;
  }

  get reach() { return Math.max(Math.min(this.px(12), 40), this.px(3)); } // cm: of small rooms most are clicked between their doors

  near(list, point) { // the nearest of doors or windows
    const far = ({ line }) => distance(point, nearestOnSegment(point, line.slice(0, 2), line.slice(2)));
    const best = list.reduce((a, b) => (a && far(a) <= far(b) ? a : b), null);
    return best && far(best) <= this.reach ? best : null;
  }

  markAt(point) {
    const far = (mark) => distance(point, [mark.x, mark.y]);
    const best = this.data.landmarks.reduce((a, b) => (a && far(a) <= far(b) ? a : b), null);
    return best && far(best) <= this.reach ? best : null;
  }

  // Pointers: one pans or drags, two pinch, a click is told.

  listen() {
    const { canvas } = this, spot = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture?.(event.pointerId);
      const at = spot(event);
      this.pointers.set(event.pointerId, at);
      if (this.pointers.size > 1) { this.gesture = { kind: "pinch" }; return; }
      const taken = event.button === 0 && this.plan && this.on.grab?.(this.toPaper(...at), event);
      this.gesture = { kind: taken ? "drag" : "press", from: at, pan: event.button > 0 };
    });
    canvas.addEventListener("pointermove", (event) => {
      const at = spot(event), last = this.pointers.get(event.pointerId);
      if (!this.plan) return;
      if (!last) { this.on.hover?.(this.toPaper(...at), event); return; }
      const before = this.spread();
      this.pointers.set(event.pointerId, at);
      if (this.gesture.kind === "drag") { this.on.drag?.(this.toPaper(...at), event); return; }
      if (this.gesture.kind === "press" && distance(at, this.gesture.from) < TAP) return;
      if (this.gesture.kind === "press") this.gesture.kind = "pan";
      const share = 1 / this.pointers.size;
      this.pan(-(at[0] - last[0]) * share, -(at[1] - last[1]) * share);
      if (before && this.pointers.size > 1) this.zoom(this.spread() / before, at);
    });
    const up = (event) => {
      const at = this.pointers.get(event.pointerId);
      if (!at || !this.pointers.delete(event.pointerId)) return;
      const { kind, pan } = this.gesture;
      if (kind === "drag") this.on.drop?.(this.toPaper(...at), event);
      else if (kind === "press" && !pan && event.type === "pointerup" && this.plan) this.on.click?.(this.toPaper(...at), event);
      if (this.pointers.size) this.gesture = { kind: "pinch" };
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("dblclick", (event) => { if (this.plan) this.on.double?.(this.toPaper(...spot(event)), event); });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), spot(event));
    }, { passive: false });
  }

  spread() {
    const [a, b] = [...this.pointers.values()];
    return b ? distance(a, b) : 0;
  }

  pan(dx, dy) {
    this.view.x += dx / this.view.scale;
    this.view.y += dy / this.view.scale;
    this.moved();
  }

  zoom(factor, [x, y] = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2]) {
    const least = this.home ? 0.2 * Math.min(this.canvas.clientWidth / (this.home[2] - this.home[0]), this.canvas.clientHeight / (this.home[3] - this.home[1])) : 0.001;
    const scale = Math.min(Math.max(this.view.scale * factor, least), 8), before = this.toPaper(x, y);
    this.view.scale = scale;
    const after = this.toPaper(x, y);
    this.view.x += before[0] - after[0];
    this.view.y += before[1] - after[1];
    this.moved();
  }

  moved() {
    this.moving = this.touched = true;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => { this.moving = false; this.ask(); }, REST);
    this.ask();
  }

  reveal(point) { // so that a place is on the canvas
    const [x, y] = this.toScreen(point), { clientWidth: w, clientHeight: h } = this.canvas;
    if (x > 40 && y > 40 && x < w - 40 && y < h - 40) return;
    this.view.x = point[0] - w / 2 / this.view.scale;
    this.view.y = point[1] - h / 2 / this.view.scale;
    this.moved();
  }
}
