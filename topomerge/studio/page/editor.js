// The view of one map: its plan and 3D view, the tools, what is selected, and the journal of corrections.

import { encodePath, get, post, Refused } from "./api.js";
import { preparePlan, PlanCanvas } from "./canvas.js";
import { ask, button, el, toast } from "./dom.js";
import { ACTIONS, ROOM_KINDS, TOOLS } from "./tools.js";
import { light } from "./plan.js";
import { openScene } from "./scene.js";

const STEP = 14; // pixels that an arrow key moves the cross
const WORDS = {
  split_room: "Room split", join_rooms: "Rooms joined", add_door: "Door added", delete_door: "Door deleted", move_door: "Door moved",
  set_door: "Door changed", move_opening: "Window moved", set_opening: "Window changed", delete_opening: "Window deleted",
  rename_room: "Room renamed", set_room: "Room changed", assign_area: "Area assigned", add_landmark: "Landmark added", delete_landmark: "Landmark deleted",
};
const svg = (d) => {
  const picture = document.createElementNS("http://www.w3.org/2000/svg", "svg"), path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  picture.setAttribute("viewBox", "0 0 22 22");
  picture.setAttribute("aria-hidden", "true");
  path.setAttribute("d", d);
  picture.append(path);
  return picture;
};

export class Editor {
  constructor(place, path) {
    Object.assign(this, { path, tool: "select", state: {}, picked: null, doorWidth: 0.9, queue: Promise.resolve(), closed: false });
    this.place = place;
    this.build();
    this.onMap = (event) => { if (event.detail.path === path && event.detail.version !== this.plan?.version) this.reload("Another page has changed this map."); };
    this.onBack = () => this.reload();
    this.onKey = (event) => this.key(event);
    document.addEventListener("studio:map", this.onMap);
    document.addEventListener("studio:back", this.onBack);
    document.addEventListener("keydown", this.onKey);
    this.ready = this.open();
  }

  close() {
    this.closed = true;
    document.removeEventListener("studio:map", this.onMap);
    document.removeEventListener("studio:back", this.onBack);
    document.removeEventListener("keydown", this.onKey);
    this.canvas.watch.disconnect();
  }

  build() {
    this.tools = el("div", { class: "tools", role: "toolbar", ariaLabel: "Tools" }, Object.entries(TOOLS).map(([id, tool]) =>
      el("button", { type: "button", title: `${tool.name} (${tool.key.toUpperCase()})`, ariaLabel: tool.name, data: { tool: id }, onclick: () => this.choose(id) }, svg(tool.icon), el("kbd", {}, tool.key.toUpperCase()))));
    this.stage = el("div", { class: "canvas-stage" });
    this.scene = el("div", { class: "scene", hidden: true }, el("p", { class: "missing" }, "The 3D view needs WebGL 2, which this browser does not offer."));
    this.status = el("p", { class: "status", role: "status" }, "Opening …");
    this.side = el("aside", { class: "side" });
    this.top = el("div", { class: "topbar" });
    this.place.replaceChildren(el("div", { class: "editor" }, this.top, this.tools, el("div", { class: "middle" }, this.stage, this.scene), this.side, this.status));
    this.canvas = new PlanCanvas(this.stage, {
      overlay: (pen) => { this.drawPicked(pen); TOOLS[this.tool].draw?.(this, pen); },
      on: {
        click: (point, event) => { this.canvas.cursor = null; this.click(point, event); },
        hover: (point, event) => this.hover(point, event),
        grab: (point, event) => TOOLS[this.tool].grab?.(this, point, event),
        drag: (point, event) => TOOLS[this.tool].drag?.(this, point, event),
        drop: (point, event) => TOOLS[this.tool].drop?.(this, point, event),
      },
    });
    this.canvas.canvas.setAttribute("aria-label", "Plan. Arrow keys move a cross, Enter clicks there; [ and ] go from room to room.");
  }

  async open() {
    try {
      this.take(await get(`/api/plan/${encodePath(this.path)}?quick`));
      if (!this.plan.whole) this.queue = get(`/api/plan/${encodePath(this.path)}`).then((plan) => this.closed || this.take(plan)); // edits wait for it
    } catch (error) {
      this.place.replaceChildren(el("p", { class: "bad note-box" }, error.message));
      return;
    }
    if (this.closed) return;
    this.choose("select");
    this.canvas.canvas.focus({ preventScroll: true });
  }

