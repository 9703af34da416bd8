// The view: takes messages, keeps the last ten seconds, draws what is chosen. A recording sends the same messages as
// a running pipeline, for the time that is asked for.

import { Bodies } from "./bodies.js";
import { Explanation } from "./explain.js";
import { History } from "./history.js";
import { Link } from "./link.js";
import { Overlay } from "./overlay.js";
import { Losses, Neighbours, Peers, Stages } from "./panels.js";
import { Playback } from "./playback.js";
import { Space } from "./space.js";
import { Sphere } from "./sphere.js";
import { Timelines, parts } from "./timelines.js";

const $ = (id) => document.getElementById(id);
const LAYER_KEYS = { b: "bodies", r: "regions", m: "markers", t: "tiles", g: "truth" };

const now = () => performance.now() / 1000;
const history = new History();
const layers = { bodies: true, regions: true, markers: true, tiles: false, truth: false };
let hello = null;
let bodies = null;
let swarm = null;
let following = null;
let trouble = "";
let status = { running: true, trouble: "" };
// Of a recording: an overview of all of it, and its newest picture.
let overview = [];
let backdrop = null;
let playback = null;
let isAsked = false;

const redraw = () => {
  if (isAsked) return;
  isAsked = true;
  requestAnimationFrame(draw);
};

const sphere = new Sphere($("sphere-picture"), $("sphere-overlay"), redraw);
sphere.onPan = () => { following = null; };
const overlay = new Overlay(sphere);
const space = new Space($("space-picture"), $("space-overlay"), redraw);
const neighbours = new Neighbours($("neighbours"), follow, why);
const stages = new Stages($("stages"));
const peers = new Peers($("peers"));
const losses = new Losses($("losses"));
const timelines = new Timelines($("timelines"), (at) => {
  if (hello?.recording) return playback.seek(at);
  history.seek(at);
  tellPaused();
  redraw();
}, why);

const link = new Link({
  onTrouble(text) {
    trouble = text;
    if (text && playback) playback.isWaiting = false;
    redraw();
  },
  onText(message) {
    if (message.kind === "hello") begin(message);
    if (message.kind === "frame") history.add(message, message.at_s ?? now());
    if (message.kind === "position") {
      history.choose(message.key);
      playback.take(message);
    }
    if (message.kind === "overview") {
      overview = parts(message, hello.recording.duration_s);
      losses.draw(message.losses);
    }
    if (message.kind === "status") status = message;
    if (message.kind === "stages") stages.draw(message.stages, hello);
    if (message.kind === "swarm") {
      swarm = message;
      peers.draw(swarm);
    }
    redraw();
  },
  async onBinary(head, blob) {
    try {
      const bitmap = await createImageBitmap(blob);
      if (hello?.recording && head.kind === "picture") {
        backdrop?.bitmap.close();
        backdrop = { key: head.key, bitmap };
        return redraw();
      }
      const entry = hello?.recording ? history.byKey.get(head.key) : history.of(head.key, now());
      if (!entry) {
        bitmap.close();
      } else if (head.kind === "picture") {
        entry.blob = blob;
        history.decoded(entry, bitmap);
      } else {
        entry.closeups.set(head.target, { head, bitmap });
      }
      redraw();
    } finally {
      if (head.kind === "picture") link.shown();
    }
  },
});

playback = new Playback(link, $("playback"), () => {
  draw();
  askWhy();
});
const explanation = new Explanation($("explanation"), link);
// The neighbour of which is to be asked why, once the frame is there.
let wondered = null;

function begin(message) {
  hello = message;
  overview = [];
  losses.draw([]);
  backdrop?.bitmap.close();
  backdrop = null;
  if (hello.recording) playback.begin(hello.recording);
  else playback.end();
  bodies = new Bodies(hello);
  swarm = null;
  peers.draw(null);
  history.clear();
  tellPaused();
  neighbours.clear();
  const name = hello.recording?.file ?? hello.instance;
  $("instance").textContent = name;
  document.title = `${name} · Flockeye`;
  document.querySelector("[data-layer=truth]").hidden = !hello.simulated;
  showLayers();
}

// Asks why a neighbour has the pose that is shown, or none. In flight the picture stops there.
function why(target) {
  if (!hello?.recording && !history.paused) pause(true);
  wondered = target;
  askWhy();
}

// Of a recording the frame may be under way.
function askWhy() {
  const body = bodies?.get(wondered);
  const key = history.current?.frame?.key;
  if (!body || !key || playback.isWaiting || playback.next.length) return;
  wondered = null;
  explanation.ask(body.name, key);
}

// Looks at a neighbour, in perspective, and stays with it until the mouse pans.
function follow(target) {
  following = target;
  sphere.flat = false;
  sphere.eye.field = Math.min(sphere.eye.field, 0.7);
  showLayers();
  redraw();
}

function showLayers() {
  for (const button of document.querySelectorAll("[data-layer]")) {
    const layer = button.dataset.layer;
    if (layer === "projection") button.textContent = sphere.flat ? "flat" : "perspective";
    else button.setAttribute("aria-pressed", String(layers[layer]));
  }
}

function toggle(layer) {
  if (layer === "projection") {
    sphere.flat = !sphere.flat;
    following = null;
  } else {
    layers[layer] = !layers[layer];
  }
  showLayers();
  redraw();
}

function pause(wanted = !history.paused) {
  if (hello?.recording) return playback.toggle();
  if (wanted) history.pause();
  else history.resume(now());
  tellPaused();
  redraw();
}

