// The view of one job: its stages while it runs, then the model, the verdicts and the downloads.

import { cancelJob, deleteJob, getJob, isOver, jobReport, resumeJob } from "./api.js";
import { announce, confirmed, fill, h } from "./dom.js";
import { follow } from "./events.js";
import { STATES, count, fixed, plural, when } from "./format.js";
import { downloads } from "./outputs.js";
import { stagePanel } from "./stages.js";
import { verdicts } from "./verdicts.js";
import { modelViewer } from "./viewer/panel.js";

export function jobView(main, id) {
  let follower = null;
  let viewer = null;
  let closed = false;
  let shownState = null;
  let job = null;

  const head = h("div", { class: "job-head" }, h("p", { class: "muted" }, "Loading ..."));
  const trouble = h("p", { class: "notice warn", role: "alert", hidden: true });
  const stages = stagePanel();
  const results = h("div", { class: "results" });
  main.append(head, trouble, stages.element, results);
  stages.element.hidden = true;

  const showTrouble = (problem) => {
    trouble.hidden = problem === null;
    if (problem) trouble.textContent = problem.message;
  };
  const act = (action) => async () => {
    try {
      await action();
    } catch (problem) {
      showTrouble(problem);
    }
  };

  async function load() {
    try {
      job = await getJob(id);
    } catch (problem) {
      if (!closed) fill(head, h("h1", {}, problem.code === "job_not_found" ? "There is no such job" : "The job could not be loaded"), h("p", {}, problem.message), h("p", {}, h("a", { href: "#/" }, "All jobs")));
      return;
    }
    if (closed) return;
    update(job);
    follower?.close();
    follower = isOver(job) ? null : follow(job, update, showTrouble);
  }

  function update(fresh) {
    job = fresh;
    stages.element.hidden = false;
    stages.show(job);
    // The head and the results change with the state only, so that focus stays and the viewer is made once.
    const state = `${job.state} ${job.cancel_requested}`;
    if (shownState === state) return;
    if (shownState !== null) announce(`The job is ${STATES[job.state]}.`);
    shownState = state;
    document.title = `${job.name || "Job"} \u00b7 Multistage`;
    showHead();
    showResults();
  }

  function showHead() {
    const over = isOver(job);
    fill(head,
      h("p", { class: "small" }, h("a", { href: "#/" }, "\u2190 All jobs")),
      h("div", { class: "row" },
        h("h1", {}, job.name || "Unnamed"),
        h("span", { class: `badge ${job.state}` }, job.cancel_requested && !over ? "stopping" : STATES[job.state]),
        !over && h("button", { type: "button", class: "push", disabled: job.cancel_requested, onclick: act(async () => update(await cancelJob(job))) }, "Stop"),
        (job.state === "failed" || job.state === "cancelled") && h("button", { type: "button", class: "push", onclick: act(async () => { await resumeJob(job); await load(); }) }, "Go on"),
        over && h("button", { type: "button", class: `danger ${job.state === "succeeded" ? "push" : ""}`, onclick: act(async () => {
          if (await confirmed(`Delete "${job.name || "this job"}" and its model? This can't be undone.`, "Delete")) {
            await deleteJob(job);
            location.hash = "#/";
          }
        }) }, "Delete")),
      h("p", { class: "muted" }, `${plural(job.images.uploaded, "picture")}, sent ${when(job.created_at)}`));
  }

  function showResults() {
    viewer?.close();
    viewer = null;
    results.replaceChildren();
    // While it runs the stages are the news, afterwards the model is.
    if (job.state === "succeeded") results.after(stages.element);
    else results.before(stages.element);
    if (!isOver(job)) return;
    if (job.error) {
      results.append(h("div", { class: "notice bad" },
        h("p", {}, h("strong", {}, job.error.code === "no_model" ? "No model came of these pictures." : "The job failed.")),
        h("p", {}, job.error.message),
        h("p", { class: "small" }, [job.error.stage && `Stage ${job.error.stage}, `, `code ${job.error.code}`])));
    }
    if (job.models.length > 0) {
      viewer = modelViewer(job);
      results.append(viewer.element, facts());
    }
    results.append(notes(), verdicts(job), downloads(job));
  }

  /** What the run itself has to say: what was widened, cut or left out, and why. Not there where it says nothing. */
  function notes() {
    const list = h("ul", {});
    const section = h("section", { class: "card", "aria-labelledby": "notes-title", hidden: true }, h("h2", { id: "notes-title" }, "What to know"), list);
    jobReport(job).then((report) => {
      fill(list, (report.notes ?? []).map((note) => h("li", {}, note)));
      section.hidden = list.childElementCount === 0;
    }, () => {}); // A job that was stopped has no report.
    return section;
  }

  function facts() {
    const model = job.models[0];
    const fact = (name, value) => h("div", {}, h("dt", {}, name), h("dd", {}, value));
    return h("section", { class: "card", "aria-labelledby": "facts-title" },
      h("h2", { id: "facts-title" }, job.models.length > 1 ? "The largest model" : "In numbers"),
      h("dl", { class: "facts" },
        fact("pictures placed", `${count(model.images)} of ${count(job.images.uploaded)}`),
        fact("points", count(model.points)),
        fact("points in 3 or more pictures", count(model.points_3plus)),
        fact("pictures per point, mean", fixed(model.mean_track_length, 2)),
        fact("mean error, pixels", fixed(model.mean_reprojection_error_px, 2)),
        fact("median error, pixels", fixed(model.median_reprojection_error_px, 2))),
      job.models.length > 1 && h("p", { class: "muted small" }, `The pictures fall into ${plural(job.models.length, "separate model")}: nothing ties them together. Each can be seen above and downloaded.`));
  }

  load();
  return {
    close() {
      closed = true;
      follower?.close();
      viewer?.close();
    },
  };
}
