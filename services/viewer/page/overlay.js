// What was found, drawn over the sphere: tiles, regions of interest, markers, bodies, ellipsoids.

import { colour, isSure, rings } from "./bodies.js";
import { LOST_S } from "./history.js";
import { add, apply, ellipsoid, norm, scale, sub, turn } from "./maths.js";

// Standard deviations that an ellipsoid shows.
export const SIGMAS = 2;

export class Overlay {
  constructor(sphere) {
    this.sphere = sphere;
    this.context = sphere.surface.getContext("2d");
  }

  draw(entry, history, bodies, hello, layers, ratio) {
    const context = this.context;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, this.sphere.width, this.sphere.height);
    if (!entry?.frame || !bodies) return;
    const frame = entry.frame;
    context.lineJoin = "round";
    if (layers.tiles) this.tiles(frame, hello);
    if (layers.regions) {
      for (const { target, view } of frame.regions) {
        this.stroke(this.square(view), { colour: colour(target), alpha: 0.55, dash: [3, 4], close: true });
      }
    }
    if (layers.markers) this.markers(frame);
    if (layers.truth) {
      for (const { target, pose } of frame.truth) this.body(bodies, pose, target, "#ffffff", { alpha: 0.5, dash: [2, 3] });
    }
    if (layers.bodies) {
      for (const track of frame.tracks) this.track(track, bodies);
      this.lost(entry, history, bodies);
    }
  }

  tiles(frame, hello) {
    const searched = new Set(frame.partitions);
    hello.partitions.forEach((view, tile) => {
      const now = searched.has(tile);
      this.stroke(this.square(view, 12), { colour: "#9fb4cc", alpha: now ? 0.75 : 0.16, width: now ? 1.3 : 1, close: true });
    });
    for (const tile of frame.high_resolution) {
      const view = hello.high_resolution[tile];
      if (view) this.stroke(this.square(view, 8), { colour: "#b197fc", alpha: 0.75, close: true });
    }
  }

  // Rays along the sides of a square view.
  square({ q, half }, steps = 8) {
    const corners = [[-half, -half, 1], [half, -half, 1], [half, half, 1], [-half, half, 1]];
    return corners.flatMap((from, k) => {
      const along = sub(corners[(k + 1) % 4], from);
      return Array.from({ length: steps }, (_, step) => turn(q, add(from, scale(along, step / steps))));
    });
  }

  markers(frame) {
    for (const { id, rays } of frame.markers) {
      const at = this.stroke(this.finer(rays, 2), {
        colour: "#4de3e3", alpha: 0.95, close: true });
      if (!at) continue;
      const side = Math.hypot(at[0][0] - at[2][0], at[0][1] - at[2][1]);
      if (side > 22) {
        const middle = this.sphere.project(rays.reduce(add));
        if (middle) this.label(String(id), middle, { colour: "#4de3e3", centred: true, size: 10 });
      }
    }
  }

  finer(points, steps) {
    return points.flatMap((from, k) => {
      const along = sub(points[(k + 1) % points.length], from);
      return Array.from({ length: steps }, (_, step) => add(from, scale(along, step / steps)));
    });
  }

  track(track, bodies) {
    if (!bodies.get(track.target) || track.state === "lost") return;
    const sure = isSure(track);
    const alpha = sure ? 1 : ["coasting", "ambiguous"].includes(track.state) ? 0.8 : 0.5;
    const dash = sure ? [] : [5, 4];
    for (const pose of [track.pose, track.rival]) {
      if (pose) this.body(bodies, pose, track.target, colour(track.target), { alpha, dash });
    }
    const camera = bodies.cameraFromMarkers(track.pose, track.target);
    if (!sure) this.cloud(track, bodies, 0.7);
    const range = norm(track.pose.p);
    const angle = Math.asin(Math.min(bodies.get(track.target).radius / range, 1));
    const middle = this.sphere.project(camera.p);
    if (!middle) return;
    const below = [middle[0], middle[1] + angle * this.sphere.pixelsPerRadian() + 15];
    const state = sure ? "" : ` · ${track.state}`;
    this.label(`${track.name}  ${range.toFixed(2)} m${state}`, below, { colour: colour(track.target), centred: true, alpha });
  }

  // Those that were lost a while ago and have not been found again, or of which nothing is said.
  lost(entry, history, bodies) {
    const seen = new Set(entry.frame.tracks.filter(({ state }) => state !== "lost").map(({ target }) => target));
    for (const earlier of history.frames.toReversed()) {
      if (earlier.at > entry.at) continue;
      const age = entry.at - earlier.at;
      if (age > LOST_S) break;
      for (const track of earlier.frame.tracks) {
        if (seen.has(track.target)) continue;
        seen.add(track.target);
        if (!bodies.get(track.target)) continue;
        this.cloud(track, bodies, 0.9 * (1 - age / LOST_S) + 0.1);
        const middle = this.sphere.project(bodies.cameraFromMarkers(track.pose, track.target).p);
        if (middle) {
          // Where fusion gives a frame up, nothing is said of a neighbour, and it is not lost.
          const isLost = track.state === "lost";
          this.label(`${track.name} · ${isLost ? "lost" : "last seen"} ${age.toFixed(1)} s ago`,
            [middle[0], middle[1] + 20], { colour: isLost ? "#f2716b" : "#f2b45a", centred: true });
        }
      }
    }
  }

  cloud(track, bodies, alpha) {
    const centre = apply(bodies.cameraFromObserver, track.pose.p);
    const axes = ellipsoid(track.covariance).map((axis) => turn(bodies.cameraFromObserver.q, axis));
    for (const ring of rings(centre, axes, SIGMAS)) {
      this.stroke(ring, { colour: track.state === "lost" ? "#f2716b" : colour(track.target), alpha: 0.6 * alpha });
    }
  }

  body(bodies, pose, target, stroke, style) {
    for (const { points, faces } of bodies.outlines(pose, target)) {
      if (faces) this.stroke(this.finer(points, 3), { colour: stroke, width: 1.6, close: true, ...style });
    }
  }

  // Draws a line through points of the camera frame; returns where the window shows them, if it shows all.
  stroke(points, { colour, alpha = 1, width = 1.2, dash = [], close = false }) {
    const context = this.context;
    const places = points.map((point) => this.sphere.project(point));
    if (close) places.push(places[0]);
    context.beginPath();
    let before = null;
    for (const place of places) {
      if (place && before && !this.sphere.leaps(before, place)) context.lineTo(...place);
      else if (place) context.moveTo(...place);
      before = place;
    }
    context.globalAlpha = alpha;
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.setLineDash(dash);
    context.stroke();
    context.globalAlpha = 1;
    return places.every(Boolean) ? places : null;
  }

  label(text, [x, y], { colour, centred = false, size = 12, alpha = 1 }) {
    const context = this.context;
    context.font = `600 ${size}px system-ui, "Segoe UI", "DejaVu Sans", sans-serif`;
    context.textAlign = centred ? "center" : "left";
    context.textBaseline = "middle";
    context.setLineDash([]);
    context.globalAlpha = alpha;
    context.lineWidth = 3;
    context.strokeStyle = "rgb(6 8 12 / 85%)";
    context.strokeText(text, x, y);
    context.fillStyle = colour;
    context.fillText(text, x, y);
    context.globalAlpha = 1;
  }
}
