// Two maps over each other: the verdict of a merge with its evidence, and maps that are matched and placed by hand.

import { encodePath, get, post } from "./api.js";
import { preparePlan, PlanCanvas } from "./canvas.js";
import { button, el, formatPercent, toast } from "./dom.js";
import { apply, compose, distance } from "./geometry.js";

const COLOURS = ["--of-a", "--of-b", "--good", "--stairs", "--warn"];
const IDENTITY = [1, 0, 0, 0, 1, 0];

const flat = (matrix) => [matrix[0][0], matrix[0][1], matrix[0][3], matrix[1][0], matrix[1][1], matrix[1][3]];
const onPaper = (first, plan, matrix) => compose(first.toPaper, compose(flat(matrix), plan.back));

function pairStoreys(a, b, rise) { // [[storey of a, storey of b]] whose floors lie at one height
  return a.storeys.map((one, i) => {
    const far = b.storeys.map((other) => Math.abs(other.floor + rise - one.floor)), least = Math.min(...far);
    return [i, least < 1.5 ? far.indexOf(least) : -1];
  });
}

// Plans over each other on one canvas, with a slider from the first to the others.
class Overlay {
  constructor(place, on = {}) {
    this.stage = el("div", { class: "canvas-stage" });
    this.slider = el("input", { type: "range", min: 0, max: 1, step: 0.01, value: 0.5, ariaLabel: "From the first map to the other", oninput: () => this.show() });
    this.names = el("div", { class: "blend" });
    this.bar = el("div", { class: "topbar" }, this.names);
    place.append(this.bar, this.stage);
    this.canvas = new PlanCanvas(this.stage, { on });
    Object.assign(this, { maps: [], storey: 0, bent: true });
  }

  setMaps(maps) { // [{ plan, name, matrix, bent }], the first one with the identity
    this.maps = maps;
    const first = maps[0].plan;
    this.canvas.plan = first;
    const box = [0, 0, ...first.size];
    for (const { plan, matrix } of maps.slice(1)) {
      const to = onPaper(first, plan, matrix);
      for (const corner of [[0, 0], [plan.size[0], 0], [0, plan.size[1]], plan.size]) {
        const [x, y] = apply(to, corner);
        box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y); box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
      }
    }
    this.canvas.fit(box);
    const name = (one, k) => el("span", { class: `of-${k}`, title: one.name }, one.name);
    const bends = maps.some((one) => one.bent);
    const box2 = bends ? el("label", {}, el("input", { type: "checkbox", checked: this.bent, data: { layer: "bent" }, onchange: (event) => { this.bent = event.target.checked; this.show(); } }), " bent") : null;
    const storeys = first.storeys.length > 1 ? el("div", { class: "group" }, first.storeys.map((_, i) => button(`Storey ${i}`, () => { this.storey = i; this.show(); }, { data: { storey: i } }))) : null;
    this.names.replaceChildren(...[storeys, name(maps[0], 0), this.slider, ...maps.slice(1).map((one, k) => name(one, k + 1)), box2].filter(Boolean));
    this.show();
  }

  show() {
    const share = Number(this.slider.value), first = this.maps[0].plan;
    this.canvas.sheets = this.maps.map((one, k) => {
      const storey = k ? pairStoreys(first, one.plan, one.matrix[2][3])[this.storey][1] : this.storey;
      const walls = one.bent && this.bent && storey >= 0 ? (one.bentPaths ??= one.bent.map((d) => new Path2D(d)))[storey] : null;
      return { plan: one.plan, storey, matrix: k ? onPaper(first, one.plan, one.matrix) : IDENTITY, colour: COLOURS[k % COLOURS.length], share: Math.min(k ? 2 * share : 2 - 2 * share, 1), walls };
    });
    for (const one of this.names.querySelectorAll("button[data-storey]")) one.setAttribute("aria-pressed", String(Number(one.dataset.storey) === this.storey));
    this.canvas.refresh();
  }
}

const loadPlan = async (path) => preparePlan(await get(`/api/plan/${encodePath(path)}`));

export class MergeView {
  constructor(place, path) {
    Object.assign(this, { place, path });
    this.onMerge = (event) => { if (event.detail.path === path || (event.detail.job?.result === path && event.detail.job.state === "done")) this.load(); };
    document.addEventListener("studio:merge", this.onMerge);
    document.addEventListener("studio:job", this.onMerge);
    this.load();
  }

