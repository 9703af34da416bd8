// The neighbours in space, in this drone's frame: x ahead, y left, z up. Bodies, ellipsoids of two standard
// deviations, trails. The mouse orbits.

import { colour, isSure, rings } from "./bodies.js";
import { SPAN_S } from "./history.js";
import { SIGMAS } from "./overlay.js";
import { add, apply, ellipsoid, inverse, lookAt, multiply, norm, perspective, scale, sub, times, turn, unit } from "./maths.js";
import { fit, link } from "./shader.js";

const VERTEX = `
attribute vec3 place;
attribute vec4 tint;
uniform mat4 camera;
varying vec4 colour;
void main() { gl_Position = camera * vec4(place, 1.0); colour = tint; }`;
const FRAGMENT = `
precision mediump float;
varying vec4 colour;
void main() { gl_FragColor = vec4(colour.rgb * colour.a, colour.a); }`;

const FIELD = 0.9;
const LIGHT = unit([0.4, 0.5, 0.9]);
const REACH_M = [0.4, 60];

const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);

export class Space {
  constructor(canvas, surface, redraw) {
    Object.assign(this, { canvas, surface, redraw });
    this.context = surface.getContext("2d");
    this.reset();
    this.start();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.start();
      redraw();
    });
    this.listen();
  }

  reset() {
    // From behind and above, as a pilot looks at a drone.
    this.orbit = { yaw: Math.PI, pitch: 0.6, distance: null };
    this.distance = 3;
    this.centre = [0, 0, 0];
  }

  start() {
    const gl = this.canvas.getContext("webgl", { antialias: true, alpha: true });
    this.gl = gl;
    if (!gl) return;
    const program = link(gl, VERTEX, FRAGMENT);
    this.cameraPlace = gl.getUniformLocation(program, "camera");
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const [place, tint] = ["place", "tint"].map((name) => gl.getAttribLocation(program, name));
    gl.enableVertexAttribArray(place);
    gl.enableVertexAttribArray(tint);
    gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 28, 0);
    gl.vertexAttribPointer(tint, 4, gl.FLOAT, false, 28, 12);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  draw(entry, history, bodies, swarm, layers) {
    const gl = this.gl;
    const ratio = fit(this.canvas, this.surface);
    const { clientWidth: width, clientHeight: height } = this.surface;
    if (!gl || gl.isContextLost()) return;
    this.fit(entry);
    const { yaw, pitch } = this.orbit;
    const eye = scale([Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)], this.distance);
    const camera = times(perspective(FIELD, width / Math.max(height, 1), this.distance / 100, this.distance * 30),
      lookAt(add(eye, this.centre), this.centre, [0, 0, 1]));
    const solid = [], lines = [], clouds = [], labels = [];
    this.ground(lines, labels);
    this.drone(lines);
    if (entry?.frame && bodies) this.neighbours(entry, history, bodies, layers, { solid, lines, clouds, labels });
    if (entry?.frame && swarm) this.swarm(entry, swarm, { lines, clouds, labels });
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.cameraPlace, false, new Float32Array(camera));
    gl.depthMask(true);
    this.send(gl.TRIANGLES, solid);
    this.send(gl.LINES, lines);
    gl.depthMask(false);
    this.send(gl.LINES, clouds);
    this.write(labels, camera, width, height, ratio);
  }

  send(mode, vertices) {
    if (!vertices.length) return;
    this.gl.bufferData(this.gl.ARRAY_BUFFER, new Float32Array(vertices), this.gl.STREAM_DRAW);
    this.gl.drawArrays(mode, 0, vertices.length / 7);
  }

  // Everybody is in sight, unless the wheel chose a distance.
  fit(entry) {
    const farthest = Math.max(0.7, ...(entry?.frame?.tracks ?? []).map(({ pose }) => norm(pose.p)));
    const wanted = this.orbit.distance ?? Math.min(Math.max(2.7 * farthest, REACH_M[0]), REACH_M[1]);
    this.distance += 0.12 * (wanted - this.distance);
    // It gets there, also where nothing else changes.
    if (Math.abs(wanted - this.distance) > 0.01 * wanted) this.redraw();
    // Between this drone and its neighbours.
    const tracks = entry?.frame?.tracks ?? [];
    const middle = tracks.length ? scale(tracks.map(({ pose }) => pose.p).reduce(add), 0.4 / tracks.length) : [0, 0, 0];
    this.centre = add(this.centre, scale(sub(middle, this.centre), 0.08));
  }

  ground(lines, labels) {
    const step = [0.25, 0.5, 1, 2, 5, 10, 20].find((metres) => metres * 3 > this.distance / 2.2) ?? 20;
    for (let k = 1; k <= 4; k++) {
      const radius = k * step;
      const ring = Array.from({ length: 73 }, (_, n) => {
        const angle = (n * Math.PI) / 36;
        return [radius * Math.cos(angle), radius * Math.sin(angle), 0];
      });
      this.path(lines, ring, "#7f93ad", 0.34 - 0.06 * k);
      labels.push({ text: `${radius} m`, at: [0, -radius, 0], colour: "#5d6b7e", size: 10 });
    }
    for (let k = 0; k < 4; k++) {
      const [x, y] = [Math.cos((k * Math.PI) / 2), Math.sin((k * Math.PI) / 2)];
      this.path(lines, [[0, 0, 0], [4 * step * x, 4 * step * y, 0]], "#7f93ad", 0.12);
    }
  }

  drone(lines) {
    const size = this.distance / 22;
    for (const [axis, tint] of [[[1, 0, 0], "#f2716b"], [[0, 1, 0], "#5fd38d"], [[0, 0, 1], "#6c9cff"]]) {
      this.path(lines, [[0, 0, 0], scale(axis, size * 1.8)], tint, 1);
    }
    for (const ring of rings([0, 0, 0], [[size, 0, 0], [0, size, 0], [0, 0, size]], 0.5, 24)) {
      this.path(lines, ring, "#d5dde8", 0.7);
    }
  }

  neighbours(entry, history, bodies, layers, into) {
    for (const track of entry.frame.tracks) {
      const body = bodies.get(track.target);
      if (!body) continue;
      const tint = track.state === "lost" ? "#f2716b" : colour(track.target);
      if (track.state !== "lost") {
        const pose = bodies.observerFromMarkers(track.pose, track.target);
        for (const { outline, normal } of body.facets) {
          const corners = outline.map((corner) => apply(pose, corner));
          const facing = turn(pose.q, normal);
          const shade = 0.45 + 0.5 * Math.max(0, facing[0] * LIGHT[0] + facing[1] * LIGHT[1] + facing[2] * LIGHT[2]);
          for (let k = 2; k < corners.length; k++) {
            for (const corner of [corners[0], corners[k - 1], corners[k]]) {
              into.solid.push(...corner, ...rgb(tint).map((part) => part * shade), isSure(track) ? 1 : 0.5);
            }
          }
          this.path(into.lines, [...corners, corners[0]], "#0d1117", 0.9);
        }
      }
      // From the ground up, so that its height can be read.
      const [x, y] = track.pose.p;
      this.path(into.lines, [[x, y, 0], track.pose.p], tint, 0.35);
      for (const ring of rings(track.pose.p, ellipsoid(track.covariance), SIGMAS)) this.path(into.clouds, ring, tint, 0.75);
      this.trail(track.target, entry, history, bodies, into.lines, tint);
      into.labels.push({ text: track.name, at: add(track.pose.p, [0, 0, 1.7 * body.radius]), colour: tint, size: 12 });
    }
    for (const { target, pose } of layers.truth ? entry.frame.truth : []) {
      const body = bodies.get(target);
      if (!body) continue;
      const there = bodies.observerFromMarkers(pose, target);
      for (const { outline } of body.facets) {
        const corners = outline.map((corner) => apply(there, corner));
        this.path(into.lines, [...corners, corners[0]], "#ffffff", 0.25);
      }
    }
  }

  // Where a neighbour was, in axes that do not turn with this drone.
  trail(target, entry, history, bodies, lines, tint) {
    let before = null;
    for (const earlier of history.frames) {
      if (earlier.at > entry.at) break;
      const track = earlier.frame.tracks.find((track) => track.target === target && track.state !== "lost");
      if (!track) {
        before = null;
        continue;
      }
      const turned = multiply(inverse(entry.stable), earlier.stable);
      const inCamera = turn(turned, apply(bodies.cameraFromObserver, track.pose.p));
      const at = apply(bodies.observerFromCamera, inCamera);
      const fresh = 1 - (entry.at - earlier.at) / SPAN_S;
      if (before) this.path(lines, [before, at], tint, 0.1 + 0.7 * fresh);
      before = at;
    }
  }

  // Drones that this one does not see itself.
  swarm(entry, swarm, { lines, clouds, labels }) {
    const seen = new Set(entry.frame.tracks.map(({ name }) => name));
    for (const drone of swarm.drones) {
      if (seen.has(drone.name)) continue;
      const size = this.distance / 40;
      const axes = [0, 1, 2].map((k) => turn(drone.pose.q, [0, 1, 2].map((n) => (n === k ? size : 0))));
      for (const ring of rings(drone.pose.p, axes, 1, 4)) this.path(lines, ring, "#b197fc", 0.9);
      for (const ring of rings(drone.pose.p, ellipsoid(drone.covariance), SIGMAS)) this.path(clouds, ring, "#b197fc", 0.5);
      labels.push({ text: `${drone.name} · ${drone.way}`, at: add(drone.pose.p, [0, 0, 2 * size]), colour: "#b197fc", size: 11 });
    }
  }

  path(into, points, tint, alpha) {
    const [r, g, b] = rgb(tint);
    for (let k = 1; k < points.length; k++) into.push(...points[k - 1], r, g, b, alpha, ...points[k], r, g, b, alpha);
  }

  write(labels, camera, width, height, ratio) {
    const context = this.context;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (const { text, at, colour, size } of labels) {
      const [x, y, , w] = [0, 1, 2, 3].map((row) =>
        camera[row] * at[0] + camera[4 + row] * at[1] + camera[8 + row] * at[2] + camera[12 + row]);
      if (w <= 0) continue;
      context.font = `600 ${size}px system-ui, "Segoe UI", "DejaVu Sans", sans-serif`;
      context.fillStyle = colour;
      context.fillText(text, ((x / w + 1) / 2) * width, ((1 - y / w) / 2) * height);
    }
  }

  listen() {
    let before = null;
    this.surface.addEventListener("pointerdown", (event) => {
      this.surface.setPointerCapture(event.pointerId);
      before = [event.clientX, event.clientY];
    });
    this.surface.addEventListener("pointermove", (event) => {
      if (!before) return;
      this.orbit.yaw -= (event.clientX - before[0]) * 0.008;
      this.orbit.pitch = Math.max(-1.5, Math.min(1.5, this.orbit.pitch + (event.clientY - before[1]) * 0.008));
      before = [event.clientX, event.clientY];
      this.redraw();
    });
    const end = () => { before = null; };
    this.surface.addEventListener("pointerup", end);
    this.surface.addEventListener("pointercancel", end);
    this.surface.addEventListener("wheel", (event) => {
      event.preventDefault();
      const wanted = this.distance * Math.exp(event.deltaY * 0.0012);
      this.orbit.distance = Math.min(Math.max(wanted, REACH_M[0]), REACH_M[1]);
      this.redraw();
    }, { passive: false });
  }
}
