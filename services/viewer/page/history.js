// The last ten seconds: frames with their pictures and close-ups, and which of them is shown.

import { IDENTITY, inverse, multiply } from "./maths.js";

export const SPAN_S = 10;
// A neighbour that is lost, or of which nothing is said, is shown for as long as something is known of it.
export const LOST_S = SPAN_S;
const MOST_FRAMES = 900;
// Pictures that are kept decoded: one takes some 7 MB. The others wait as JPEG.
const MOST_DECODED = 8;

export class History {
  constructor() {
    this.clear();
  }

  clear() {
    for (const entry of this.byKey?.values() ?? []) entry.bitmap?.close();
    this.frames = [];
    this.decodedEntries = [];
    this.byKey = new Map();
    this.paused = null;
    // Of a recording: the frame that the view says.
    this.chosen = null;
    this.stable = IDENTITY;
    this.epoch = "";
    // Frames that never ended: all, and by the view's own count.
    this.skipped = 0;
    this.counted = null;
  }

  add(frame, now) {
    const epoch = frame.key.slice(0, frame.key.lastIndexOf("."));
    // The source has started again, or the whole pipeline has: frames end in order.
    if (epoch !== this.epoch || frame.sequence <= this.newest?.frame.sequence) {
      // What is looked at stays as it is.
      if (this.paused) return;
      this.clear();
      this.epoch = epoch;
    }
    // Axes that do not turn with the camera, as far as its rotation is known.
    if (frame.turn) this.stable = multiply(this.stable, inverse(frame.turn));
    // The view counts anew when it joins anew.
    this.skipped += Math.max(0, frame.skipped - (this.counted ?? frame.skipped));
    this.counted = frame.skipped;
    // No more is kept meanwhile.
    if (this.paused) return;
    const waiting = this.byKey.get(frame.key);
    const entry = Object.assign(waiting ?? { closeups: new Map(), blob: null, bitmap: null }, {
      frame, at: now, stable: this.stable, skipped: this.skipped });
    this.byKey.set(frame.key, entry);
    this.frames.push(entry);
    this.forget(now);
  }

  forget(now) {
    let old = 0;
    while (old < this.frames.length - 1 &&
      (now - this.frames[old].at > SPAN_S || this.frames.length - old > MOST_FRAMES)) old++;
    for (const entry of this.frames.splice(0, old)) {
      entry.bitmap?.close();
      this.byKey.delete(entry.frame.key);
    }
    for (const [key, entry] of this.byKey) {
      if (!entry.frame && now - entry.at > SPAN_S) this.byKey.delete(key);
    }
  }

  // What belongs to a frame, also where its picture comes first; nothing of later ones while it is paused.
  of(key, now) {
    let entry = this.byKey.get(key);
    if (!entry && !this.paused) {
      entry = { closeups: new Map(), blob: null, bitmap: null, at: now };
      this.byKey.set(key, entry);
    }
    return entry;
  }

  // Takes a frame's picture, decoded, and lets go of decoded ones that were taken long ago.
  decoded(entry, bitmap) {
    entry.bitmap?.close();
    entry.bitmap = bitmap;
    this.decodedEntries = [...this.decodedEntries.filter((other) => other !== entry), entry];
    for (const old of this.decodedEntries.splice(0, this.decodedEntries.length - MOST_DECODED)) {
      old.bitmap?.close();
      old.bitmap = null;
    }
  }

  get newest() {
    return this.frames.at(-1);
  }

  // The frame that is shown: the newest, or the one at which it was paused.
  get current() {
    return this.chosen ?? this.paused ?? this.newest;
  }

  // Of a recording: shows this frame.
  choose(key) {
    this.chosen = this.byKey.get(key) ?? null;
  }

  // The newest frame up to the current one that has a picture.
  get pictured() {
    const current = this.current;
    if (!current) return undefined;
    return this.frames.findLast((entry) => entry.at <= current.at && entry.blob) ?? current;
  }

  pause() {
    this.paused = this.pictured ?? null;
  }

  resume(now) {
    this.paused = null;
    this.forget(now);
  }

  // Steps over frames that have a picture, or over all where none has.
  step(direction, seconds = 0) {
    if (!this.paused) this.pause();
    if (!this.paused) return;
    const from = this.paused.at + direction * seconds;
    const shown = this.frames.some((entry) => entry.blob);
    const candidates = this.frames.filter((entry) => entry.blob || !shown);
    const next = direction > 0
      ? candidates.find((entry) => (seconds ? entry.at >= from : entry.at > from)) ?? candidates.at(-1)
      : candidates.findLast((entry) => (seconds ? entry.at <= from : entry.at < from)) ?? candidates[0];
    this.paused = next ?? this.paused;
  }

  seek(at) {
    const candidates = this.frames.filter((entry) => entry.blob);
    const all = candidates.length ? candidates : this.frames;
    this.paused = all.reduce((best, entry) =>
      !best || Math.abs(entry.at - at) < Math.abs(best.at - at) ? entry : best, null);
  }
}