  close() {
    document.removeEventListener("studio:merge", this.onMerge);
    document.removeEventListener("studio:job", this.onMerge);
  }

  async load() {
    try {
      this.merge = await get(`/api/merge/${encodePath(this.path)}`);
    } catch (error) {
      this.place.replaceChildren(el("p", { class: "bad note-box" }, error.message));
      return;
    }
    const middle = el("div", { class: "middle" });
    this.place.replaceChildren(el("div", { class: "merge" }, middle, el("aside", { class: "side" }, this.describe())));
    await this.overlay(middle);
  }

  async overlay(middle) {
    const { maps } = this.merge, placed = maps.filter((one) => one.path && one.matrix);
    if (placed.length < 2) {
      middle.append(el("p", { class: "note-box" }, maps.some((one) => !one.path) ? "The maps of this merge do not lie in the folder; its report shows them." : "The maps are not placed. Match them by hand if you know that they belong together."));
      return;
    }
    const view = new Overlay(middle);
    try {
      view.setMaps(await Promise.all(placed.map(async (one) => ({ ...one, plan: await loadPlan(one.path) }))));
    } catch (error) {
      toast(error.message, "bad");
    }
  }

  describe() {
    const { merge } = this, list = (title, items) => (items.length ? [el("h3", {}, title), el("ul", { class: "evidence" }, items.map((one) => el("li", {}, one)))] : []);
    const decide = (words, verdict, settings) => button(words, async () => {
      try {
        await post(`/api/decide/${encodePath(this.path)}`, { verdict, by: localStorage.getItem("topomerge-name") || "" });
        toast(verdict === "accept" ? "Accepted: the maps are merged anew." : "Rejected: the maps are merged anew, apart.");
      } catch (error) { toast(error.message, "bad"); }
    }, settings);
    const pair = merge.maps.length === 2 && merge.maps.every((one) => one.path) ? merge.maps.map((one) => encodeURIComponent(one.path)).join("/") : null;
    return el("div", { class: "stack" },
      el("div", { class: `verdict ${merge.status === "merged" ? "" : "refused"}` }, el("b", {}, merge.status === "merged" ? "Merged" : merge.status === "abstained" ? "Not merged" : merge.status), el("p", {}, merge.reason)),
      el("dl", { class: "facts" }, merge.facts.map(([name, value]) => [el("dt", {}, name), el("dd", {}, value)])),
      ...list("What it could be", merge.alternatives.map(([name, share]) => `${name}: ${formatPercent(share)}`)), ...list("Signs and tags", merge.landmarks), ...list("Contradictions", merge.contradictions), ...list("What would settle it", merge.settle), ...list("Decisions", merge.decisions),
      el("div", { class: "row" }, merge.joined ? el("a", { class: "as-button primary", href: `#/map/${encodePath(merge.joined)}` }, "Open the joined map") : null, merge.report ? el("a", { class: "as-button", href: `/files/${encodePath(merge.report)}`, target: "_blank", rel: "noopener" }, "Report") : null),
      el("div", { class: "row" }, merge.maps.length === 2 ? [decide("Accept", "accept", { disabled: !merge.proposed, title: "They belong together, as shown" }), decide("Reject", "reject", { class: "danger", title: "They do not belong together" })] : null, pair ? el("a", { class: "as-button", href: `#/match/${pair}` }, "Match by hand") : null));
  }
}

export class MatchView {
  constructor(place, paths) {
    Object.assign(this, { place, paths, pairs: [], open: [null, null], matrix: null });
    this.onKey = (event) => this.key(event);
    document.addEventListener("keydown", this.onKey);
    this.load();
  }

  close() { document.removeEventListener("keydown", this.onKey); }

  async load() {
    try {
      this.plans = await Promise.all(this.paths.map(loadPlan));
    } catch (error) {
      this.place.replaceChildren(el("p", { class: "bad note-box" }, error.message));
      return;
    }
    this.middle = el("div", { class: "middle" });
    this.side = el("aside", { class: "side" });
    this.place.replaceChildren(el("div", { class: "merge match" }, this.middle, this.side));
    this.showPlans();
  }

