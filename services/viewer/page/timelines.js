// The last ten seconds: latency of each stage, the tracks' states, dropped frames. A click looks back.

import { colour, STATES } from "./bodies.js";
import { SPAN_S } from "./history.js";

const PARTS = [["capture", "#4c6a8a"], ["rectification", "#6cc6ff"], ["detection", "#b197fc"], ["fusion", "#ffb86b"]];
const LEFT = 78, RIGHT = 14, TOP = 32, GAP = 10, ROW = 11;
// Frames farther apart than this have a hole between them.
const HOLE_S = 0.5;

export class Timelines {
  constructor(canvas, onSeek) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.scaleMs = 50;
    let dragging = false;
    const seek = (event) => {
      const at = (event.offsetX - LEFT) / (canvas.clientWidth - LEFT - RIGHT);
      onSeek(this.end - SPAN_S * (1 - Math.max(0, Math.min(1, at))));
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      dragging = true;
      seek(event);
    });
    canvas.addEventListener("pointermove", (event) => dragging && seek(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { dragging = false; });
  }

  draw(history, bodies) {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const sides = [width, height].map((side) => Math.max(1, Math.round(side * ratio)));
    if (this.canvas.width !== sides[0] || this.canvas.height !== sides[1]) [this.canvas.width, this.canvas.height] = sides;
    const context = this.context;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = "11px system-ui, \"Segoe UI\", \"DejaVu Sans\", sans-serif";
    context.textBaseline = "middle";
    this.end = history.newest?.at ?? 0;
    const x = (at) => LEFT + (1 - (this.end - at) / SPAN_S) * (width - LEFT - RIGHT);
    const frames = history.frames;
    const targets = [...new Set(frames.flatMap(({ frame }) => frame.tracks.map(({ target }) => target)))].sort((a, b) => a - b);
    const rows = Math.min(targets.length, 6);
    const bottom = height - 10 - (rows + 1) * (ROW + 4);
    this.latencies(frames, x, bottom, width);
    targets.slice(0, rows).forEach((target, row) => {
      this.states(frames, target, x, bottom + GAP + row * (ROW + 4), bodies);
    });
    this.drops(frames, x, bottom + GAP + rows * (ROW + 4), width);
    if (history.paused) {
      const at = Math.round(x(history.paused.at)) + 0.5;
      context.strokeStyle = "#f2b45a";
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(at, TOP - 6);
      context.lineTo(at, height - 6);
      context.stroke();
    }
  }

  latencies(frames, x, bottom, width) {
    const context = this.context;
    // The slowest neighbour of a frame is what a pilot waits for.
    const slowest = frames.map((entry) => {
      const known = entry.frame.tracks.filter(({ latency_ms: all }) => all[4] !== null);
      return { at: entry.at, parts: known.sort((a, b) => b.latency_ms[4] - a.latency_ms[4])[0]?.latency_ms };
    });
    // A few that took very long do not flatten all others: they are cut off, with a red end.
    const totals = slowest.map(({ parts }) => parts?.[4] ?? 0).sort((a, b) => a - b);
    const most = 1.3 * (totals[Math.floor(0.97 * (totals.length - 1))] ?? 0);
    const wanted = [20, 50, 100, 200, 500, 1000, 2000, 5000].find((ms) => ms >= most) ?? 10000;
    this.scaleMs += 0.25 * (wanted - this.scaleMs);
    const y = (ms) => bottom - (Math.min(ms, this.scaleMs) / this.scaleMs) * (bottom - TOP);
    context.textAlign = "right";
    context.fillStyle = "#8593a6";
    context.fillText("latency", LEFT - 12, TOP - 18);
    for (const ms of [0, wanted / 2, wanted]) {
      context.fillStyle = "#5d6b7e";
      context.fillText(`${ms} ms`, LEFT - 12, y(ms));
      context.fillStyle = "#1b2430";
      context.fillRect(LEFT, Math.round(y(ms)), width - LEFT - RIGHT, 1);
    }
    const clipped = slowest.filter(({ at }) => x(at) >= LEFT);
    const each = Math.max(1, (width - LEFT - RIGHT) / Math.max(frames.length, 100) - 0.4);
    for (const { at, parts } of clipped) {
      if (!parts) continue;
      let from = 0;
      PARTS.forEach(([, tint], part) => {
        const ms = Math.max(parts[part] ?? 0, 0);
        context.fillStyle = tint;
        context.fillRect(x(at) - each / 2, y(from + ms), each, y(from) - y(from + ms));
        from += ms;
      });
      if (from > wanted) {
        context.fillStyle = "#f2716b";
        context.fillRect(x(at) - each / 2, TOP - 2, each, 3);
      }
    }
    context.textAlign = "left";
    let place = LEFT;
    for (const [name, tint] of PARTS) {
      context.fillStyle = tint;
      context.fillRect(place, TOP - 22, 8, 8);
      context.fillStyle = "#8593a6";
      context.fillText(name, place + 13, TOP - 18);
      place += context.measureText(name).width + 30;
    }
  }

  states(frames, target, x, top, bodies) {
    const context = this.context;
    context.textAlign = "right";
    context.fillStyle = colour(target);
    context.fillText(bodies?.get(target)?.name ?? String(target), LEFT - 12, top + ROW / 2);
    let from = null;
    let state = null;
    let last = null;
    const close = () => {
      if (state === null) return;
      context.fillStyle = STATES[state] ?? "#5d6b7e";
      const left = Math.max(LEFT, x(from));
      if (x(last) >= LEFT) context.fillRect(left, top, Math.max(2, x(last) - left + 1.5), ROW);
    };
    for (const { at, frame } of frames) {
      const now = frame.tracks.find((track) => track.target === target)?.state ?? null;
      if (now !== state || (last !== null && at - last > HOLE_S)) {
        if (now !== null && state !== null && at - last <= HOLE_S) last = at;
        close();
        [from, state] = [at, now];
      }
      last = at;
    }
    close();
  }

  drops(frames, x, top, width) {
    const context = this.context;
    context.textAlign = "right";
    context.fillStyle = "#8593a6";
    context.fillText("skipped", LEFT - 12, top + ROW / 2);
    context.fillStyle = "#171f2a";
    context.fillRect(LEFT, top + ROW / 2, width - LEFT - RIGHT, 1);
    for (let k = 1; k < frames.length; k++) {
      const lost = frames[k].skipped - frames[k - 1].skipped;
      if (lost <= 0 || x(frames[k].at) < LEFT) continue;
      const high = Math.min(ROW, 3 + 2 * lost);
      context.fillStyle = "#f2716b";
      context.fillRect(x(frames[k].at) - 1, top + (ROW - high) / 2, 2, high);
    }
  }
}