function step(direction, seconds) {
  if (hello?.recording) return seconds ? playback.seek(playback.at + direction * seconds) : playback.step(direction);
  history.step(direction, seconds);
  tellPaused();
  redraw();
}

function tellPaused() {
  link.wantPictures(!history.paused);
}

// Decodes a picture that is looked at again.
async function decode(entry) {
  const bitmap = await createImageBitmap(entry.blob);
  if (history.pictured === entry) history.decoded(entry, bitmap);
  else bitmap.close();
  redraw();
}

// The frame whose findings are drawn over the picture, the picture, and how bright it is.
function chosen() {
  if (hello?.recording) {
    // The nearest picture before it may be under way: until then the last one stays.
    const shown = history.current;
    const bitmap = (playback.picture && backdrop?.bitmap) || null;
    return { shown, bitmap, light: backdrop?.key === shown?.frame.key ? 1 : 0.55 };
  }
  const shown = history.pictured;
  if (shown?.blob && !shown.bitmap) decode(shown);
  return { shown, bitmap: shown?.bitmap, light: 1 };
}

// Of a recording: which frame the picture is of.
function caption(entry) {
  let text = "";
  if (hello?.recording && entry?.frame) {
    if (!hello.recording.pictures) text = "the recording has no pictures: record with --frames 'every 10'";
    else if (!playback.picture) text = "no picture before this frame";
    else if (backdrop && backdrop.key !== entry.frame.key) {
      const sequence = Number(backdrop.key.split(".").at(-1));
      text = `picture of frame ${sequence}, shown with frame ${entry.frame.sequence}`;
    }
  }
  $("caption").hidden = !text;
  $("caption").textContent = text;
}

function draw() {
  isAsked = false;
  // What comes before an answer is whole is not shown.
  if (playback.isWaiting) return;
  const current = history.current;
  const { shown, bitmap, light } = chosen();
  const tracked = shown?.frame?.tracks.find(({ target }) => target === following);
  if (tracked && bodies) sphere.lookAt(bodies.cameraFromMarkers(tracked.pose, tracked.target).p);
  const ratio = sphere.resize();
  sphere.draw(bitmap, light);
  overlay.draw(shown, history, bodies, hello, layers, ratio);
  space.draw(current, history, bodies, swarm, layers);
  neighbours.draw(current, history, bodies);
  if (hello?.recording) timelines.drawAll(overview, hello.recording.duration_s, bodies, playback.at);
  else timelines.draw(history, bodies);
  caption(current);
  facts(current);
}

function facts(entry) {
  const isPaused = Boolean(history.paused);
  const isGone = Boolean(trouble) || !status.running;
  document.body.classList.toggle("paused", isPaused);
  document.body.classList.toggle("gone", isGone && !isPaused);
  $("mode").textContent = isPaused ? `−${(history.newest.at - history.paused.at).toFixed(1)} s` : isGone ? "waiting" : "live";
  const notice = trouble || (status.running ? status.trouble : `the pipeline ${hello ? `'${hello.instance}' ` : ""}does not run`);
  $("notice").hidden = !notice;
  $("notice").textContent = notice;
  if (!entry?.frame) return;
  $("fact-frame").textContent = entry.frame.sequence;
  $("fact-age").textContent = entry.frame.age_ms === null ? "–" : `${entry.frame.age_ms.toFixed(0)} ms`;
  $("fact-skipped").textContent = entry.skipped;
  const last = history.frames.filter(({ at }) => at > entry.at - 2 && at <= entry.at);
  const span = last.length > 1 ? last.at(-1).at - last[0].at : 0;
  $("fact-rate").textContent = span > 0.2 ? ((last.length - 1) / span).toFixed(0) : "–";
}

document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") return explanation.close();
  if (event.ctrlKey || event.metaKey || event.altKey || $("help").open) return;
  const key = event.key.toLowerCase();
  const digit = Number.parseInt(key, 10);
  if (key === " ") pause();
  else if (key === "arrowleft") step(-1, event.shiftKey ? 1 : 0);
  else if (key === "arrowright") step(1, event.shiftKey ? 1 : 0);
  else if (key === "f") toggle("projection");
  else if (LAYER_KEYS[key]) toggle(LAYER_KEYS[key]);
  else if (key === "+" || key === "=") sphere.zoom(1.3);
  else if (key === "-") sphere.zoom(1 / 1.3);
  else if (key === "?") $("help").showModal();
  else if (key === "w") why(following ?? history.current?.frame?.tracks[0]?.target ?? 0);
  else if (key === "0") {
    following = null;
    sphere.reset();
    space.reset();
    showLayers();
  } else if (digit >= 1 && bodies?.get(digit - 1)) follow(digit - 1);
  else return;
  event.preventDefault();
  // A button that was clicked would be pressed by the space bar too.
  document.activeElement?.blur();
  redraw();
});
$("pause").addEventListener("click", () => pause());
$("help-button").addEventListener("click", () => $("help").showModal());
$("help").addEventListener("click", (event) => event.target === $("help") && $("help").close());
for (const button of document.querySelectorAll("[data-layer]")) {
  button.addEventListener("click", () => toggle(button.dataset.layer));
}
new ResizeObserver(redraw).observe(document.querySelector("main"));
showLayers();

// What tests and curious people look at.
globalThis.flockeye = { history, sphere, space, layers, playback, timelines, pause, step, follow, toggle, why, explanation, get backdrop() { return backdrop; },
  get overview() { return overview; }, get bodies() { return bodies; }, get hello() { return hello; } };
