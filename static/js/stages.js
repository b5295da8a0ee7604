// The stages of a run as a list that moves.

import { isOver } from "./api.js";
import { fill, h, icon } from "./dom.js";
import { count, duration, stageName, timeLeft } from "./format.js";

const MARKS = {
  pending: "M5 12a7 7 0 1 0 14 0a7 7 0 1 0-14 0",
  running: "M12 4a8 8 0 1 1-8 8",
  done: "M5 12.500l4.500 4.500L19 7.500",
  reused: "M5 12.500l4.500 4.500L19 7.500",
  stopped: "M6.500 6.500l11 11M17.500 6.500l-11 11",
};

const STATE_WORDS = { pending: "to come", running: "running", done: "done", reused: "kept from before", stopped: "stopped here" };

/** Counts that are measures, not whole numbers. */
const MEASURE = /_px$|_s$/;

function tookOf(job) {
  if (!job.started_at || !job.finished_at) return "It did not start";
  return `Took ${duration((new Date(job.finished_at) - new Date(job.started_at)) / 1000)}: the stages`;
}

/** The share of a running job's time that is over, by the middle of the guess of the rest. */
function shareDone(job) {
  if (!job.eta_s || !job.started_at) return 0;
  const elapsed_s = (Date.now() - new Date(job.started_at)) / 1000;
  const left_s = (job.eta_s.low + job.eta_s.high) / 2;
  return elapsed_s > 0 ? elapsed_s / (elapsed_s + left_s) : 0;
}

export function stagePanel() {
  const overall = h("div", { class: "overall" });
  const list = h("ol", { class: "stages" });
  const summary = h("summary", {}, "Stages");
  const details = h("details", { open: true }, summary, list);
  const element = h("section", { class: "card", "aria-label": "Progress" }, overall, details);
  const rows = new Map();
  let wasOver = null;
  let furthest = 0;

  function show(job) {
    const over = isOver(job);
    if (over !== wasOver) {
      details.open = !over || job.state !== "succeeded";
      wasOver = over;
    }
    showOverall(job, over);
    summary.textContent = over ? tookOf(job) : "Stages";
    const keys = new Set();
    for (const stage of job.stages) {
      const key = `${stage.name}/${stage.iteration ?? ""}`;
      keys.add(key);
      if (!rows.has(key)) rows.set(key, row());
      const { element: li, update } = rows.get(key);
      update(stage, over && stage.state === "running" ? "stopped" : stage.state);
      list.append(li);
    }
    for (const [key, { element: li }] of rows) {
      if (!keys.has(key)) {
        li.remove();
        rows.delete(key);
      }
    }
    details.hidden = job.stages.length === 0;
  }

  function showOverall(job, over) {
    if (over) {
      overall.hidden = true;
      return;
    }
    overall.hidden = false;
    if (job.state === "queued") {
      const ahead = (job.queue?.position ?? 1) - 1;
      const place = ahead > 0 ? `Waiting: ${count(ahead)} ahead` : "Waiting: next in turn";
      const left = timeLeft(job.eta_s);
      fill(overall, h("p", {}, left ? `${place} \u00b7 ${left}` : place));
      return;
    }
    const now = job.stage;
    const text = now ? `${stageName(now)}${now.total ? `: ${count(now.done)} of ${count(now.total)}` : ""}` : "Starting";
    const left = timeLeft(job.eta_s);
    let bar = overall.querySelector("progress");
    if (!bar) {
      fill(overall, h("p", { class: "number" }), h("progress", { max: 1, value: 0, "aria-label": "The whole job" }));
      bar = overall.querySelector("progress");
    }
    overall.querySelector("p").textContent = left ? `${text} \u00b7 ${left}` : text;
    // By time, not by stages, which differ in length; never backwards, although the guess of the rest may grow.
    furthest = Math.max(furthest, shareDone(job));
    bar.value = furthest;
  }

  return { element, show };
}

function row() {
  const mark = h("span");
  const what = h("span", { class: "what" });
  const bar = h("progress", { max: 1 });
  const gap = h("span", { class: "gap" });
  const time = h("span", { class: "time" });
  const counts = h("span", { class: "counts" });
  const element = h("li", {}, mark, what, bar, time, counts);
  let shown = null;

  function update(stage, state) {
    if (shown !== state) {
      shown = state;
      element.className = state;
      fill(mark, icon(MARKS[state], { class: "mark" }));
      fill(what, stageName(stage), h("span", { class: "visually-hidden" }, `: ${STATE_WORDS[state]}`));
      bar.setAttribute("aria-label", stageName(stage));
      (state === "running" ? gap : bar).replaceWith(state === "running" ? bar : gap);
    }
    if (state === "running" && stage.total) bar.value = stage.done / stage.total;
    else bar.removeAttribute("value");
    time.textContent = state === "running" && stage.total ? `${count(stage.done)} / ${count(stage.total)}` : state === "reused" ? "kept" : stage.wall_s === null ? "" : duration(stage.wall_s);
    counts.textContent = Object.entries(stage.counts ?? {}).map(([name, value]) => `${name.replaceAll("_", " ")} ${MEASURE.test(name) ? value.toFixed(2) : count(value)}`).join(" \u00b7 ");
    counts.hidden = counts.textContent === "";
  }
  return { element, update };
}
