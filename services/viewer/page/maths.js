// Vectors are arrays of three, quaternions x, y, z, w, matrices for WebGL column by column.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => scale(a, 1 / (norm(a) || 1));

export function turn(q, v) {
  const t = scale(cross(q, v), 2);
  return add(add(v, scale(t, q[3])), cross(q, t));
}

export function multiply(a, b) {
  const [ax, ay, az, aw] = a;
  const [bx, by, bz, bw] = b;
  return [
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
    aw * bw - ax * bx - ay * by - az * bz];
}

export const inverse = (q) => [-q[0], -q[1], -q[2], q[3]];
export const IDENTITY = [0, 0, 0, 1];

// Poses {p, q} are a_from_b.
export const apply = (pose, v) => add(turn(pose.q, v), pose.p);
export const compose = (a, b) => ({ p: apply(a, b.p), q: multiply(a.q, b.q) });
export function inversePose(pose) {
  const q = inverse(pose.q);
  return { p: scale(turn(q, pose.p), -1), q };
}

// Axes of an ellipsoid of one standard deviation, from the covariance xx, xy, xz, yy, yz, zz: Jacobi's
// method.
export function ellipsoid(c) {
  const m = [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]];
  const v = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let sweep = 0; sweep < 12; sweep++) {
    for (const [i, j] of [[0, 1], [0, 2], [1, 2]]) {
      if (Math.abs(m[i][j]) < 1e-15) continue;
      const theta = (m[j][j] - m[i][i]) / (2 * m[i][j]);
      const t = Math.sign(theta || 1) / (Math.abs(theta) + Math.hypot(theta, 1));
      const cos = 1 / Math.hypot(t, 1);
      const sin = t * cos;
      for (let k = 0; k < 3; k++) {
        const [a, b] = [m[k][i], m[k][j]];
        [m[k][i], m[k][j]] = [cos * a - sin * b, sin * a + cos * b];
      }
      for (let k = 0; k < 3; k++) {
        const [a, b] = [m[i][k], m[j][k]];
        [m[i][k], m[j][k]] = [cos * a - sin * b, sin * a + cos * b];
      }
      for (let k = 0; k < 3; k++) {
        const [a, b] = [v[k][i], v[k][j]];
        [v[k][i], v[k][j]] = [cos * a - sin * b, sin * a + cos * b];
      }
    }
  }
  return [0, 1, 2].map((k) =>
    scale([v[0][k], v[1][k], v[2][k]], Math.sqrt(Math.max(m[k][k], 0))));
}

export function perspective(fieldOfView, aspect, near, far) {
  const f = 1 / Math.tan(fieldOfView / 2);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1,
    0, 0, (2 * far * near) / (near - far), 0];
}

export function lookAt(eye, centre, up) {
  const z = unit(sub(eye, centre));
  const x = unit(cross(up, z));
  const y = cross(z, x);
  return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0,
    -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
}

export function times(a, b) {
  const out = new Array(16).fill(0);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      for (let k = 0; k < 4; k++) out[4 * column + row] += a[4 * k + row] * b[4 * column + k];
    }
  }
  return out;
}