  take(plan) {
    const points = this.plan ? [...this.canvas.selected].map((i) => this.canvas.data.byRoom.get(i)).filter(Boolean) : [];
    const first = !this.plan;
    this.plan = preparePlan(plan);
    this.canvas.setPlan(this.plan, !first);
    this.canvas.selected = new Set(points.map((room) => this.canvas.roomAt([room.x, room.y])?.i).filter((i) => i !== undefined));
    this.picked = this.picked && this.findAgain(this.picked);
    this.place.dataset.version = plan.version;
    this.place.dataset.rooms = plan.rooms;
    this.showTop();
    this.showSide();
    if (!this.scene.hidden) this.showScene(true);
  }

  findAgain({ kind, thing }) {
    const list = { door: this.canvas.data.doors, window: this.canvas.data.windows, mark: this.canvas.data.landmarks }[kind];
    const same = list.find(({ at }) => Math.hypot(at[0] - thing.at[0], at[1] - thing.at[1]) < 0.05);
    return same ? { kind, thing: same } : null;
  }

  async reload(words) {
    if (this.reloading || this.closed) return;
    this.reloading = true;
    try {
      let plan, shown;
      do { // an edit of one's own that was answered meanwhile is newer than this answer
        shown = this.plan;
        plan = await get(`/api/plan/${encodePath(this.path)}`);
      } while (!this.closed && this.plan !== shown);
      if (!this.closed && plan.version !== this.plan?.version) {
        this.take(plan);
        if (words) toast(words);
      }
    } catch (error) {
      toast(error.message, "bad");
    }
    this.reloading = false;
  }

  // Edits. One after the other; each is made for the version that the page shows.

  edit(wish) {
    const storey = this.canvas.storey, flat = (p) => (p.length === 2 ? this.plan && this.canvas.toMetres(p).map((v) => Number(v.toFixed(4))) : p);
    const ready = { ...wish, storey, by: localStorage.getItem("topomerge-name") || "" };
    for (const name of ["at", "to"]) if (wish[name]) ready[name] = Array.isArray(wish[name][0]) ? wish[name].map(flat) : flat(wish[name]);
    if (wish.line) ready.line = wish.line.map(flat);
    return this.send(ready);
  }

  send(ready) {
    this.queue = this.queue.then(async () => {
      this.place.dataset.busy = "true";
      const began = performance.now();
      try {
        this.take(await post(`/api/edits/${encodePath(this.path)}`, { version: this.plan.version, edit: ready }));
        this.place.dataset.took = Math.round(performance.now() - began);
        this.tell(WORDS[ready.op] || "");
      } catch (error) {
        if (!(error instanceof Refused)) throw error;
        if (error.status === 409) this.conflict(ready);
        else { toast(error.message, "bad"); this.tell(error.message); }
      }
      delete this.place.dataset.busy;
    });
    return this.queue;
  }

  async conflict(ready) {
    await this.reload();
    const note = el("div", { class: "toast bad" }, "Somebody else changed this map at the same time. Your change was not made. ", button("Make it now", () => { note.remove(); this.send(ready); }));
    document.getElementById("toasts").append(note);
    setTimeout(() => note.remove(), 20000);
  }

  undo() { if (this.plan.journal.undo) this.send({ op: "undo" }); else this.tell("There is nothing to undo."); }

  redo() { if (this.plan.journal.redo) this.send({ op: "redo" }); else this.tell("There is nothing to redo."); }

  joinSelected() {
    const rooms = this.selectedRooms();
    if (rooms.length < 2) { this.tell("Select two rooms or more."); return; }
    this.edit({ op: "join_rooms", at: rooms.map(({ x, y }) => [x, y]) });
  }

  selectedRooms() { return [...this.canvas.selected].map((i) => this.canvas.data.byRoom.get(i)).filter(Boolean); }

