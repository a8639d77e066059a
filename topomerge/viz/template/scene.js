// The 3D view of a map's cells: its controls, and what is drawn when.

import { lit } from "./plan.js";
import { HALF, eyeOf, makeCamera, matrixOf, project, startCamera } from "./camera.js";
import { decode, makeRoom, paint, program, rgb, show, upload } from "./cells.js";

// While the view moves, cells are left out (down to FEWEST) so that a picture comes every QUICK ms; once it rests, all are
// drawn behind the screen, in passes of about LONGEST ms, so that the page never stands still.
const QUICK = 60, LONGEST = 150;
const BEGIN = 200000, FEWEST = 50000; // cells that are drawn before it is known how long that takes, and at least
const FINE = 1.5; // pixels: smaller cubes are drawn as squares

function control(kind, words, settings, changed) {
  const label = document.createElement("label"), input = document.createElement("input"), output = document.createElement("output");
  Object.assign(input, { type: kind, ...settings });
  input.addEventListener("input", () => changed(kind === "checkbox" ? input.checked : Number(input.value), output));
  label.append(...(kind === "range" ? [words + " ", input, " ", output] : [input, " " + words]));
  return label;
}

export async function openScene(place, data = JSON.parse(document.getElementById(place.dataset.scene).textContent)) {
  const missing = place.querySelector(".missing");
  try {
    if (!(await startScene(place, data))) place.replaceChildren(missing);
    place.dataset.state = place.contains(missing) ? "missing" : "shown";
  } catch (error) { // a driver that compiles nothing
    place.replaceChildren(missing);
    place.dataset.state = `missing: ${error.message}`;
  }
  place.classList.remove("waiting");
}

