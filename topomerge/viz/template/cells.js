// Cells on the graphics card. Each is a cube of which the three faces that can be seen are drawn, or a square of its size:
// straight from its number, without a list of corners and without instances, which are slow where there is no such card.

const ROW = 2048; // cells in a row of the texture that holds them
const VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2D cells; // x, y, z and group
uniform mat4 matrix;
uniform vec3 eye; // m from the scene's corner
uniform vec2 level; // m that the storey is lifted, cells below the cut
uniform float edge, size, ground, tall, pixels; // pixels: of 1 m at a distance of 1 m
uniform int first, corners; // of a cell: 18, or 1 for squares
uniform sampler2D colours;
flat out vec3 colour;
void main() {
  int which = gl_VertexID / corners + first, face = gl_VertexID % corners / 6;
  uvec4 cell = texelFetch(cells, ivec2(which % ${ROW}, which / ${ROW}), 0);
  vec3 middle = (vec3(cell.xyz) + 0.5) * edge + vec3(0.0, 0.0, level.x);
  vec3 side = sign(eye - middle), to = vec3(0.0), seen = abs(eye - middle);
  vec3 lights = vec3(side.x > 0.0 ? 0.80 : 0.68, side.y > 0.0 ? 0.74 : 0.86, 1.0);
  float lit = dot(lights, seen) / (seen.x + seen.y + seen.z); // of a square: as of the cube's three faces together
  if (corners > 1) {
    int corner = (3492 >> (2 * (gl_VertexID % 6))) & 3; // 0 1 2, 2 1 3
    vec2 at = vec2(corner & 1, corner >> 1) * 2.0 - 1.0;
    to = face == 0 ? vec3(side.x, at) : face == 1 ? vec3(at.x, side.y, at.y) : vec3(at, side.z);
    lit = lights[face];
  }
  gl_Position = float(cell.z) + 0.5 > level.y ? vec4(2.0, 2.0, 2.0, 1.0) : matrix * vec4(middle + to * 0.5 * edge * size, 1.0);
  gl_PointSize = clamp(1.3 * pixels * edge * size / gl_Position.w, 1.0, 64.0);
  int group = int(cell.w);
  vec3 paint = texelFetch(colours, ivec2(group & 255, group >> 8), 0).rgb;
  float high = clamp((float(cell.z) * edge - ground) / tall, 0.0, 1.0);
  colour = paint * lit * mix(0.86, 1.06, high);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
flat in vec3 colour;
out vec4 pixel;
void main() { pixel = vec4(min(colour, 1.0), 1.0); }`;

const pause = () => new Promise((go) => setTimeout(go));

// Four 16-bit numbers a cell, storey after storey, each in an order without a pattern. The page can be used meanwhile.
export async function decode(data) {
  const text = atob(data.data);
  const [, ny, nz] = data.shape;
  const storeys = data.storeys.map(() => 0);
  for (const [storey, , , count] of data.groups) storeys[storey] += count;
  const first = storeys.map((_, i) => storeys.slice(0, i).reduce((a, b) => a + b, 0));
  const rows = Math.max(Math.ceil(data.drawn / ROW), 1);
  const cells = new Uint16Array(rows * ROW * 4);
  const next = [...first];
  let at = 0;
  for (const [group, [storey, , , count]] of data.groups.entries()) {
    let number = 0, to = 4 * next[storey];
    for (let k = 0; k < count; k++) {
      let step = 0, place = 1, byte;
      do {
        byte = text.charCodeAt(at++);
        step += (byte & 127) * place; // not shifted: numbers go beyond 32 bits
        place *= 128;
      } while (byte & 128);
      number += step;
      const z = number % nz, rest = (number - z) / nz, y = rest % ny;
      cells[to++] = (rest - y) / ny;
      cells[to++] = y;
      cells[to++] = z;
      cells[to++] = group;
      if (k % 200000 === 199999) await pause();
    }
    next[storey] += count;
  }
  for (const [i, count] of storeys.entries()) await shuffle(new Uint32Array(cells.buffer, 8 * first[i], 2 * count));
  return { cells, rows, first, count: storeys };
}

async function shuffle(cells) { // two words each; so that the first part of them is a sparse picture of all
  let seed = 12345;
  for (let i = cells.length / 2 - 1; i > 0; i--) {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    const a = 2 * i, b = 2 * Math.floor((seed / 4294967296) * (i + 1));
    const [one, other] = [cells[a], cells[a + 1]];
    cells[a] = cells[b];
    cells[a + 1] = cells[b + 1];
    cells[b] = one;
    cells[b + 1] = other;
    if (i % 200000 === 0) await pause();
  }
}

export function program(gl) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) || "shaders");
  return made;
}

export function upload(gl, { cells, rows }) {
  gl.activeTexture(gl.TEXTURE1);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16UI, ROW, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT, cells);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  gl.activeTexture(gl.TEXTURE0);
}

export function makeRoom(gl, hidden, width, height) { // a framebuffer of this size for a picture with smooth edges
  if (hidden.width === width && hidden.height === height) return;
  const samples = Math.min(gl.getParameter(gl.MAX_SAMPLES), 4);
  for (const buffer of hidden.buffers || []) gl.deleteRenderbuffer(buffer);
  const kinds = [[gl.COLOR_ATTACHMENT0, gl.RGBA8], [gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24]];
  const buffers = kinds.map(([part, kind]) => {
    const buffer = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
    gl.renderbufferStorageMultisample(gl.RENDERBUFFER, samples, kind, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, part, gl.RENDERBUFFER, buffer);
    return buffer;
  });
  Object.assign(hidden, { width, height, buffers });
}

export function show(gl, hidden, width, height) {
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, hidden.frame);
  gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, null);
}

export const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));

export function paint(gl, texture, colours) {
  const rows = Math.max(Math.ceil(colours.length / 256), 1);
  const pixels = new Uint8Array(256 * rows * 4);
  colours.forEach((colour, i) => pixels.set([...colour, 255], 4 * i));
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
}
