// The tools of the editor: what a click, a drag or a key becomes as an edit. Places are on the paper; the editor sends metres.

import { crosses, distance, nearestOnSegment } from "./geometry.js";
import { ask } from "./dom.js";

const SNAP = 10; // pixels within which a corner or a wall attracts
const THICKEST = 80; // cm of a wall that has a door
const IN_LINE = 40; // cm that the pointer may leave the line of a wall
const UPRIGHT = 6; // degrees within which a line is drawn along the walls
const KINDS = ["", "office", "corridor", "hall", "meeting room", "kitchen", "toilet", "stairs", "lift", "storage", "bedroom", "bathroom", "living room", "technical", "balcony"];
export const ROOM_KINDS = KINDS;
export const MARK_KINDS = ["text", "object", "tag"];

// The end of a line: on a corner, along the walls, or on a wall; as it is with Shift.
export function snap(canvas, point, from, free) {
  if (free) return point;
  const reach = canvas.px(SNAP);
  const rooms = canvas.data.rooms.filter(({ box }) => point[0] > box[0] - reach && point[0] < box[2] + reach && point[1] > box[1] - reach && point[1] < box[3] + reach);
  let best = null;
  const offer = (place, weight) => {
    const far = distance(place, point) * weight;
    if (far <= reach && (!best || far < best.far)) best = { place, far };
  };
  for (const { rings } of rooms) for (const ring of rings) for (const corner of ring) offer(corner, 1);
  if (best) return best.place;
  let aligned = point;
  if (from) {
    const angle = (Math.atan2(point[1] - from[1], point[0] - from[0]) * 180) / Math.PI, off = angle - 90 * Math.round(angle / 90);
    if (Math.abs(off) < UPRIGHT) aligned = Math.round(angle / 90) % 2 ? [from[0], point[1]] : [point[0], from[1]];
  }
  for (const { rings } of rooms) for (const ring of rings) ring.forEach((corner, k) => {
    const next = ring[(k + 1) % ring.length];
    if (aligned === point) { offer(nearestOnSegment(point, corner, next), 1); return; }
    for (const axis of [0, 1]) { // where the line that is aligned meets the wall
      if (aligned[axis] !== from[axis] || (corner[axis] - from[axis]) * (next[axis] - from[axis]) > 0 || corner[axis] === next[axis]) continue;
      const share = (from[axis] - corner[axis]) / (next[axis] - corner[axis]);
      offer([corner[0] + share * (next[0] - corner[0]), corner[1] + share * (next[1] - corner[1])], 1);
    }
  });
  return best ? best.place : aligned;
}

// Where a door stands: in the middle of the wall between the two rooms that are nearest; one that is moved stays in its wall's line.
export function snapToWall(canvas, point, line) {
  if (line) {
    const [x1, y1, x2, y2] = line, long = Math.hypot(x2 - x1, y2 - y1) || 1, [u, v] = [(x2 - x1) / long, (y2 - y1) / long];
    const along = (point[0] - x1) * u + (point[1] - y1) * v, off = Math.abs((point[0] - x1) * v - (point[1] - y1) * u);
    if (off < IN_LINE) return [x1 + along * u, y1 + along * v];
  }
  const nearest = (room) => room.rings.flatMap((ring) => ring.map((corner, k) => nearestOnSegment(point, corner, ring[(k + 1) % ring.length])))
    .reduce((a, b) => (distance(a, point) <= distance(b, point) ? a : b));
  const near = canvas.data.rooms.filter(({ box }) => point[0] > box[0] - 150 && point[0] < box[2] + 150 && point[1] > box[1] - 150 && point[1] < box[3] + 150)
    .map(nearest).filter((place) => distance(place, point) < 150).sort((a, b) => distance(a, point) - distance(b, point));
  return near.length > 1 && distance(near[0], near[1]) < THICKEST ? [(near[0][0] + near[1][0]) / 2, (near[0][1] + near[1][1]) / 2] : near[0] || point;
}

function drawLine(pen, canvas, a, b) {
  pen.strokeStyle = canvas.colour("--accent");
  pen.lineWidth = canvas.px(2.5);
  pen.setLineDash([canvas.px(7), canvas.px(5)]);
  canvas.stroke(pen, [...a, ...b]);
  pen.setLineDash([]);
  for (const end of [a, b]) dot(pen, canvas, end);
  pen.font = `600 ${canvas.px(12)}px system-ui, sans-serif`;
  pen.textAlign = "center";
  pen.textBaseline = "alphabetic";
  canvas.text(pen, `${(distance(a, b) / 100).toFixed(2)} m`, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - canvas.px(8), "--accent");
}

function dot(pen, canvas, [x, y]) {
  pen.fillStyle = canvas.colour("--accent");
  pen.beginPath();
  pen.arc(x, y, canvas.px(4), 0, 7);
  pen.fill();
}

