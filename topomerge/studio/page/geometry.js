// Points, lines and affine maps [a, b, c, d, e, f]: (x, y) -> (a x + b y + c, d x + e y + f).

export const apply = (m, [x, y]) => [m[0] * x + m[1] * y + m[2], m[3] * x + m[4] * y + m[5]];

export function compose(m, n) { // first n, then m
  return [
    m[0] * n[0] + m[1] * n[3], m[0] * n[1] + m[1] * n[4], m[0] * n[2] + m[1] * n[5] + m[2],
    m[3] * n[0] + m[4] * n[3], m[3] * n[1] + m[4] * n[4], m[3] * n[2] + m[4] * n[5] + m[5],
  ];
}

export function invert(m) {
  const det = m[0] * m[4] - m[1] * m[3];
  const [a, b, d, e] = [m[4] / det, -m[1] / det, -m[3] / det, m[0] / det];
  return [a, b, -(a * m[2] + b * m[5]), d, e, -(d * m[2] + e * m[5])];
}

export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

export function nearestOnSegment(p, a, b) {
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
  const long = dx * dx + dy * dy;
  const t = long ? Math.min(Math.max(((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / long, 0), 1) : 0;
  return [a[0] + t * dx, a[1] + t * dy];
}

export function parseRings(d) { // closed rings of a path of steps, as the server traces them
  return d.split("z").slice(0, -1).map((ring) => {
    const numbers = ring.slice(1).replace("l", " ").split(" ").map(Number);
    const points = [[numbers[0], numbers[1]]];
    for (let k = 2; k + 1 < numbers.length; k += 2) {
      const last = points[points.length - 1];
      points.push([last[0] + numbers[k], last[1] + numbers[k + 1]]);
    }
    return points;
  });
}

export function boxOf(rings) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  for (const ring of rings) for (const [x, y] of ring) {
    box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
  }
  return box;
}

export function crosses(a, b, p, q) { // do two segments cross?
  const side = (u, v, w) => Math.sign((v[0] - u[0]) * (w[1] - u[1]) - (v[1] - u[1]) * (w[0] - u[0]));
  return side(a, b, p) * side(a, b, q) < 0 && side(p, q, a) * side(p, q, b) < 0;
}
