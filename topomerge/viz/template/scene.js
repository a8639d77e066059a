// The 3D view of a map's cells: its controls, and what is drawn when.

const LONGEST = 400; // ms that one pass may take once the view rests: what is not drawn by then follows in the next

function control(kind, words, settings, changed) {
  const label = document.createElement("label"), input = document.createElement("input"), output = document.createElement("output");
  Object.assign(input, { type: kind, ...settings });
  input.addEventListener("input", () => changed(kind === "checkbox" ? input.checked : Number(input.value), output));
  label.append(...(kind === "range" ? [words + " ", input, " ", output] : [input, " " + words]));
  return label;
}

function openScene(place) {
  const missing = place.querySelector(".missing");
  try {
    if (!startScene(place)) place.replaceChildren(missing);
    place.dataset.state = place.contains(missing) ? "missing" : "shown";
  } catch (error) { // a driver that compiles nothing
    place.replaceChildren(missing);
    place.dataset.state = `missing: ${error.message}`;
  }
  place.classList.remove("waiting");
}

function startScene(place) {
  const data = JSON.parse(document.getElementById(place.dataset.scene).textContent);
  const stage = document.createElement("div"), canvas = document.createElement("canvas"), words = document.createElement("canvas");
  stage.className = "stage";
  words.className = "words";
  stage.tabIndex = 0;
  stage.append(canvas, words);
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true, powerPreference: "high-performance" });
  if (!gl || !data.drawn) return false; // the words that stand there say why
  const missing = place.querySelector(".missing");
  canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); stopped(place, missing); });
  const made = program(gl), at = (name) => gl.getUniformLocation(made, name);
  const cells = decode(data), texture = gl.createTexture();
  upload(gl, cells.cells);
  const extent = data.shape.map((n) => n * data.edge);
  const [near, far] = data.look || [[0, 0, 0], extent];
  const size = Math.hypot(far[0] - near[0], far[1] - near[1]);
  const camera = makeCamera(near.map((v, i) => (v + far[i]) / 2), size, data.turn, data.storeys.length);
  const start = { ...camera, target: [...camera.target] };
  const shown = data.storeys.map(() => true);
  const state = { cut: 2, apart: 0, numbers: true, colour: Object.keys(data.colours)[0], share: 1, rest: 1, drawn: 0, still: true, timer: 0, asked: false };
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
    if (!state.still && last) { // too slow while moving: draw fewer, larger cubes
      const took = time - last;
      if (took > 45) state.share = Math.max(state.share * 0.7, 0.02);
      else if (took < 22) state.share = Math.min(state.share * 1.15, 1);
    }
    last = state.still ? 0 : time;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    for (const one of [canvas, words]) {
      const [w, h] = [Math.round(stage.clientWidth * ratio), Math.round(stage.clientHeight * ratio)];
      if (one.width !== w || one.height !== h) [one.width, one.height] = [w, h];
    }
    if (!canvas.width) return;
    const matrix = matrixOf(camera, canvas.width / canvas.height);
    if (state.still) {
      drawCells(matrix, state.drawn, Math.min(state.drawn + state.rest, 1), 1);
      state.drawn += state.rest;
      if (state.drawn < 1) again();
    } else drawCells(matrix, 0, state.share, Math.min(1 / Math.sqrt(state.share), 4));
    drawNumbers(matrix, ratio);
  }

  function drawCells(matrix, from, to, cube) { // shares of the cells of each storey; what was drawn before stays
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...rgb(hexOf("--faint")).map((v) => v / 255), 1);
    if (from === 0) gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(made);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniformMatrix4fv(at("matrix"), false, matrix);
    gl.uniform3fv(at("eye"), eyeOf(camera));
    gl.uniform1f(at("edge"), data.edge);
    gl.uniform1f(at("size"), cube);
    gl.uniform1f(at("tall"), 2.5);
    data.storeys.forEach(({ floor }, storey) => {
      if (!shown[storey] || !cells.count[storey]) return;
      const ground = floor - data.origin[2];
      gl.uniform1f(at("ground"), ground);
      gl.uniform2f(at("level"), state.apart * storey, state.cut === null ? 1e9 : (ground + state.cut) / data.edge);
      const [first, end] = [from, to].map((share) => Math.ceil(cells.count[storey] * share));
      gl.vertexAttribIPointer(0, 4, gl.UNSIGNED_SHORT, 8, 8 * (cells.first[storey] + first));
      gl.drawElementsInstanced(gl.TRIANGLES, 18, gl.UNSIGNED_SHORT, 0, end - first);
    });
  }

  function measure() { // where a computer draws without a graphics card, not all cells in one go: it would stand still
    const matrix = matrixOf(camera, canvas.width / canvas.height), pixel = new Uint8Array(4);
    const took = [0.001, 0.001, 0.1].map((share) => { // the first also makes the shaders ready
      const began = performance.now();
      drawCells(matrix, 0, share, 1);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits for the drawing
      return performance.now() - began;
    });
    const all = (took[2] - took[1]) * 10;
    state.rest = Math.min(Math.max((LONGEST - took[1]) / Math.max(all, 1), 0.05), 1);
    state.share = Math.min(state.rest, 60 / Math.max(all, 1));
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
      if (!spot || taken.some(([u, v]) => Math.abs(u - spot[0]) < 20 * ratio && Math.abs(v - spot[1]) < 13 * ratio)) continue;
      taken.push(spot);
      pen.strokeText(key, spot[0], spot[1]);
      pen.fillText(key, spot[0], spot[1]);
    }
  }

  function ask() { // from anew
    state.drawn = 0;
    again();
  }

  function again() {
    if (!state.asked) requestAnimationFrame(frame);
    state.asked = true;
  }

  function moved() { // fewer cubes now, all of them once it rests
    state.still = false;
    clearTimeout(state.timer);
    state.timer = setTimeout(() => { state.still = true; ask(); }, 180);
    ask();
  }

  function controls() {
    const bar = document.createElement("div");
    bar.className = "controls";
    const tallest = Math.ceil(10 * Math.max(...data.storeys.map(({ floor }, i) => (data.storeys[i + 1] ? data.storeys[i + 1].floor : data.origin[2] + extent[2]) - floor))) / 10;
    state.cut = Math.min(2, tallest * 0.75);
    const cut = control("range", "Cut at", { min: 0.1, max: tallest + 0.1, step: 0.1, value: state.cut }, (value, output) => {
      state.cut = value > tallest ? null : value;
      output.textContent = state.cut === null ? "nothing" : `${value.toFixed(1)} m`;
      ask();
    });
    const parts = [cut];
    if (data.storeys.length > 1) {
      const most = Math.max(size * 0.6, 4);
      parts.push(control("range", "Storeys apart", { min: 0, max: most, step: most / 100, value: most * 0.5 }, (value, output) => {
        const rise = ((value - state.apart) * (data.storeys.length - 1)) / 2; // the middle stays in the middle
        camera.target[2] += rise;
        start.target[2] += rise;
        state.apart = value;
        output.textContent = `${value.toFixed(1)} m`;
        ask();
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
    for (const [name, pitch] of [["From above", Math.PI / 2 - 0.001], ["Aslant", start.pitch]]) {
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
  told.textContent = `Drag to turn, with shift to move; click, then scroll to zoom.${merged}`;
  place.replaceChildren(controls(), stage, told);
  [canvas.width, canvas.height] = [stage.clientWidth, stage.clientHeight];
  measure();
  startCamera(stage, camera, moved);
  document.addEventListener("lit", () => { recolour(); ask(); });
  document.addEventListener("theme", () => { recolour(); ask(); });
  new ResizeObserver(ask).observe(stage);
  return true;
}

function stopped(place, missing) {
  const again = document.createElement("button");
  again.type = "button";
  again.textContent = "Show it again";
  again.addEventListener("click", () => openScene(place));
  missing.replaceChildren("The browser stopped the 3D view. ", again);
  place.replaceChildren(missing);
}

function hexOf(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
