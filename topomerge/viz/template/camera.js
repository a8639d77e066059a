// A camera that orbits a target, z up. Matrices are column-major, as WebGL wants them.

import { startDrag } from "./plan.js";
export const HALF = Math.tan(0.42); // of half of the field of view, across the shorter side

export function makeCamera(centre, size, turn, storeys) { // `turn`: what stands upright on paper does here, too
  return { target: [...centre], distance: size * (0.72 + 0.24 * Math.min(storeys - 1, 4)), yaw: -Math.PI / 2 - turn, pitch: storeys > 1 ? 0.75 : 0.95, size };
}

export function eyeOf(camera) {
  const flat = Math.cos(camera.pitch);
  const way = [flat * Math.cos(camera.yaw), flat * Math.sin(camera.yaw), Math.sin(camera.pitch)];
  return camera.target.map((value, i) => value + camera.distance * way[i]);
}

function axesOf(camera) { // right, up and back, of length 1
  const [c, s, cp, sp] = [Math.cos(camera.yaw), Math.sin(camera.yaw), Math.cos(camera.pitch), Math.sin(camera.pitch)];
  return [[-s, c, 0], [-sp * c, -sp * s, cp], [cp * c, cp * s, sp]];
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export function matrixOf(camera, aspect) {
  const axes = axesOf(camera), eye = eyeOf(camera);
  const near = Math.max(camera.distance * 0.02, 0.05), far = camera.distance + camera.size * 3 + 10;
  const f = 1 / HALF;
  const scale = [aspect > 1 ? f / aspect : f, aspect > 1 ? f : f * aspect];
  const moved = axes.map((axis) => -dot(axis, eye));
  const a = (far + near) / (near - far), b = (2 * far * near) / (near - far);
  const m = new Float32Array(16);
  for (let i = 0; i < 3; i++) {
    m.set([scale[0] * axes[0][i], scale[1] * axes[1][i], a * axes[2][i], -axes[2][i]], 4 * i);
  }
  m.set([scale[0] * moved[0], scale[1] * moved[1], a * moved[2] + b, -moved[2]], 12);
  return m;
}

export function project(matrix, point, width, height) { // pixels and depth, or null behind the eye
  const row = (i) => matrix[i] * point[0] + matrix[4 + i] * point[1] + matrix[8 + i] * point[2] + matrix[12 + i];
  const w = row(3);
  return w > 0 ? [(row(0) / w + 1) * 0.5 * width, (1 - row(1) / w) * 0.5 * height, w] : null;
}

function orbit(camera, dx, dy) {
  camera.yaw -= dx * 0.006;
  camera.pitch = Math.min(Math.max(camera.pitch + dy * 0.006, -0.2), Math.PI / 2 - 0.001);
}

function pan(camera, dx, dy, height) {
  const step = (camera.distance * 2 * HALF) / height;
  const [right, up] = axesOf(camera);
  camera.target = camera.target.map((value, i) => value - dx * step * right[i] + dy * step * up[i]);
}

function dolly(camera, factor) {
  camera.distance = Math.min(Math.max(camera.distance * factor, camera.size * 0.01 + 0.2), camera.size * 6 + 5);
}

export function startCamera(area, camera, changed) {
  let panning = false;
  area.addEventListener("contextmenu", (event) => event.preventDefault());
  area.addEventListener("pointerdown", (event) => { panning = event.button > 0 || event.shiftKey || event.ctrlKey; });
  startDrag(area, (pointers, dx, dy, pinch) => {
    if (panning || pointers > 1) pan(camera, dx, dy, area.clientHeight);
    else orbit(camera, dx, dy);
    if (pinch !== 1) dolly(camera, 1 / pinch);
    changed();
  });
  area.addEventListener("wheel", (event) => {
    if (!area.contains(document.activeElement) && !event.ctrlKey) return;
    event.preventDefault();
    dolly(camera, Math.exp(event.deltaY * (event.deltaMode ? 0.05 : 0.0012)));
    changed();
  }, { passive: false });
  area.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, -20], ArrowDown: [0, 20] }[event.key];
    if (step && event.shiftKey) pan(camera, -step[0], -step[1], area.clientHeight);
    else if (step) orbit(camera, ...step);
    else if (event.key !== "" && "+-=".includes(event.key)) dolly(camera, event.key === "-" ? 1.2 : 1 / 1.2);
    else return;
    event.preventDefault();
    changed();
  });
}
