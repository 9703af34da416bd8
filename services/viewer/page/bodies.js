// The neighbours' bodies: colours, outlines, and where they are.

import { apply, compose, cross, dot, inversePose, sub, unit, add, scale } from "./maths.js";

const COLOURS = ["#6cc6ff", "#ffb86b", "#8ce99a", "#f783ac", "#b197fc", "#ffe066", "#63e6be", "#ff8787"];
export const STATES = {
  tentative: "#5d6b7e", confirmed: "#5fd38d", measured: "#5fd38d", coasting: "#f2b45a", ambiguous: "#f2b45a",
  lost: "#f2716b" };

// Whether a neighbour was measured in this frame, and is no guess.
export const isSure = ({ state }) => state === "confirmed" || state === "measured";

export const colour = (target) => COLOURS[target % COLOURS.length];

export class Bodies {
  constructor(hello) {
    this.observerFromCamera = hello.observer_from_camera;
    this.cameraFromObserver = inversePose(hello.observer_from_camera);
    this.bodies = hello.bodies.map((body) => ({
      ...body,
      facets: body.facets.map((outline) => {
        const middle = scale(outline.reduce(add), 1 / outline.length);
        const normal = unit(cross(sub(outline[1], outline[0]), sub(outline[2], outline[1])));
        return { outline, middle, normal };
      }),
      radius: Math.max(...body.facets.flat().map((corner) => Math.hypot(...corner))),
    }));
  }

  get(target) {
    return this.bodies[target];
  }

  observerFromMarkers(pose, target) {
    return compose(pose, this.get(target).target_from_markers);
  }

  cameraFromMarkers(pose, target) {
    return compose(this.cameraFromObserver, this.observerFromMarkers(pose, target));
  }

  // Outlines of the facets in the camera frame, those that face the camera first.
  outlines(pose, target) {
    const camera = this.cameraFromMarkers(pose, target);
    return this.get(target).facets.map(({ outline, middle, normal }) => {
      const away = sub(apply(camera, add(middle, normal)), apply(camera, middle));
      return {
        faces: dot(away, apply(camera, middle)) < 0,
        points: outline.map((corner) => apply(camera, corner)),
      };
    });
  }

  markers(pose, target) {
    const camera = this.cameraFromMarkers(pose, target);
    return this.get(target).markers.map(({ id, corners }) => {
      const points = corners.map((corner) => apply(camera, corner));
      // Clockwise from outside: its normal points inwards by the right hand.
      const inwards = cross(sub(points[1], points[0]), sub(points[2], points[1]));
      return { id, points, faces: dot(inwards, points[0]) > 0 };
    });
  }
}

// Points on three rings round an ellipsoid.
export function rings(centre, axes, sigmas, count = 40) {
  return [[0, 1], [0, 2], [1, 2]].map(([i, j]) =>
    Array.from({ length: count + 1 }, (_, k) => {
      const angle = (2 * Math.PI * k) / count;
      return add(centre, add(scale(axes[i], sigmas * Math.cos(angle)), scale(axes[j], sigmas * Math.sin(angle))));
    }));
}
