// The sphere as the camera sees it, drawn by WebGL: flat (equirectangular) or in perspective. Both can be
// panned and zoomed. Rays are in the camera frame: x ahead, y left, z up.

import { cross, dot, unit } from "./maths.js";
import { fit, link } from "./shader.js";

const VERTEX = `
attribute vec2 corner;
varying vec2 at;
void main() { at = corner; gl_Position = vec4(corner, 0.0, 1.0); }`;

const FRAGMENT = `
precision highp float;
varying vec2 at;
uniform sampler2D picture;
uniform bool flatView;
uniform vec2 centre;   // flat: the middle of the window, in pictures
uniform vec2 extent;   // flat: half of the window, in pictures; perspective: half of it at distance 1
uniform vec3 right, up, ahead;
uniform float light;   // 1, or less where the picture is of another frame than what is drawn over it
const float PI = 3.14159265358979;
void main() {
  vec2 uv;
  if (flatView) {
    uv = centre + vec2(at.x, -at.y) * extent;
    if (uv.y < 0.0 || uv.y > 1.0) { gl_FragColor = vec4(0.024, 0.031, 0.047, 1.0); return; }
  } else {
    vec3 ray = normalize(ahead + right * at.x * extent.x + up * at.y * extent.y);
    uv = vec2(0.5 - atan(ray.y, ray.x) / (2.0 * PI), 0.5 - asin(clamp(ray.z, -1.0, 1.0)) / PI);
  }
  float grey = texture2D(picture, vec2(fract(uv.x), uv.y)).r;
  gl_FragColor = vec4(vec3(grey * light), 1.0);
}`;

const FIELD_DEG = [2, 120];
const MAX_ZOOM = 30;
const POLE = Math.PI / 2 - 1e-3;