  async askFor(op, title, field, options) {
    const rooms = this.selectedRooms();
    if (!rooms.length) { this.tell("Select a room first."); return; }
    const value = { name: rooms[0].name, kind: rooms[0].kind, area: rooms[0].group }[field];
    const given = await ask(title, [{ label: title, value, options: options && [...new Set([...options, value])], maxLength: 200 }]);
    if (given) this.setRooms(rooms, op, field, given[0]);
  }

  setRooms(rooms, op, field, value) {
    if (op === "assign_area") this.edit({ op, at: rooms.map(({ x, y }) => [x, y]), area: value });
    else for (const { x, y } of rooms) this.edit({ op, at: [x, y], [field]: value });
  }

  toggle(field, name) {
    const rooms = this.selectedRooms();
    if (!rooms.length) this.tell("Select a room first.");
    else this.setRooms(rooms, "set_room", field, !rooms[0][name]);
  }

  toggleDoor() {
    if (this.picked?.kind !== "door") this.tell("Select a door first.");
    else this.edit({ op: "set_door", at: this.picked.thing.at, open: this.picked.thing.state === "shut" });
  }

  async askWidth() {
    if (!this.picked || this.picked.kind === "mark") { this.tell("Select a door or a window first."); return; }
    const { kind, thing } = this.picked, given = await ask("Width", [{ label: "Width, m", type: "number", step: "0.01", min: "0.1", max: "50", value: thing.width }]);
    if (given && Number(given[0]) > 0) this.edit({ op: kind === "door" ? "set_door" : "set_opening", at: thing.at, width: Number(given[0]) });
  }

  deletePicked() {
    if (!this.picked) { this.tell("Select a door, a window or a landmark first."); return; }
    const { kind, thing } = this.picked;
    const ops = { door: { op: "delete_door" }, window: { op: "delete_opening" }, mark: { op: "delete_landmark", kind: thing.kind, value: thing.value } };
    this.picked = null;
    this.edit({ ...ops[kind], at: thing.at });
  }

  // What is selected.

  pick(point, more, roomsOnly = false) {
    const { canvas } = this, { data } = canvas;
    const door = !roomsOnly && canvas.near(data.doors, point), window = !roomsOnly && canvas.near(data.windows, point), mark = !roomsOnly && canvas.markAt(point);
    this.picked = mark ? { kind: "mark", thing: mark } : door ? { kind: "door", thing: door } : window ? { kind: "window", thing: window } : null;
    const room = this.picked ? null : canvas.roomAt(point);
    if (!more || this.picked) canvas.selected.clear();
    if (room) this.selectRoom(room, more);
    this.changed();
  }

  selectRoom(room, more) {
    const { selected } = this.canvas;
    if (!more) selected.clear();
    if (more && selected.has(room.i)) selected.delete(room.i);
    else selected.add(room.i);
  }

  step(by) { // to the next room, by its number
    const { canvas } = this, rooms = [...canvas.data.rooms].sort((a, b) => a.i - b.i);
    if (!rooms.length) return;
    const last = [...canvas.selected].pop(), at = rooms.findIndex(({ i }) => i === last);
    const room = rooms[(at + by + rooms.length) % rooms.length];
    this.picked = null;
    this.selectRoom(room, false);
    canvas.cursor = [room.x, room.y];
    canvas.reveal(canvas.cursor);
    this.changed();
  }

  changed() {
    const last = [...this.canvas.selected].pop();
    light(last === undefined ? null : `room ${last}`);
    this.showSide();
    this.canvas.ask();
  }

  drawPicked(pen) {
    if (!this.picked) return;
    const { canvas } = this, { kind, thing } = this.picked;
    pen.strokeStyle = canvas.colour("--warn");
    pen.lineWidth = canvas.px(7);
    pen.globalAlpha = 0.75;
    if (kind === "mark") canvas.stroke(pen, [thing.x, thing.y, thing.x, thing.y]);
    else canvas.stroke(pen, thing.line);
    pen.globalAlpha = 1;
  }

  // Tools, pointer and keys.

  choose(id) {
    this.state = {};
    if (TOOLS[id].start && !TOOLS[id].start(this)) id = "select";
    this.tool = id;
    for (const one of this.tools.children) one.setAttribute("aria-pressed", String(one.dataset.tool === id));
    this.stage.dataset.tool = id;
    this.tell("");
    this.canvas.ask();
  }