  showPlans() {
    this.overlay = null;
    const both = el("div", { class: "both" });
    this.middle.replaceChildren(both);
    this.canvases = this.plans.map((plan, k) => {
      const stage = el("div", { class: "canvas-stage" });
      const storeys = plan.storeys.length > 1 ? el("div", { class: "group" }, plan.storeys.map((_, i) => button(`Storey ${i}`, () => this.canvases[k].show(i)))) : null;
      both.append(el("div", { class: "half" }, el("div", { class: "topbar" }, el("b", { class: `of-${k}` }, this.paths[k]), storeys), stage));
      const canvas = new PlanCanvas(stage, { on: { click: (point) => this.pick(k, point) }, overlay: (pen) => this.drawPairs(pen, k) });
      canvas.setPlan(plan);
      return canvas;
    });
    this.showSide();
  }

  pick(k, point) {
    const canvas = this.canvases[k], room = canvas.roomAt(point);
    if (!room) return;
    this.open[k] = { i: room.i, paper: [room.x, room.y], storey: canvas.storey };
    if (this.open[0] && this.open[1]) {
      this.pairs.push(this.open);
      this.open = [null, null];
    }
    for (const one of this.canvases) one.ask();
    this.showSide();
  }

  drawPairs(pen, k) {
    const canvas = this.canvases?.[k];
    if (!canvas) return;
    [...this.pairs, this.open].forEach((pair, n) => {
      if (!pair[k] || pair[k].storey !== canvas.storey) return;
      const [x, y] = pair[k].paper;
      pen.fillStyle = canvas.colour(n < this.pairs.length ? "--accent" : "--warn");
      pen.beginPath();
      pen.arc(x, y, canvas.px(11), 0, 7);
      pen.fill();
      pen.fillStyle = canvas.colour("--paper");
      pen.font = `650 ${canvas.px(12)}px system-ui, sans-serif`;
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.fillText(String.fromCharCode(65 + n), x, y);
    });
  }

  async compute(wish) {
    this.place.dataset.busy = "true";
    try {
      const told = await post("/api/place", { paths: this.paths, ...wish });
      this.matrix = told.matrix;
      this.words = told.words;
      if (!this.overlay) this.showOverlay();
      this.overlay.maps[1].matrix = this.matrix;
      this.overlay.show();
    } catch (error) {
      toast(error.message, "bad");
    }
    delete this.place.dataset.busy;
    this.showSide();
  }

  showOverlay() {
    this.middle.replaceChildren();
    this.overlay = new Overlay(this.middle, {
      grab: (point, event) => { this.held = { point, turn: event.shiftKey || this.turning, matrix: this.matrix }; return true; },
      drag: (point) => this.drag(point), drop: () => { this.held = null; },
    });
    this.overlay.setMaps(this.plans.map((plan, k) => ({ plan, name: this.paths[k], matrix: k ? this.matrix : [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] })));
  }

  drag(point) { // moves the other map, or turns it about its middle
    const { held, plans } = this, first = plans[0], centre = apply(onPaper(first, plans[1], held.matrix), plans[1].size.map((v) => v / 2));
    if (held.turn) {
      const angle = (p) => Math.atan2(p[1] - centre[1], p[0] - centre[0]);
      this.move(held.matrix, [0, 0], angle(held.point) - angle(point), apply(first.back, centre));
    } else {
      const [from, to] = [apply(first.back, held.point), apply(first.back, point)];
      this.move(held.matrix, [to[0] - from[0], to[1] - from[1]], 0);
    }
  }

  move(matrix, [dx, dy], turn, about = [0, 0]) { // in m and rad, in the frame of the first map
    const [c, s] = [Math.cos(turn), Math.sin(turn)];
    const next = matrix.map((row) => [...row]);
    for (let k = 0; k < 4; k++) {
      const [x, y] = [matrix[0][k] - (k === 3 ? about[0] : 0), matrix[1][k] - (k === 3 ? about[1] : 0)];
      next[0][k] = c * x - s * y + (k === 3 ? about[0] + dx : 0);
      next[1][k] = s * x + c * y + (k === 3 ? about[1] + dy : 0);
    }
    this.matrix = next;
    this.words = null;
    this.overlay.maps[1].matrix = next;
    this.overlay.show();
    this.showSide();
  }