// The room that a line cuts: the one it crosses, or the one at its middle.
function roomOfLine(canvas, a, b) {
  const middle = canvas.roomAt([(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]);
  if (middle) return middle;
  const count = ({ rings }) => rings.flatMap((ring) => ring.filter((p, k) => crosses(a, b, p, ring[(k + 1) % ring.length]))).length;
  return canvas.data.rooms.find((room) => count(room) > 1) || null;
}

// A tool: click(editor, point, event), hover, draw(editor, pen); grab, drag and drop where it drags. `state` is its own.
export const TOOLS = {
  select: {
    key: "v", name: "Select", icon: "M4 3l13 8-6 1-3 6z", hint: "Click a room, a door, a window or a landmark; with Shift several rooms. Drag to move the plan.",
    click(editor, point, event) { editor.pick(point, event.shiftKey || event.ctrlKey || event.metaKey); },
  },
  split: {
    key: "s", name: "Split room", icon: "M3 4h16v14H3zM11 2v18", hint: "Click where the line begins and where it ends. It snaps to corners and walls; with Shift it does not.",
    click(editor, point, event) {
      const { state, canvas } = editor, end = snap(canvas, point, state.from, event.shiftKey);
      if (!state.from) { state.from = end; return; }
      const room = roomOfLine(canvas, state.from, end);
      const line = [state.from, end];
      state.from = null;
      if (!room || distance(...line) < 10) { editor.tell("The line crosses no room: draw it from wall to wall."); return; }
      const inside = [(line[0][0] + line[1][0]) / 2, (line[0][1] + line[1][1]) / 2];
      editor.edit({ op: "split_room", at: canvas.roomAt(inside) ? inside : [room.x, room.y], line });
    },
    hover(editor, point, event) { editor.state.to = snap(editor.canvas, point, editor.state.from, event.shiftKey); },
    draw(editor, pen) {
      const { from, to } = editor.state;
      if (from && to) drawLine(pen, editor.canvas, from, to);
      else if (to) dot(pen, editor.canvas, to);
    },
  },
  join: {
    key: "j", name: "Join rooms", icon: "M3 5h7v12H3zM12 5h7v12h-7zM8 11h6", hint: "Click the rooms that are one, then press Enter or J. Rooms that are selected are joined at once.",
    start(editor) { if (editor.canvas.selected.size > 1) { editor.joinSelected(); return false; } return true; },
    click(editor, point) { editor.pick(point, true, true); },
    enter(editor) { editor.joinSelected(); },
  },
  door: {
    key: "d", name: "Add door", icon: "M3 18h4M15 18h4M7 18V5h8v13M12.500 12v.1", hint: "Click the wall between two rooms.",
    async click(editor, point) {
      const at = snapToWall(editor.canvas, point);
      editor.edit({ op: "add_door", at, width: editor.doorWidth, open: true });
    },
    hover(editor, point) { editor.state.to = snapToWall(editor.canvas, point); },
    draw(editor, pen) { if (editor.state.to) dot(pen, editor.canvas, editor.state.to); },
  },
  move: {
    key: "m", name: "Move door or window", icon: "M11 2v18M2 11h18M11 2l-3 3M11 2l3 3M11 20l-3-3M11 20l3-3M2 11l3-3M2 11l3 3M20 11l-3-3M20 11l-3 3", hint: "Drag a door or a window along the walls; or click it, then its new place.",
    grab(editor, point) {
      const { canvas, state } = editor;
      if (state.held) return false;
      const door = canvas.near(canvas.data.doors, point), window = canvas.near(canvas.data.windows, point);
      state.held = door ? { op: "move_door", at: door.at } : window ? { op: "move_opening", at: window.at } : null;
      state.line = (door || window)?.line;
      state.from = state.held && point;
      return Boolean(state.held);
    },
    drag(editor, point) { editor.state.to = snapToWall(editor.canvas, point, editor.state.line); editor.canvas.ask(); },
    drop(editor, point) {
      const { state, canvas } = editor;
      if (distance(point, state.from) > canvas.px(8)) this.place(editor, point);
    },
    click(editor, point) {
      if (editor.state.held) this.place(editor, point);
      else if (!this.grab(editor, point)) editor.tell("There is no door or window here.");
    },
    place(editor, point) {
      const { held, line } = editor.state;
      editor.state = {};
      editor.edit({ ...held, to: snapToWall(editor.canvas, point, line) });
    },
    hover(editor, point) { if (editor.state.held) editor.state.to = snapToWall(editor.canvas, point, editor.state.line); },
    draw(editor, pen) { if (editor.state.held && editor.state.to) dot(pen, editor.canvas, editor.state.to); },
  },
  mark: {
    key: "l", name: "Add landmark", icon: "M11 20s6-7 6-11A6 6 0 0 0 5 9c0 4 6 11 6 11zM11 9v.1", hint: "Click where a sign, a tag or an object is.",
    async click(editor, point) {
      const given = await ask("Landmark", [{ label: "Kind", options: MARK_KINDS }, { label: "Text", maxLength: 200, required: true }]);
      if (given) editor.edit({ op: "add_landmark", at: point, kind: given[0], value: given[1] });
    },
    draw(editor, pen) { if (editor.state.to) dot(pen, editor.canvas, editor.state.to); },
    hover(editor, point) { editor.state.to = point; },
  },
};

// What keys do to the selection, in any tool: key -> [words, what].
export const ACTIONS = {
  r: ["Rename room", (editor) => editor.askFor("rename_room", "Name of the room", "name")],
  k: ["Kind of room", (editor) => editor.askFor("set_room", "Kind of the room", "kind", KINDS)],
  a: ["Assign to an area", (editor) => editor.askFor("assign_area", "Area (a wing, a flat, a department)", "area")],
  o: ["Outside or inside", (editor) => editor.toggle("outside", "outside")],
  g: ["Only looked into, or entered", (editor) => editor.toggle("looked_into", "looked")],
  t: ["Open or shut the door", (editor) => editor.toggleDoor()],
  w: ["Width of the door or window", (editor) => editor.askWidth()],
  Delete: ["Delete the door, window or landmark", (editor) => editor.deletePicked()],
};