  click(point, event) { TOOLS[this.tool].click?.(this, point, event); this.canvas.ask(); }

  hover(point, event) {
    TOOLS[this.tool].hover?.(this, point, event);
    const [x, y] = this.canvas.toMetres(point), room = this.canvas.roomAt(point);
    this.coordinates = `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m${room ? ` · room ${room.i}${room.name ? ` ${room.name}` : ""}` : ""}`;
    this.showStatus();
    if (this.tool !== "select") this.canvas.ask();
  }

  tell(words) { this.words = words; this.showStatus(); }

  showStatus() { this.status.replaceChildren(el("span", {}, this.words || TOOLS[this.tool].hint), el("span", { class: "where" }, this.coordinates || "")); }

  key(event) {
    if (this.closed || !this.plan || document.querySelector("dialog[open]") || event.target.closest?.("input, select, textarea")) return;
    const letter = event.key.length === 1 ? event.key.toLowerCase() : event.key, control = event.ctrlKey || event.metaKey;
    if (control && letter === "z") event.shiftKey ? this.redo() : this.undo();
    else if (control && letter === "y") this.redo();
    else if (control || event.altKey) return;
    else if (document.activeElement === this.canvas.canvas && this.moveCross(event)) { /* it has moved */ }
    else if (letter === "Escape") { this.canvas.selected.clear(); this.picked = null; this.choose("select"); this.changed(); }
    else if (letter === "Backspace" || letter === "Delete") this.deletePicked();
    else if (ACTIONS[letter]) ACTIONS[letter][1](this);
    else if (letter === "]" || letter === "[") this.step(letter === "]" ? 1 : -1);
    else if (letter === "PageUp" || letter === "PageDown") this.show(this.canvas.storey + (letter === "PageUp" ? 1 : -1));
    else if ("+=-".includes(letter)) this.canvas.zoom(letter === "-" ? 1 / 1.3 : 1.3);
    else if (letter === "0") this.canvas.fit();
    else if (letter === "?") this.help();
    else {
      const tool = Object.keys(TOOLS).find((id) => TOOLS[id].key === letter);
      if (!tool) return;
      this.choose(tool);
    }
    event.preventDefault();
  }

