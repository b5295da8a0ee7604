// The viewer with its controls: loads a model's files, shows them, says plainly when it can't.

import { jobImages } from "../api.js";
import { h, fill } from "../dom.js";
import { bytes, count, plural } from "../format.js";
import { parsePly } from "./ply.js";
import { Stage } from "./stage.js";

/** One press of an arrow key, radians. */
const KEY_TURN = Math.PI / 24;
/** Vertices of a frustum in cameras.ply: the centre and four corners. */
const FRUSTUM_VERTICES = 5;
/** Point sizes to start with, in pixels: sparse clouds need larger points to be read as surfaces. */
const startSize = (points) => (points < 100_000 ? 3 : points < 1_000_000 ? 2 : 1.5);
/** A press that moves farther than this many pixels turns the model and chooses nothing. */
const CLICK_PX = 4;

export function modelViewer(job) {
  const canvas = h("canvas", { tabindex: 0, role: "img", "aria-label": "The model", "aria-describedby": "viewer-help" });
  const message = h("div", {}, "Loading ...");
  const overlay = h("div", { class: "overlay" }, message);
  const label = h("div", { class: "label", role: "status", hidden: true });
  const frame = h("div", { class: "viewer" }, canvas, overlay, label);
  const cameras = h("input", { type: "checkbox", id: "show-cameras", checked: true });
  const size = h("input", { type: "range", id: "point-size", min: 1, max: 8, step: 0.5, value: 2 });
  const up = h("select", { id: "up-axis" }, [["z", "Z"], ["-z", "\u2212Z"], ["y", "Y"], ["-y", "\u2212Y"], ["x", "X"], ["-x", "\u2212X"]].map(([value, label]) => h("option", { value }, label)));
  const choice = h("select", { id: "which-model" }, job.models.map((model) => h("option", { value: model.id }, `${model.id + 1}: ${plural(model.images, "picture")}, ${plural(model.points, "point")}`)));
  const help = h("p", { class: "muted small", id: "viewer-help" }, "Drag to turn, right-drag or two fingers to move, wheel or pinch to zoom. Click a camera to see its picture. Keys: arrows turn, + and \u2212 zoom, F fits, C shows or hides the cameras.");
  const element = h("section", { class: "card", "aria-labelledby": "model-title" },
    h("div", { class: "section-head" }, h("h2", { id: "model-title" }, "Model"),
      job.models.length > 1 && h("label", { class: "row push" }, "Show", choice)),
    frame,
    h("div", { class: "viewer-controls" },
      h("label", {}, "Point size", size),
      h("label", {}, cameras, "Cameras"),
      h("label", {}, "Up", up),
      h("button", { type: "button", class: "slim", onclick: () => { up.value = up.value.startsWith("-") ? up.value.slice(1) : `-${up.value}`; stage?.setUp(up.value); } }, "Turn upside down"),
      h("button", { type: "button", class: "slim", onclick: () => stage?.fit() }, "Fit view")),
    help);
  let stage = null;
  let abort = new AbortController();
  let closed = false;
  let shown = null;
  let registered = null;
  let pressed = null;
  let sized = false;

  const say = (text) => {
    overlay.hidden = text === null;
    if (text !== null) fill(message, text);
  };

  async function start() {
    let three;
    try {
      three = await import("../../vendor/three.js");
    } catch {
      say("The viewer's 3D code is missing from this build of the service: run \u201cmake page\u201d and build it again. The points can be downloaded below.");
      return;
    }
    if (closed) return;
    try {
      stage = new Stage(three, canvas);
    } catch {
      say("This browser can't show 3D (WebGL is off or missing). The points can be downloaded below.");
      return;
    }
    await load(job.models[0]);
  }

  async function load(model) {
    abort.abort();
    abort = new AbortController();
    const { signal } = abort;
    frame.dataset.state = "loading";
    try {
      const [cloud, frusta] = await Promise.all([
        fetchPly(model.links.points, signal, (got, total) => say(`Loading points: ${bytes(got)}${total ? ` of ${bytes(total)}` : ""}`)),
        fetchPly(model.links.cameras, signal, () => {}).catch((problem) => {
          if (signal.aborted) throw problem;
          return null;
        }),
      ]);
      if (!sized) size.value = String(startSize(cloud.positions.length / 3));
      stage.setPointSize(Number(size.value));
      stage.show(cloud, frusta);
      shown = { model, cameras: (frusta?.positions.length ?? 0) / 3 / FRUSTUM_VERTICES };
      label.hidden = true;
      stage.showCameras(cameras.checked);
      canvas.setAttribute("aria-label", `Point cloud of ${count(cloud.positions.length / 3)} points with ${plural(model.images, "camera")}`);
      frame.dataset.state = "shown";
      say(null);
    } catch (problem) {
      if (signal.aborted) return;
      frame.dataset.state = "failed";
      say(`The model could not be shown: ${problem.message}.`);
    }
  }

  size.addEventListener("input", () => {
    sized = true;
    stage?.setPointSize(Number(size.value));
  });
  cameras.addEventListener("change", () => stage?.showCameras(cameras.checked));
  up.addEventListener("change", () => stage?.setUp(up.value));
  choice.addEventListener("change", () => stage && load(job.models.find((model) => model.id === Number(choice.value))));
  canvas.addEventListener("pointerdown", (event) => { pressed = [event.offsetX, event.offsetY]; });
  canvas.addEventListener("pointerup", (event) => {
    if (pressed && Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) < CLICK_PX) choose(event.offsetX, event.offsetY);
  });

  /** Shows the picture of the camera at a place on the canvas. Frusta stand in the file in the order of the pictures' paths. */
  async function choose(x, y) {
    const vertex = stage?.cameraAt(x, y) ?? null;
    stage?.highlight(vertex === null ? null : Math.floor(vertex / FRUSTUM_VERTICES) * FRUSTUM_VERTICES, FRUSTUM_VERTICES);
    label.hidden = vertex === null;
    if (vertex === null) return;
    try {
      registered ??= allRegistered(job);
      const images = (await registered).filter((image) => image.model === shown.model.id);
      if (images.length !== shown.cameras) throw new Error("the cameras and the verdicts don't fit together");
      const image = images[Math.floor(vertex / FRUSTUM_VERTICES)];
      fill(label, h("img", { src: image.links.thumbnail, alt: "" }), h("span", {}, image.name));
    } catch (problem) {
      registered = null;
      fill(label, `The picture can't be shown: ${problem.message}`);
    }
  }

  canvas.addEventListener("keydown", (event) => {
    if (!stage || event.ctrlKey || event.metaKey || event.altKey) return;
    const actions = {
      ArrowLeft: () => stage.turn(-KEY_TURN, 0),
      ArrowRight: () => stage.turn(KEY_TURN, 0),
      ArrowUp: () => stage.turn(0, KEY_TURN),
      ArrowDown: () => stage.turn(0, -KEY_TURN),
      "+": () => stage.zoom(1 / 1.15),
      "=": () => stage.zoom(1 / 1.15),
      "-": () => stage.zoom(1.15),
      f: () => stage.fit(),
      c: () => cameras.click(),
    };
    const action = actions[event.key] ?? actions[event.key.toLowerCase()];
    if (!action) return;
    event.preventDefault();
    action();
  });
  start();

  return {
    element,
    close() {
      closed = true;
      abort.abort();
      stage?.close();
    },
  };
}

async function allRegistered(job) {
  const images = [];
  let cursor = null;
  do {
    const page = await jobImages(job, cursor, "registered", 1000);
    images.push(...page.images);
    cursor = page.next_cursor;
  } while (cursor);
  return images;
}

/** Fetches and parses, telling how much has come. */
async function fetchPly(url, signal, ontold) {
  const response = await fetch(url, { signal });
  if (!response.ok) throw new Error(`the service answered ${response.status}`);
  // A compressed answer's length is not the length of what is read.
  const total = response.headers.get("content-encoding") ? 0 : Number(response.headers.get("content-length"));
  const chunks = [];
  let got = 0;
  const reader = response.body.getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    chunks.push(value);
    got += value.length;
    ontold(got, total);
  }
  return parsePly(await new Blob(chunks).arrayBuffer());
}
