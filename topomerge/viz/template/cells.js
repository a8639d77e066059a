// Cells on the graphics card: each a cube of which the three faces that can be seen are drawn, straight from its number.

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
layout(location = 0) in uvec4 cell; // x, y, z and group
uniform mat4 matrix;
uniform vec3 eye; // m from the scene's corner
uniform vec2 level; // m that the storey is lifted, cells below the cut
uniform float edge, size, ground, tall;
uniform sampler2D colours;
flat out vec3 colour;
void main() {
  int face = gl_VertexID / 4, corner = gl_VertexID % 4;
  vec3 middle = (vec3(cell.xyz) + 0.5) * edge + vec3(0.0, 0.0, level.x);
  vec3 side = sign(eye - middle);
  vec2 at = vec2(corner & 1, corner >> 1) * 2.0 - 1.0;
  vec3 to = face == 0 ? vec3(side.x, at) : face == 1 ? vec3(at.x, side.y, at.y) : vec3(at, side.z);
  gl_Position = float(cell.z) + 0.5 > level.y ? vec4(2.0, 2.0, 2.0, 1.0) : matrix * vec4(middle + to * 0.5 * edge * size, 1.0);
  int group = int(cell.w);
  vec3 paint = texelFetch(colours, ivec2(group & 255, group >> 8), 0).rgb;
  float lit = face == 0 ? (side.x > 0.0 ? 0.80 : 0.68) : face == 1 ? (side.y > 0.0 ? 0.74 : 0.86) : 1.0;
  float high = clamp((float(cell.z) * edge - ground) / tall, 0.0, 1.0);
  colour = paint * lit * mix(0.86, 1.06, high);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
flat in vec3 colour;
out vec4 pixel;
void main() { pixel = vec4(min(colour, 1.0), 1.0); }`;

function decode(data) { // four 16-bit numbers a cell, storey after storey, each in an order without a pattern
  const text = atob(data.data);
  const [, ny, nz] = data.shape;
  const storeys = data.storeys.map(() => 0);
  for (const [storey, , , count] of data.groups) storeys[storey] += count;
  const first = storeys.map((_, i) => storeys.slice(0, i).reduce((a, b) => a + b, 0));
  const cells = new Uint16Array(data.drawn * 4);
  const next = [...first];
  let at = 0;
  data.groups.forEach(([storey, , , count], group) => {
    let number = 0;
    for (let k = 0; k < count; k++) {
      let step = 0, place = 1, byte;
      do {
        byte = text.charCodeAt(at++);
        step += (byte & 127) * place; // not shifted: numbers go beyond 32 bits
        place *= 128;
      } while (byte & 128);
      number += step;
      const z = number % nz, rest = (number - z) / nz, y = rest % ny;
      cells.set([(rest - y) / ny, y, z, group], 4 * next[storey]++);
    }
  });
  storeys.forEach((count, i) => shuffle(cells.subarray(4 * first[i], 4 * (first[i] + count))));
  return { cells, first, count: storeys };
}

function shuffle(cells) { // so that the first part of them is a sparse picture of all
  let seed = 12345;
  for (let i = cells.length / 4 - 1; i > 0; i--) {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    const j = Math.floor((seed / 4294967296) * (i + 1));
    for (let k = 0; k < 4; k++) {
      const kept = cells[4 * i + k];
      cells[4 * i + k] = cells[4 * j + k];
      cells[4 * j + k] = kept;
    }
  }
}

function program(gl) {
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

function upload(gl, cells) {
  const corners = gl.createBuffer(), faces = [0, 4, 8].flatMap((v) => [v, v + 1, v + 2, v + 2, v + 1, v + 3]);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, corners);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(faces), gl.STATIC_DRAW);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, cells, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribDivisor(0, 1);
}

const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));

function paint(gl, texture, colours) {
  const rows = Math.max(Math.ceil(colours.length / 256), 1);
  const pixels = new Uint8Array(256 * rows * 4);
  colours.forEach((colour, i) => pixels.set([...colour, 255], 4 * i));
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
}