export class Sphere {
  constructor(canvas, surface, redraw) {
    Object.assign(this, { canvas, surface, redraw });
    this.reset();
    this.start();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.start();
      this.uploaded = null;
      redraw();
    });
    this.listen();
  }

  reset() {
    this.flat = true;
    this.window = { u: 0.5, v: 0.5, zoom: 1 };
    this.eye = { yaw: 0, pitch: 0, field: (80 * Math.PI) / 180 };
  }

  start() {
    const gl = this.canvas.getContext("webgl", { antialias: false, preserveDrawingBuffer: true });
    this.gl = gl;
    if (!gl) return;
    const program = link(gl, VERTEX, FRAGMENT);
    this.place = (name) => gl.getUniformLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 3, -1, -1, 3]), gl.STATIC_DRAW);
    const corner = gl.getAttribLocation(program, "corner");
    gl.enableVertexAttribArray(corner);
    gl.vertexAttribPointer(corner, 2, gl.FLOAT, false, 0, 0);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    // Pictures need not have sides that are powers of two; the shader wraps by itself.
    for (const [parameter, value] of [[gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE],
      [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE], [gl.TEXTURE_MIN_FILTER, gl.LINEAR],
      [gl.TEXTURE_MAG_FILTER, gl.LINEAR]]) gl.texParameteri(gl.TEXTURE_2D, parameter, value);
    this.blacken();
  }

  blacken() {
    const { gl } = this;
    const black = new Uint8Array([16]);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.LUMINANCE, 1, 1, 0, gl.LUMINANCE, gl.UNSIGNED_BYTE, black);
    this.uploaded = null;
  }

  resize() {
    const ratio = fit(this.canvas, this.surface);
    this.width = this.surface.clientWidth;
    this.height = this.surface.clientHeight;
    return ratio;
  }

  // Half of the window: of the flat picture in pictures, else at distance 1.
  extent() {
    if (this.flat) {
      // At zoom 1 the whole picture is there: it is twice as wide as high.
      const aspect = this.width / Math.max(this.height, 1);
      const wide = aspect > 2 ? aspect / 2 : 1;
      const high = aspect > 2 ? 1 : 2 / aspect;
      return [wide / 2 / this.window.zoom, high / 2 / this.window.zoom];
    }
    const half = Math.tan(this.eye.field / 2);
    const larger = Math.max(this.width, this.height);
    return [(half * this.width) / larger, (half * this.height) / larger];
  }

  axes() {
    const { yaw, pitch } = this.eye;
    const ahead = [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)];
    const right = [Math.sin(yaw), -Math.cos(yaw), 0];
    return { ahead, right, up: cross(right, ahead) };
  }

  // `bitmap`: a new picture; null: none at all; otherwise the last one stays.
  draw(bitmap, light = 1) {
    const gl = this.gl;
    if (!gl || gl.isContextLost()) return;
    if (bitmap === null && this.uploaded) this.blacken();
    if (bitmap && bitmap !== this.uploaded) {
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.LUMINANCE, gl.LUMINANCE, gl.UNSIGNED_BYTE, bitmap);
      this.uploaded = bitmap;
    }
    gl.uniform1f(this.place("light"), light);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.uniform1i(this.place("flatView"), this.flat);
    gl.uniform2f(this.place("centre"), this.window.u, this.window.v);
    gl.uniform2f(this.place("extent"), ...this.extent());
    const { ahead, right, up } = this.axes();
    gl.uniform3f(this.place("ahead"), ...ahead);
    gl.uniform3f(this.place("right"), ...right);
    gl.uniform3f(this.place("up"), ...up);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Where the window shows a ray, in its pixels; null where it does not. A flat window shows it at the
  // place nearest to its middle.
  project(ray) {
    const [wide, high] = this.extent();
    if (this.flat) {
      const r = unit(ray);
      let u = 0.5 - Math.atan2(r[1], r[0]) / (2 * Math.PI);
      const v = 0.5 - Math.asin(Math.max(-1, Math.min(1, r[2]))) / Math.PI;
      u -= Math.round(u - this.window.u);
      return [(0.5 + (u - this.window.u) / (2 * wide)) * this.width,
        (0.5 + (v - this.window.v) / (2 * high)) * this.height];
    }
    const { ahead, right, up } = this.axes();
    const depth = dot(ray, ahead);
    if (depth < 1e-3 * Math.hypot(...ray)) return null;
    return [(0.5 + dot(ray, right) / depth / (2 * wide)) * this.width,
      (0.5 - dot(ray, up) / depth / (2 * high)) * this.height];
  }

  // Pixels of the window for each radian in its middle.
  pixelsPerRadian() {
    const [wide] = this.extent();
    return this.flat ? this.width / (2 * wide) / (2 * Math.PI) : this.width / (2 * wide);
  }

  // A line may not leap from one border of a flat picture to the other.
  leaps(a, b) {
    return this.flat && Math.abs(a[0] - b[0]) > Math.PI * this.pixelsPerRadian();
  }

  lookAt(ray) {
    const r = unit(ray);
    const [yaw, pitch] = [Math.atan2(r[1], r[0]), Math.asin(r[2])];
    Object.assign(this.eye, { yaw, pitch: Math.max(-POLE, Math.min(POLE, pitch)) });
    Object.assign(this.window, { u: 0.5 - yaw / (2 * Math.PI), v: 0.5 - pitch / Math.PI });
  }

  // In a flat view the window moves by so many pixels, in perspective the eye turns.
  pan(x, y) {
    const perPixel = 1 / this.pixelsPerRadian();
    if (this.flat) {
      this.window.u = (((this.window.u - (x * perPixel) / (2 * Math.PI)) % 1) + 1) % 1;
      this.window.v = Math.max(0, Math.min(1, this.window.v - (y * perPixel) / Math.PI));
    } else {
      this.eye.yaw += x * perPixel;
      this.eye.pitch = Math.max(-POLE, Math.min(POLE, this.eye.pitch + y * perPixel));
    }
  }

  // About a place of the window, in its pixels.
  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const away = [x - this.width / 2, y - this.height / 2];
    const before = 1 / this.pixelsPerRadian();
    if (this.flat) {
      this.window.zoom = Math.max(1, Math.min(MAX_ZOOM, this.window.zoom * factor));
      if (this.window.zoom === 1) this.window.v = 0.5;
    } else {
      const [least, most] = FIELD_DEG.map((degrees) => (degrees * Math.PI) / 180);
      this.eye.field = Math.max(least, Math.min(most, this.eye.field / factor));
    }
    const grown = before * this.pixelsPerRadian() - 1;
    this.pan(-away[0] * grown, -away[1] * grown);
  }

  listen() {
    const pointers = new Map();
    this.surface.addEventListener("pointerdown", (event) => {
      this.surface.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    this.surface.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const now = [event.clientX, event.clientY];
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
      if (other) {
        const apart = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]);
        this.zoom(apart(now) / Math.max(apart(before), 1));
      } else {
        this.pan(now[0] - before[0], now[1] - before[1]);
        this.onPan?.();
      }
      pointers.set(event.pointerId, now);
      this.redraw();
    });
    const end = (event) => pointers.delete(event.pointerId);
    this.surface.addEventListener("pointerup", end);
    this.surface.addEventListener("pointercancel", end);
    this.surface.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0015), event.offsetX, event.offsetY);
      this.redraw();
    }, { passive: false });
  }
}