async function startScene(place, data) {
  const stage = document.createElement("div"), canvas = document.createElement("canvas"), words = document.createElement("canvas");
  stage.className = "stage";
  words.className = "words";
  stage.tabIndex = 0;
  stage.append(canvas, words);
  const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true, powerPreference: "high-performance" });
  if (!gl || !data.drawn) return false; // the words that stand there say why
  const missing = place.querySelector(".missing");
  canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); stopped(place, missing, data); });
  const made = program(gl), at = (name) => gl.getUniformLocation(made, name);
  const cells = await decode(data), texture = gl.createTexture();
  upload(gl, cells);
  const hidden = { frame: gl.createFramebuffer() };
  const extent = data.shape.map((n) => n * data.edge);
  const [near, far] = data.look || [[0, 0, 0], extent];
  const size = Math.hypot(far[0] - near[0], far[1] - near[1]);
  const camera = makeCamera(near.map((v, i) => (v + far[i]) / 2), size, data.turn, data.storeys.length);
  const start = { ...camera, target: [...camera.target] };
  const shown = data.storeys.map(() => true);
  const state = { cut: 2, apart: 0, numbers: true, colour: Object.keys(data.colours)[0], share: Math.min(BEGIN / data.drawn, 1), rest: Math.min(BEGIN / data.drawn, 1), cubes: false, slow: false, drawn: 0, pass: null, began: 0, still: true, timer: 0, asked: false };
  let last = 0;

  function recolour() {
    const soft = rgb(hexOf("--seen"));
    const room = lit && lit.startsWith("room ") ? lit.slice(5) : null;
    const known = data.rooms.findIndex(([key]) => key === room);
    const base = data.colours[state.colour].map(rgb);
    paint(gl, texture, known < 0 ? base : base.map((c, i) => (data.groups[i][1] === known ? c : c.map((v, k) => 0.3 * v + 0.7 * soft[k]))));
  }

  function frame(time) {
    state.asked = false;
    if (!state.still && last) adapt(time - last);
    last = state.still ? 0 : time;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    for (const one of [canvas, words]) {
      const [w, h] = [Math.round(stage.clientWidth * ratio), Math.round(stage.clientHeight * ratio)];
      if (one.width !== w || one.height !== h) [one.width, one.height] = [w, h];
    }
    if (!canvas.width) return;
    const matrix = matrixOf(camera, canvas.width / canvas.height);
    const anew = !state.still || state.drawn === 0;
    if (anew && !(state.still && state.rest === 1)) {
      drawCells(matrix, 0, state.share, Math.min(1 / Math.sqrt(state.share), 4), state.cubes);
    }
    if (state.still) pass(matrix);
    if (!state.still || state.drawn < 1) again();
    stage.dataset.whole = state.still && state.drawn === 1;
    if (anew) drawNumbers(matrix, ratio);
  }

  function pass(matrix) { // some more of the cells, once those before are drawn
    const cubes = (pixels() * data.edge) / camera.distance > FINE;
    if (state.pass) {
      if (gl.clientWaitSync(state.pass, 0, 0) === gl.TIMEOUT_EXPIRED) return;
      gl.deleteSync(state.pass);
      state.pass = null;
      const took = performance.now() - state.began;
      const least = Math.min((cubes ? FEWEST / 2 : 3 * FEWEST) / data.drawn, 1); // smaller passes would only be more
      state.rest = Math.min(Math.max(state.rest * (took > 1.5 * LONGEST ? 0.6 : took < 0.6 * LONGEST ? 1.6 : 1), least), 1);
    }
    const whole = [canvas.width, canvas.height], to = Math.min(state.drawn + state.rest, 1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, hidden.frame);
    if (state.drawn === 0) makeRoom(gl, hidden, ...whole);
    drawCells(matrix, state.drawn, to, 1, cubes);
    state.drawn = to;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    if (to === 1) show(gl, hidden, ...whole);
    else state.pass = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    state.began = performance.now();
  }

  function adapt(took) { // as many cells as this machine can draw in time
    const fewest = Math.min(FEWEST / data.drawn, 1);
    if (took > 1.5 * QUICK && state.cubes) [state.cubes, state.slow] = [false, true];
    else if (took > 1.5 * QUICK) state.share = Math.max(state.share * 0.7, fewest);
    else if (took < 0.6 * QUICK && state.share < 1) state.share = Math.min(state.share * 1.15, 1);
    else if (took < 0.6 * QUICK) state.cubes = !state.slow;
  }

  const pixels = () => (0.5 * Math.min(canvas.width, canvas.height)) / HALF; // of 1 m at a distance of 1 m

  function drawCells(matrix, from, to, size, cubes) { // shares of the cells of each storey; what was drawn before them stays
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...rgb(hexOf("--faint")).map((v) => v / 255), 1);
    if (from === 0) gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(made);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniformMatrix4fv(at("matrix"), false, matrix);
    gl.uniform3fv(at("eye"), eyeOf(camera));
    gl.uniform1f(at("edge"), data.edge);
    gl.uniform1f(at("size"), size);
    gl.uniform1f(at("tall"), 2.5);
    gl.uniform1f(at("pixels"), pixels());
    gl.uniform1i(at("cells"), 1);
    const corners = cubes ? 18 : 1;
    gl.uniform1i(at("corners"), corners);
    let drawn = 0;
    data.storeys.forEach(({ floor }, storey) => {
      if (!shown[storey] || !cells.count[storey]) return;
      const ground = floor - data.origin[2];
      gl.uniform1f(at("ground"), ground);
      gl.uniform2f(at("level"), state.apart * storey, state.cut === null ? 1e9 : (ground + state.cut) / data.edge);
      const [first, end] = [from, to].map((share) => Math.ceil(cells.count[storey] * share));
      gl.uniform1i(at("first"), cells.first[storey] + first);
      gl.drawArrays(cubes ? gl.TRIANGLES : gl.POINTS, 0, corners * (end - first));
      drawn += end - first;
    });
    stage.dataset.drawn = drawn;
  }

  function drawNumbers(matrix, ratio) {
    const pen = words.getContext("2d");
    pen.clearRect(0, 0, words.width, words.height);
    if (!state.numbers) return;
    pen.font = `600 ${12 * ratio}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.lineWidth = 3 * ratio;
    pen.lineJoin = "round";
    pen.strokeStyle = hexOf("--halo");
    pen.fillStyle = hexOf("--ink");
    const taken = [];
    const top = shown.lastIndexOf(true);
    for (const [key, storey, x, y] of data.rooms) {
      if (!shown[storey] || (storey < top && state.apart < 0.1 * size)) continue; // those above would stand on those below
      const z = data.storeys[storey].floor - data.origin[2] + 0.6 + state.apart * storey;
      const spot = project(matrix, [x - data.origin[0], y - data.origin[1], z], words.width, words.height);
      if (!spot || taken.some(([u, v]) => Math.abs(u - spot[0]) < (6 + 8 * key.length) * ratio && Math.abs(v - spot[1]) < 13 * ratio)) continue;
      taken.push(spot);
      pen.strokeText(key, spot[0], spot[1]);
      pen.fillText(key, spot[0], spot[1]);
    }
  }

  function ask() { // from anew
    state.drawn = 0;
    gl.deleteSync(state.pass);
    state.pass = null;
    again();
  }

  function again() {
    if (!state.asked) requestAnimationFrame(frame);
    state.asked = true;
  }

  function moved() { // fewer cubes now, all of them once it rests
    state.still = false;
    clearTimeout(state.timer);
    state.timer = setTimeout(() => { state.still = true; ask(); }, 250);
    ask();
  }

  function controls() {
    const bar = document.createElement("div");
    bar.className = "controls";
    const tallest = Math.ceil(10 * Math.max(...data.storeys.map(({ floor }, i) => (data.storeys[i + 1] ? data.storeys[i + 1].floor : data.origin[2] + extent[2]) - floor))) / 10;
    state.cut = Math.min(2, tallest * 0.75);
    const cut = control("range", "Cut at", { min: 0.1, max: tallest + 0.1, step: 0.1, value: state.cut }, (value, output) => {
      state.cut = value > tallest ? null : value;
      output.textContent = state.cut === null ? "off" : `${value.toFixed(1)} m`;
      moved();
    });
    const parts = [cut];
    if (data.storeys.length > 1) {
      const most = Math.max(size * 0.6, 4);
      parts.push(control("range", "Storey spacing", { min: 0, max: most, step: most / 100, value: most * 0.5 }, (value, output) => {
        const rise = ((value - state.apart) * (data.storeys.length - 1)) / 2; // the middle stays in the middle
        camera.target[2] += rise;
        start.target[2] += rise;
        state.apart = value;
        output.textContent = `${value.toFixed(1)} m`;
        moved();
      }));
      const boxes = document.createElement("span");
      boxes.className = "layers";
      boxes.append("Storeys", ...data.storeys.map(({ name }, i) => control("checkbox", name, { checked: true }, (on) => { shown[i] = on; ask(); })));
      parts.push(boxes);
    }
    const names = Object.keys(data.colours);
    if (names.length > 1) {
      const choice = document.createElement("select");
      choice.append(...names.map((name) => new Option(name)));
      choice.addEventListener("change", () => { state.colour = choice.value; recolour(); ask(); });
      const label = document.createElement("label");
      label.append("Colour by ", choice);
      parts.push(label);
    }
    parts.push(control("checkbox", "numbers", { checked: true }, (on) => { state.numbers = on; ask(); }));
    const views = document.createElement("span");
    views.className = "zoom";
    for (const [name, pitch] of [["From above", Math.PI / 2 - 0.001], ["Oblique", start.pitch]]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = name;
      button.style.width = "auto";
      button.style.padding = "3px 10px";
      button.addEventListener("click", () => {
        Object.assign(camera, start, { target: [...start.target], pitch });
        ask();
      });
      views.append(button);
    }
    bar.append(...parts, views);
    for (const input of bar.querySelectorAll('input[type="range"]')) input.dispatchEvent(new Event("input"));
    return bar;
  }

  recolour();
  const told = document.createElement("p");
  told.className = "told";
  const merged = data.merged > 1 ? ` Of ${data.cells.toLocaleString("en")} cells, cubes of ${data.merged} × ${data.merged} × ${data.merged} are drawn as one.` : "";
  told.textContent = `Drag to rotate, with shift to move; click, then scroll to zoom.${merged}`;
  place.replaceChildren(controls(), stage, told);
  [canvas.width, canvas.height] = [stage.clientWidth, stage.clientHeight];
  startCamera(stage, camera, moved);
  document.addEventListener("lit", () => { recolour(); ask(); });
  document.addEventListener("theme", () => { recolour(); ask(); });
  new ResizeObserver(ask).observe(stage);
  return true;
}

function stopped(place, missing, data) {
  const again = document.createElement("button");
  again.type = "button";
  again.textContent = "Show it again";
  again.addEventListener("click", () => openScene(place, data));
  missing.replaceChildren("The browser stopped the 3D view. ", again);
  place.replaceChildren(missing);
}

export function hexOf(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
