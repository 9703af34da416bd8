// The neighbours closely, the stages, the peers: plain elements of the page.

import { colour } from "./bodies.js";
import { norm, sub } from "./maths.js";

const PANELS = ["picture", "model", "residual"];

function element(name, className = "", text = "") {
  const made = document.createElement(name);
  if (className) made.className = className;
  if (text) made.textContent = text;
  return made;
}

function set(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

const millimetres = (metres) => (metres < 0.01 ? (metres * 1e3).toFixed(1) : (metres * 1e3).toFixed(0));

export class Neighbours {
  // `onWhy`: somebody asks why a neighbour has this pose.
  constructor(root, onChoose, onWhy) {
    Object.assign(this, { root, onChoose, onWhy });
    this.cards = new Map();
    this.empty = element("p", "empty", "No neighbour is tracked.");
    root.append(this.empty);
  }

  clear() {
    for (const { root } of this.cards.values()) root.remove();
    this.cards.clear();
    this.empty.hidden = false;
  }

  draw(entry, history, bodies) {
    if (!entry?.frame || !bodies) return;
    const shown = new Set();
    for (const track of entry.frame.tracks) {
      if (!bodies.get(track.target)) continue;
      shown.add(track.target);
      this.card(track.target).draw(track, entry, history);
    }
    for (const [target, card] of this.cards) {
      if (shown.has(target)) continue;
      // It stays until what is kept of it is gone.
      const last = history.frames.findLast(({ at, frame }) => at <= entry.at &&
        frame.tracks.some((track) => track.target === target));
      const state = last?.frame.tracks.find((track) => track.target === target)?.state;
      if (last) card.gone(entry.at - last.at, state === "lost");
      else {
        card.root.remove();
        this.cards.delete(target);
      }
    }
    this.empty.hidden = this.cards.size > 0;
  }

  card(target) {
    let card = this.cards.get(target);
    if (!card) {
      card = new Card(target, () => this.onChoose(target), () => this.onWhy(target));
      this.cards.set(target, card);
      const after = [...this.cards].filter(([other]) => other > target).sort(([a], [b]) => a - b)[0];
      this.root.insertBefore(card.root, after ? after[1].root : null);
    }
    return card;
  }
}

class Card {
  constructor(target, onChoose, onWhy) {
    this.target = target;
    this.root = element("article", "neighbour");
    const head = element("h3");
    const dot = element("span", "dot");
    dot.style.background = colour(target);
    this.name = element("span");
    this.state = element("span", "state");
    this.range = element("span", "range");
    const why = element("button", "", "why?");
    why.type = "button";
    why.title = "Why it has this pose, or none (W)";
    why.addEventListener("click", (event) => {
      event.stopPropagation();
      why.blur();
      onWhy();
    });
    head.append(dot, this.name, this.state, this.range, why);
    head.addEventListener("click", onChoose);
    head.title = "Look at it";
    this.panels = element("div", "panels");
    this.canvases = PANELS.map((name) => {
      const figure = element("figure");
      const canvas = element("canvas");
      figure.append(canvas, element("figcaption", "", name));
      this.panels.append(figure);
      return canvas;
    });
    this.panels.hidden = true;
    this.facts = element("p");
    this.fields = Object.fromEntries(["sigma", "speed", "by", "score", "latency", "error"].map((name) => {
      const field = element("span");
      const value = element("b");
      field.append(value, document.createTextNode(""));
      this.facts.append(field);
      return [name, { field, value, unit: field.lastChild }];
    }));
    this.root.append(head, this.panels, this.facts);
  }

  fact(name, value, unit) {
    const { field, value: node, unit: text } = this.fields[name];
    field.hidden = value === null;
    if (value === null) return;
    set(node, value);
    if (text.data !== ` ${unit}`) text.data = ` ${unit}`;
  }

  draw(track, entry, history) {
    set(this.name, track.name);
    set(this.state, track.state === "coasting" || track.state === "lost"
      ? `${track.state} for ${track.unseen_s.toFixed(1)} s` : track.state);
    this.state.className = `state ${{ confirmed: "good", measured: "good", coasting: "warn", ambiguous: "warn", lost: "bad" }[track.state] ?? ""}`;
    set(this.range, `${norm(track.pose.p).toFixed(2)} m`);
    const [xx, , , yy, , zz] = track.covariance;
    this.fact("sigma", `±${millimetres(Math.sqrt(Math.max(xx + yy + zz, 0)))}`, `mm, ${track.attitude_deg.toFixed(1)}°`);
    this.fact("speed", norm(track.velocity).toFixed(2), "m/s");
    this.fact("by", track.by === "nothing" ? "predicted" : track.by, track.markers ? `${track.markers} markers` : "");
    const total = track.latency_ms[4];
    this.fact("latency", total === null ? null : total.toFixed(0), "ms");
    const truth = entry.frame.truth.find(({ target }) => target === track.target);
    this.fact("error", truth ? millimetres(norm(sub(truth.pose.p, track.pose.p))) : null, "mm off the truth");
    // Close-ups come in turn: the newest up to this frame.
    const from = history.frames.findLast(({ at, closeups }) =>
      at <= entry.at && entry.at - at < 2 && closeups.get(track.target)?.bitmap);
    const closeup = from?.closeups.get(track.target);
    this.panels.hidden = !closeup;
    this.fact("score", closeup?.head.score ? closeup.head.score.correlation.toFixed(2) : null,
      closeup?.head.score ? `correlation, log odds ${closeup.head.score.log_odds.toFixed(0)}, ${closeup.head.score.facets} facets` : "");
    if (closeup && closeup !== this.shown) this.show(closeup);
  }

  show(closeup) {
    this.shown = closeup;
    const { head, bitmap } = closeup;
    const [width, height] = head.size;
    this.canvases.forEach((canvas, panel) => {
      canvas.parentElement.hidden = panel >= head.panels;
      if (panel >= head.panels) return;
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      canvas.getContext("2d").drawImage(bitmap, panel * width, 0, width, height, 0, 0, width, height);
    });
  }

  gone(seconds, isLost) {
    set(this.state, `${isLost ? "lost" : "last seen"} ${seconds.toFixed(1)} s ago`);
    this.state.className = `state ${isLost ? "bad" : "warn"}`;
    // A frame or two that were given up are not worth a change of all else.
    if (!isLost && seconds < 0.5) return;
    this.panels.hidden = true;
    for (const name of Object.keys(this.fields)) this.fact(name, null, "");
  }
}

export class Stages {
  constructor(root) {
    this.root = root;
    this.rows = new Map();
  }

  draw(stages, hello) {
    const many = new Set(stages.filter(({ replica }) => replica > 0).map(({ stage }) => stage));
    const order = hello?.stages ?? [];
    const sorted = stages.toSorted((a, b) =>
      order.indexOf(a.stage) - order.indexOf(b.stage) || a.replica - b.replica);
    const keys = sorted.map(({ stage, replica }) => `${stage} ${replica}`);
    for (const [key, row] of this.rows) {
      if (keys.includes(key)) continue;
      row.remove();
      this.rows.delete(key);
    }
    sorted.forEach((stage, place) => {
      let row = this.rows.get(keys[place]);
      if (!row) {
        row = element("tr");
        row.append(...Array.from({ length: 6 }, () => element("td")));
        this.rows.set(keys[place], row);
      }
      if (this.root.children[place] !== row) this.root.insertBefore(row, this.root.children[place] ?? null);
      row.className = stage.state;
      row.title = [stage.state, stage.detail, `${stage.resident_mb.toFixed(0)} MB`,
        stage.generation ? `replaced ${stage.generation} times` : ""].filter(Boolean).join(" · ");
      const lost = stage.dropped + stage.failed;
      const cells = [
        many.has(stage.stage) ? `${stage.stage} ${stage.replica}` : stage.stage,
        stage.published_per_s.toFixed(0),
        stage.latency_ms ? stage.latency_ms[0].toFixed(1) : "–",
        stage.latency_ms ? stage.latency_ms[1].toFixed(1) : "–",
        `${(stage.processor * 100).toFixed(0)} %`,
        lost ? String(lost) : "–",
      ];
      cells.forEach((text, k) => set(row.children[k], text));
    });
  }
}

// A list of names with what is said of them.
class Lines {
  constructor(root) {
    this.root = root;
  }

  show(lines) {
    while (this.root.children.length > lines.length) this.root.lastChild.remove();
    lines.forEach(([name, rest], place) => {
      let item = this.root.children[place];
      if (!item) {
        item = element("li");
        item.append(element("b"), document.createTextNode(""));
        this.root.append(item);
      }
      set(item.firstChild, name);
      item.lastChild.data = rest;
    });
  }
}

// What a recording lacks.
export class Losses extends Lines {
  draw(losses) {
    this.show(losses.map(({ topic, recorded, lost }) => [topic, ` ${recorded} recorded · ${lost} missing`]));
  }
}

export class Peers extends Lines {
  draw(swarm) {
    this.show(swarm ? [
      ...swarm.drones.map(({ name, pose, way, through, age_s: age }) =>
        [name, ` ${norm(pose.p).toFixed(2)} m · ${way}${through ? ` through ${through}` : ""} · ${age.toFixed(1)} s old`]),
      ...swarm.sightings.map(({ observer, target, range_m: range, state }) =>
        [observer, ` sees ${target} at ${range.toFixed(2)} m · ${state}`]),
    ] : []);
  }
}