  key(event) {
    if (event.target.closest?.("input, select, textarea") || event.ctrlKey || event.altKey || event.metaKey) return;
    if (!this.overlay) {
      if (event.key === "Backspace" || event.key === "Delete") { this.pairs.pop(); this.canvases.forEach((one) => one.ask()); this.showSide(); }
      else if (event.key === "Enter" && this.pairs.length > 1) this.place_();
      return;
    }
    const step = event.shiftKey ? 0.02 : 0.2, turn = (event.shiftKey ? 0.2 : 2) * (Math.PI / 180);
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const middle = apply(this.plans[0].back, apply(onPaper(this.plans[0], this.plans[1], this.matrix), this.plans[1].size.map((v) => v / 2)));
    if (ways) {
      const [a, b] = [apply(this.plans[0].back, [0, 0]), apply(this.plans[0].back, ways.map((v) => 100 * v * step))];
      this.move(this.matrix, [b[0] - a[0], b[1] - a[1]], 0);
    } else if (event.key === "," || event.key === ".") this.move(this.matrix, [0, 0], event.key === "," ? turn : -turn, middle);
    else if (event.key.toLowerCase() === "s") this.snap();
    else return;
    event.preventDefault();
  }

  place_() { return this.compute({ rooms: this.rooms() }); }

  rooms() { return this.pairs.map((pair) => pair.map(({ i }) => i)); }

  snap() { return this.compute({ matrix: this.matrix }); }

  byHand() { // a start without pairs: middle on middle
    const middle = (plan) => [0, 1].map((k) => (plan.low[k] + plan.high[k]) / 2), [a, b] = this.plans.map(middle);
    const rise = this.plans[0].storeys[0].floor - this.plans[1].storeys[0].floor;
    this.matrix = [[1, 0, 0, a[0] - b[0]], [0, 1, 0, a[1] - b[1]], [0, 0, 1, rise], [0, 0, 0, 1]];
    this.showOverlay();
    this.showSide();
  }

  async accept() {
    try {
      await post("/api/jobs", { kind: "merge", paths: this.paths, matrix: this.matrix, rooms: this.rooms(), by: localStorage.getItem("topomerge-name") || "" });
      toast("Accepted: the maps are merged.");
      location.hash = "#/";
    } catch (error) { toast(error.message, "bad"); }
  }

  showSide() {
    const letters = this.pairs.map(([a, b], n) => el("li", {}, el("span", {}, `${String.fromCharCode(65 + n)}: room ${a.i} is room ${b.i}`), button("×", () => { this.pairs.splice(n, 1); this.canvases.forEach((one) => one.ask()); this.showSide(); }, { ariaLabel: "Remove this pair" })));
    const parts = this.overlay
      ? [el("h2", {}, "Placed by hand"), el("p", { class: "sub" }, "Drag to move the second map, with Shift to turn it; arrow keys move it by 20 cm, comma and full stop turn it by 2°, with Shift finer. Snap moves it to where the walls meet."),
        ...(this.words || []).map((line) => el("p", {}, line)),
        el("label", { class: "check" }, el("input", { type: "checkbox", checked: this.turning, onchange: (event) => { this.turning = event.target.checked; } }), " drag turns"),
        el("div", { class: "row" }, button("Snap", () => this.snap(), { data: { act: "snap" } }), button("Accept and merge", () => this.accept(), { class: "primary", data: { act: "accept" } })), el("div", { class: "row" }, button("Back to the pairs", () => this.showPlans()))]
      : [el("h2", {}, "Match by hand"), el("p", { class: "sub" }, "Click a room of the one map and the same room of the other. From two pairs on, the maps can be placed."), el("ol", { class: "journal" }, letters),
        this.open.some(Boolean) ? el("p", { class: "sub" }, "Now the same room of the other map.") : null,
        el("div", { class: "row" }, button("Place", () => this.place_(), { class: "primary", disabled: this.pairs.length < 2, data: { act: "place" } }), button("Move by hand", () => this.byHand(), { data: { act: "by-hand" } }))];
    this.side.replaceChildren(...parts.filter(Boolean));
  }
}