  moveCross(event) { // a cross that arrow keys move and Enter clicks: all tools work without a pointer
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key], { canvas } = this;
    if (way) {
      const { clientWidth: w, clientHeight: h } = canvas.canvas;
      canvas.cursor ??= canvas.toPaper(w / 2, h / 2);
      const step = canvas.px(event.shiftKey ? 2 : STEP);
      canvas.cursor = [canvas.cursor[0] + way[0] * step, canvas.cursor[1] + way[1] * step];
      canvas.reveal(canvas.cursor);
      this.hover(canvas.cursor, { shiftKey: false });
      canvas.ask();
      return true;
    }
    if (event.key !== "Enter" && event.key !== " ") return false;
    if (event.key === "Enter" && TOOLS[this.tool].enter && !canvas.cursor) TOOLS[this.tool].enter(this);
    else if (event.key === "Enter" && TOOLS[this.tool].enter && canvas.selected.size > 1) TOOLS[this.tool].enter(this);
    else if (canvas.cursor) this.click(canvas.cursor, { shiftKey: event.shiftKey || event.key === " " });
    return true;
  }

  help() {
    const rows = [...Object.values(TOOLS).map(({ key, name }) => [key.toUpperCase(), name]), ...Object.entries(ACTIONS).map(([key, [words]]) => [key.length === 1 ? key.toUpperCase() : key, words]),
      ["Ctrl+Z, Ctrl+Y", "Undo, redo"], ["[ and ]", "Previous, next room"], ["Arrows, Enter", "Move the cross, click there"], ["Page up, page down", "Storey above, below"], ["+, −, 0", "Zoom in, out, show all"], ["Esc", "Select nothing"]];
    const dialog = el("dialog", { class: "ask keys" }, el("h2", {}, "Keys"), el("dl", {}, rows.map(([key, words]) => [el("dt", {}, el("kbd", {}, key)), el("dd", {}, words)])), el("div", { class: "row end" }, button("Close", () => dialog.close(), { class: "primary" })));
    dialog.addEventListener("close", () => dialog.remove());
    document.body.append(dialog);
    dialog.showModal();
  }

  // What stands around the plan.

  show(storey) {
    if (storey < 0 || storey >= this.plan.storeys.length) return;
    this.picked = null;
    this.canvas.show(storey);
    this.choose(this.tool);
    this.showTop();
    this.changed();
  }

  showTop() {
    const { plan, canvas } = this, { journal } = plan, flat = this.scene.hidden;
    const storeys = plan.storeys.length > 1 ? el("div", { class: "group", role: "group", ariaLabel: "Storeys" }, plan.storeys.map((one, i) =>
      button(`Storey ${i}`, () => this.show(i), { ariaPressed: String(i === canvas.storey), title: `floor at ${one.floor.toFixed(2)} m, ${one.rooms.length} rooms` }))) : null;
    const views = el("div", { class: "group" }, button("Plan", () => this.showScene(false), { ariaPressed: String(flat) }), button("3D", () => this.showScene(true), { ariaPressed: String(!flat) }));
    const layer = (name, words) => el("label", {}, el("input", { type: "checkbox", checked: canvas.layers[name], onchange: (event) => { canvas.layers[name] = event.target.checked; canvas.refresh(); } }), ` ${words}`);
    const edits = el("div", { class: "group" },
      button("Undo", () => this.undo(), { disabled: !journal.undo, title: "Ctrl+Z", data: { act: "undo" } }), button("Redo", () => this.redo(), { disabled: !journal.redo, title: "Ctrl+Y", data: { act: "redo" } }));
    const zoom = el("div", { class: "group" }, button("−", () => canvas.zoom(1 / 1.3), { ariaLabel: "Zoom out" }), button("+", () => canvas.zoom(1.3), { ariaLabel: "Zoom in" }), button("⤢", () => canvas.fit(), { ariaLabel: "Show all" }));
    this.top.replaceChildren(...[storeys, views, edits, el("div", { class: "layers" }, layer("labels", "numbers"), layer("doors", "doors"), layer("graph", "graph"), layer("landmarks", "landmarks")), el("span", { class: "grow" }), zoom,
      button("Keys", () => this.help(), { title: "?" }), el("a", { class: "as-button primary", href: `/api/report/${encodePath(this.path)}`, title: "Save this map as one page that opens anywhere" }, "Save page")].filter(Boolean));
  }

  async showScene(on) {
    this.scene.hidden = !on;
    this.stage.hidden = on;
    this.showTop();
    if (!on) { this.canvas.resize(); return; }
    if (this.scene.dataset.version === String(this.plan.version)) return;
    this.scene.dataset.version = this.plan.version;
    this.scene.classList.add("waiting");
    try {
      const data = await get(`/api/scene/${encodePath(this.path)}`);
      if (!this.scene.querySelector(".missing")) this.scene.replaceChildren(el("p", { class: "missing" }, "The 3D view needs WebGL 2, which this browser does not offer."));
      await openScene(this.scene, data);
    } catch (error) {
      toast(error.message, "bad");
    }
  }

  showSide() {
    const rooms = this.selectedRooms();
    const parts = this.picked ? this.describePicked() : rooms.length ? this.describeRooms(rooms) : this.describeMap();
    this.side.replaceChildren(...parts, ...this.describeJournal());
  }

  describeMap() {
    const { plan } = this, data = this.canvas.data, area = data.rooms.reduce((sum, room) => sum + room.area, 0);
    const facts = [["Rooms", data.rooms.length], ["Floor area", `${area.toFixed(1)} m²`], ["Doors and openings", data.doors.length], ["Windows", data.windows.length], ["Landmarks", data.landmarks.length]];
    return [el("h2", {}, plan.title), el("dl", { class: "facts" }, facts.map(([name, value]) => [el("dt", {}, name), el("dd", {}, String(value))])),
      ...(plan.warnings.length ? [el("details", { class: "warn" }, el("summary", {}, `${plan.warnings.length} warning${plan.warnings.length > 1 ? "s" : ""}`), el("ul", {}, plan.warnings.map((one) => el("li", {}, one))))] : [])];
  }

  describeRooms(rooms) {
    const first = rooms[0], one = rooms.length === 1, same = (name) => (rooms.every((room) => room[name] === first[name]) ? first[name] : "");
    const field = (label, op, name, value, list) => {
      const input = el("input", { type: "text", value, maxLength: 200, autocomplete: "off", data: { field: name } });
      if (list) input.setAttribute("list", list);
      input.addEventListener("change", () => this.setRooms(rooms, op, name, input.value.trim()));
      input.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === "Escape") { if (event.key === "Escape") input.value = value; this.canvas.canvas.focus(); } });
      return el("label", {}, el("span", {}, label), input);
    };
    const box = (label, name, key) => el("label", { class: "check" }, el("input", { type: "checkbox", checked: Boolean(same(key)), data: { field: name }, onchange: (event) => this.setRooms(rooms, "set_room", name, event.target.checked) }), ` ${label}`);
    const area = rooms.reduce((sum, room) => sum + room.area, 0);
    return [
      el("h2", {}, one ? `Room ${first.i}` : `${rooms.length} rooms`), el("p", { class: "sub" }, `${area.toFixed(1)} m²${one && first.height ? ` · ${first.height.toFixed(2)} m high` : ""}${one ? ` · ${Math.round(100 * first.sure)} % sure` : ""}`),
      ...(one ? [field("Name", "rename_room", "name", first.name)] : []), field("Kind", "set_room", "kind", same("kind"), "kinds"), field("Area", "assign_area", "area", same("group")),
      el("datalist", { id: "kinds" }, ROOM_KINDS.filter(Boolean).map((value) => el("option", { value }))),
      box("outside", "outside", "outside"), box("only looked into", "looked_into", "looked"),
      el("div", { class: "row" }, rooms.length > 1 ? button("Join into one", () => this.joinSelected(), { class: "primary" }) : null, one ? button("Split", () => this.choose("split")) : null),
    ];
  }

  describePicked() {
    const { kind, thing } = this.picked;
    const number = (label, field, value) => value === undefined || value === null ? null : el("label", {}, el("span", {}, label), el("input", { type: "number", step: "0.01", value, data: { field }, onchange: (event) => { if (Number.isFinite(event.target.valueAsNumber)) this.edit({ op: kind === "door" ? "set_door" : "set_opening", at: thing.at, [field]: event.target.valueAsNumber }); } }));
    const heads = { door: thing.kind === "opening" ? "Opening" : "Door", window: "Window", mark: "Landmark" };
    const about = { door: () => `between rooms ${thing.rooms.join(" and ")} · ${thing.state}`, window: () => `of room ${thing.rooms.filter((i) => i >= 0).join(" and ")}`, mark: () => `${thing.kind}: ${thing.value}` }[kind]();
    return [el("h2", {}, heads[kind]), el("p", { class: "sub" }, about), number("Width, m", "width", thing.width), number("Sill, m", "sill", thing.sill), number("Head, m", "head", thing.head),
      el("div", { class: "row" }, kind === "door" ? button(thing.state === "shut" ? "Is open" : "Is shut", () => this.toggleDoor()) : null, kind === "mark" ? null : button("Move", () => this.choose("move")), button("Delete", () => this.deletePicked(), { class: "danger" }))].filter(Boolean);
  }

  describeJournal() {
    const { journal, unapplied } = this.plan, lines = [...journal.edits].reverse().slice(0, 100);
    if (!lines.length) return [el("p", { class: "sub push" }, "No corrections yet. They are kept in a file beside the map; the map itself stays as it was extracted.")];
    const refused = new Map(unapplied.map((one) => [one.id, one.reason]));
    const words = (one) => `${WORDS[one.op] || one.op}${one.name || one.value || one.area || one.kind ? `: ${one.name || one.value || one.area || one.kind}` : ""}`;
    return [el("h3", {}, `Corrections · ${journal.count}`), el("ol", { class: "journal" }, lines.map((one) => el("li", { class: refused.has(one.id) ? "refused" : one.holds ? "" : "undone", title: refused.get(one.id) || `${one.time} ${one.by}` },
      el("span", {}, words(one)), el("small", {}, refused.has(one.id) ? `no longer applies: ${refused.get(one.id)}` : [one.by, one.time.slice(0, 16).replace("T", " ")].filter(Boolean).join(" · ")))))];
  }
}
