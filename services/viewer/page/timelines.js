// The last ten seconds, or all of a recording: latency of each stage, the tracks' states, frames that were skipped.
// A click looks there; one on a neighbour's row also asks why it has this pose there, or none.

import { colour, STATES } from "./bodies.js";
import { SPAN_S } from "./history.js";
import { fit } from "./shader.js";

const PARTS = [["capture", "#4c6a8a"], ["rectification", "#6cc6ff"], ["detection", "#b197fc"], ["fusion", "#ffb86b"]];
const LEFT = 78, RIGHT = 14, TOP = 32, GAP = 10, ROW = 11;
// A pointer that moves less than this has clicked, pixels.
const CLICK = 4;
// Frames farther apart than this have a hole between them.
const HOLE_S = 0.5;

// A recording's overview as frames, one for each part of it.
export function parts(overview, duration) {
  const count = overview.skipped.length;
  let [skipped, lost] = [0, 0];
  return overview.skipped.map((more, part) => {
    skipped += more;
    lost += overview.lost[part];
    const tracks = overview.states.filter(({ states }) => states[part])
      .map(({ target, states }) => ({ target, state: states[part], latency_ms: [null, null, null, null, null] }));
    if (tracks.length && overview.latency_ms[part]) tracks[0].latency_ms = overview.latency_ms[part];
    return { at: ((part + 0.5) / count) * duration, frame: { tracks }, skipped, lost };
  });
}

export class Timelines {
  constructor(canvas, onSeek, onWhy) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.scaleMs = 50;
    [this.begin, this.end] = [0, 0];
    // The neighbours' rows, and where they are.
    this.rows = [];
    let dragging = false;
    let pressed = null;
    const seek = (event) => {
      const share = (event.offsetX - LEFT) / (canvas.clientWidth - LEFT - RIGHT);
      onSeek(this.begin + (this.end - this.begin) * Math.max(0, Math.min(1, share)));
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      dragging = true;
      pressed = { x: event.offsetX, y: event.offsetY };
      seek(event);
    });
    canvas.addEventListener("pointermove", (event) => dragging && seek(event));
    canvas.addEventListener("pointerup", ({ offsetX, offsetY }) => {
      const isClick = pressed && Math.hypot(offsetX - pressed.x, offsetY - pressed.y) < CLICK;
      const row = this.rows.find(({ top }) => offsetY >= top - 2 && offsetY < top + ROW + 2);
      if (isClick && row && offsetX >= LEFT) onWhy(row.target);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { dragging = false; });
  }

  // The last ten seconds.
  draw(history, bodies) {
    this.end = history.newest?.at ?? 0;
    this.begin = this.end - SPAN_S;
    this.hole = HOLE_S;
    this.show(history.frames, bodies, history.paused?.at);
  }

  // A whole recording, and where it is.
  drawAll(frames, duration, bodies, at) {
    [this.begin, this.end] = [0, duration];
    this.hole = Math.max(HOLE_S, (1.5 * duration) / Math.max(frames.length, 1));
    this.show(frames, bodies, at, true);
  }

  show(frames, bodies, mark, hasLosses = false) {
    const ratio = fit(this.canvas);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const context = this.context;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = "11px system-ui, \"Segoe UI\", \"DejaVu Sans\", sans-serif";
    context.textBaseline = "middle";
    const span = Math.max(this.end - this.begin, 1e-9);
    const x = (at) => LEFT + ((at - this.begin) / span) * (width - LEFT - RIGHT);
    const targets = [...new Set(frames.flatMap(({ frame }) => frame.tracks.map(({ target }) => target)))].sort((a, b) => a - b);
    const counts = hasLosses ? ["skipped", "lost"] : ["skipped"];
    const rows = Math.min(targets.length, 7 - counts.length);
    const bottom = height - 10 - (rows + counts.length) * (ROW + 4);
    this.latencies(frames, x, bottom, width);
    this.rows = targets.slice(0, rows).map((target, row) => ({ target, top: bottom + GAP + row * (ROW + 4) }));
    for (const { target, top } of this.rows) this.states(frames, target, x, top, bodies);
    counts.forEach((count, row) => {
      this.drops(frames, count, x, bottom + GAP + (rows + row) * (ROW + 4), width);
    });
    if (mark !== undefined) {
      const at = Math.round(x(mark)) + 0.5;
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
      if (now !== state || (last !== null && at - last > this.hole)) {
        if (now !== null && state !== null && at - last <= this.hole) last = at;
        close();
        [from, state] = [at, now];
      }
      last = at;
    }
    close();
  }

  drops(frames, count, x, top, width) {
    const context = this.context;
    context.textAlign = "right";
    context.fillStyle = "#8593a6";
    context.fillText(count, LEFT - 12, top + ROW / 2);
    context.fillStyle = "#171f2a";
    context.fillRect(LEFT, top + ROW / 2, width - LEFT - RIGHT, 1);
    for (let k = 1; k < frames.length; k++) {
      const lost = frames[k][count] - frames[k - 1][count];
      if (lost <= 0 || x(frames[k].at) < LEFT) continue;
      const high = Math.min(ROW, 3 + 2 * lost);
      context.fillStyle = "#f2716b";
      context.fillRect(x(frames[k].at) - 1, top + (ROW - high) / 2, 2, high);
    }
  }
}
