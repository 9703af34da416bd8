// The live view: takes messages, keeps the last ten seconds, draws what is chosen.

import { Bodies } from "./bodies.js";
import { History } from "./history.js";
import { Link } from "./link.js";
import { Overlay } from "./overlay.js";
import { Neighbours, Peers, Stages } from "./panels.js";
import { Space } from "./space.js";
import { Sphere } from "./sphere.js";
import { Timelines } from "./timelines.js";

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
const neighbours = new Neighbours($("neighbours"), follow);
const stages = new Stages($("stages"));
const peers = new Peers($("peers"));
const timelines = new Timelines($("timelines"), (at) => {
  history.seek(at);
  tellPaused();
  redraw();
});

const link = new Link({
  onTrouble(text) {
    trouble = text;
    redraw();
  },
  onText(message) {
    if (message.kind === "hello") begin(message);
    if (message.kind === "frame") history.add(message, now());
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
      const entry = history.of(head.key, now());
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

function begin(message) {
  hello = message;
  bodies = new Bodies(hello);
  swarm = null;
  peers.draw(null);
  history.clear();
  tellPaused();
  neighbours.clear();
  $("instance").textContent = hello.instance;
  document.title = `${hello.instance} · Flockeye`;
  document.querySelector("[data-layer=truth]").hidden = !hello.simulated;
  showLayers();
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
  if (wanted) history.pause();
  else history.resume(now());
  tellPaused();
  redraw();
}

function step(direction, seconds) {
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

function draw() {
  isAsked = false;
  const shown = history.pictured;
  if (shown?.blob && !shown.bitmap) decode(shown);
  const current = history.current;
  const tracked = shown?.frame?.tracks.find(({ target }) => target === following);
  if (tracked && bodies) sphere.lookAt(bodies.cameraFromMarkers(tracked.pose, tracked.target).p);
  const ratio = sphere.resize();
  sphere.draw(shown?.bitmap);
  overlay.draw(shown, history, bodies, hello, layers, ratio);
  space.draw(current, history, bodies, swarm, layers);
  neighbours.draw(current, history, bodies);
  timelines.draw(history, bodies);
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
globalThis.flockeye = { history, sphere, space, layers, pause, step, follow, toggle, get bodies() { return bodies; }, get hello() { return hello; } };
