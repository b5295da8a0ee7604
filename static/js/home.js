// The first view: choose or drop pictures, start a job; and the jobs there are.

import { createJob, isOver, listJobs } from "./api.js";
import { announce, fill, h, icon } from "./dom.js";
import { STATES, bytes, count, duration, plural, stageName, timeLeft, when } from "./format.js";
import { Selection, fromDrop, fromInput } from "./pick.js";
import { Upload } from "./upload.js";

/** Pictures shown beside the count. */
const PREVIEWS = 11;
/** How often the list of jobs is asked for again. */
const REFRESH_MS = 4000;

/** The panel for a new job outlives the view: an upload goes on while another job is looked at. */
let panelForNew = null;

export function homeView(main) {
  panelForNew ??= newJob();
  document.title = "Multistage";
  const jobs = jobList();
  main.append(
    h("div", { class: "home" },
      h("section", { "aria-labelledby": "new-title" },
        h("h1", { id: "new-title" }, "A model from photographs"),
        h("p", { class: "lead" }, "Give a folder of pictures of one place or object, taken from many sides with plenty of overlap. You get a coloured point cloud, the position of every camera, and a verdict on every picture."),
        panelForNew),
      jobs.element));
  return { close: jobs.close };
}

function newJob() {
  let selection = new Selection();
  let upload = null;
  const panel = h("div", { class: "card new-job" });
  const urls = [];
  const warnLeaving = (event) => event.preventDefault();

  const filesInput = h("input", { type: "file", id: "pick-files", multiple: true, hidden: true, accept: ".jpg,.jpeg,.png,.tif,.tiff,.webp,.zip" });
  const folderInput = h("input", { type: "file", id: "pick-folder", webkitdirectory: true, hidden: true });
  for (const input of [filesInput, folderInput]) {
    input.addEventListener("change", () => {
      choose(fromInput(input));
      input.value = "";
    });
  }

  function choose(picked) {
    selection.add(picked);
    announce(`${plural(selection.pictures.size, "picture")} chosen`);
    showChoice();
    if (selection.size > 0) panel.querySelector("#job-name")?.focus();
  }

  function dropZone(compact) {
    const zone = h("div", { class: "drop" },
      compact ? null : icon("M3 7a2 2 0 0 1 2-2h4l2 2.500h8a2 2 0 0 1 2 2V17a2 2 0 0 1-2 2H5a2 2 0 0 1-2-2zM12 16.500v-5M9.500 13.500 12 11l2.500 2.500"),
      h("strong", {}, compact ? "Drop more here" : "Drop pictures or a folder here"),
      h("div", { class: "row" },
        h("button", { type: "button", class: compact ? "" : "primary", onclick: () => folderInput.click() }, "Choose a folder"),
        h("button", { type: "button", onclick: () => filesInput.click() }, "Choose pictures")),
      compact ? null : h("p", { class: "muted small" }, "JPEG, PNG, TIFF, WebP, or a zip of them. Sub-folders are kept."));
    return zone;
  }

  // The whole window takes a drop, so that a near miss does not open the picture instead of the page.
  panel.addEventListener("dragover", () => panel.querySelector(".drop")?.classList.add("over"));
  panel.addEventListener("dragleave", (event) => {
    if (!panel.contains(event.relatedTarget)) panel.querySelector(".drop")?.classList.remove("over");
  });
  const onDragOver = (event) => {
    if (panel.isConnected) event.preventDefault();
  };
  const onDrop = async (event) => {
    if (!panel.isConnected) return;
    event.preventDefault();
    panel.querySelector(".drop")?.classList.remove("over");
    if (upload) return;
    try {
      choose(await fromDrop(event.dataTransfer));
    } catch {
      showChoice("Part of what was dropped could not be read.");
    }
  };
  addEventListener("dragover", onDragOver);
  addEventListener("drop", onDrop);

  function showChoice(error = null) {
    for (const url of urls.splice(0)) URL.revokeObjectURL(url);
    const notes = [
      error && h("p", { class: "notice bad", role: "alert" }, error),
      selection.ignored > 0 && h("p", { class: "muted small" }, `${plural(selection.ignored, "other file")} left out: not JPEG, PNG, TIFF or WebP.`),
    ];
    if (selection.size === 0) {
      fill(panel, h("h2", { class: "visually-hidden" }, "Choose pictures"), dropZone(false), notes, filesInput, folderInput);
      return;
    }
    const few = selection.archives.size === 0 && selection.pictures.size < 3;
    const name = h("input", { type: "text", id: "job-name", maxlength: 200, value: selection.folder || `Pictures of ${new Intl.DateTimeFormat(undefined, { dateStyle: "medium" }).format(new Date())}`, autocomplete: "off" });
    const options = optionFields();
    const what = [
      selection.pictures.size > 0 && plural(selection.pictures.size, "picture"),
      selection.archives.size > 0 && plural(selection.archives.size, "archive"),
    ].filter(Boolean).join(" and ");
    const form = h("form", { class: "chosen", onsubmit: (event) => {
      event.preventDefault();
      const read = options.read();
      if (read) start(name.value.trim(), read);
    } },
      h("div", { class: "section-head" },
        h("h2", {}, what),
        h("span", { class: "muted" }, bytes(selection.bytes)),
        h("button", { type: "button", class: "slim push", onclick: () => { selection = new Selection(); showChoice(); } }, "Start over")),
      previews(),
      notes,
      few && h("p", { class: "notice warn" }, "A model needs at least three pictures; twenty or more from all sides are better."),
      h("div", { class: "field" }, h("label", { for: "job-name" }, "Name"), name),
      options.element,
      h("div", { class: "row" }, h("button", { type: "submit", class: "primary", disabled: few }, "Upload and reconstruct")));
    fill(panel, form, dropZone(true), filesInput, folderInput);
  }

  function previews() {
    // TIFF is not shown by browsers.
    const shown = [...selection.pictures].filter(([path]) => !/\.tiff?$/i.test(path));
    const step = Math.max(1, shown.length / PREVIEWS);
    const list = h("ul", { class: "previews", "aria-hidden": "true" });
    for (let k = 0; k < Math.min(PREVIEWS, shown.length); k += 1) {
      const url = URL.createObjectURL(shown[Math.floor(k * step)][1]);
      urls.push(url);
      list.append(h("li", {}, h("img", { src: url, alt: "", loading: "lazy", decoding: "async" })));
    }
    const rest = selection.pictures.size - Math.min(PREVIEWS, shown.length);
    if (rest > 0) list.append(h("li", { class: "more" }, `+${count(rest)}`));
    return list;
  }

  async function start(name, options, resumed = null) {
    const bar = h("progress", { max: 1, value: 0, "aria-label": "Upload" });
    const text = h("p", { class: "number" }, "Starting ...");
    const detail = h("p", { class: "muted small" });
    const files = h("ul", { class: "under-way", "aria-label": "Files under way" });
    fill(panel,
      h("h2", {}, `Uploading ${name || "pictures"}`), bar, text, detail, files,
      h("div", { class: "row" }, h("button", { type: "button", onclick: async () => { await upload?.cancel(); } }, "Stop the upload")));
    const began = performance.now();
    const sentBefore = resumed?.sent ?? 0;
    let told = 0;
    const progress = ({ sent, kept, total, files: count, waiting, current }) => {
      bar.value = total > 0 ? sent / total : 1;
      text.textContent = `${bytes(sent)} of ${bytes(total)}`;
      const elapsed_s = (performance.now() - began) / 1000;
      const rate = (sent - Math.max(sentBefore, kept)) / elapsed_s;
      fill(files, current.map((file) => h("li", {}, h("span", {}, file.path), h("progress", { max: Math.max(1, file.size), value: file.sent, "aria-label": file.path }))));
      detail.textContent = waiting ?? [`${plural(count, "file")} stored`, kept > 0 && `${bytes(kept)} of an earlier visit`, elapsed_s > 2 && rate > 0 && `${bytes(rate)}/s, ${timeLeft({ low: (total - sent) / rate, high: (total - sent) / rate })}`].filter(Boolean).join(" \u00b7 ");
      const quarter = Math.floor((4 * sent) / Math.max(1, total));
      if (quarter > told) {
        told = quarter;
        announce(`${quarter * 25} percent uploaded`);
      }
    };
    upload = resumed ?? new Upload(selection, name, progress);
    upload.onprogress = progress;
    addEventListener("beforeunload", warnLeaving);
    try {
      const dataset = await upload.run();
      const job = await upload.persist(() => createJob({ dataset_id: dataset.id, ...(name ? { name } : {}), options }));
      announce("Uploaded. The job is queued.");
      upload.finish();
      upload = null;
      selection = new Selection();
      const watched = panel.isConnected;
      showChoice();
      if (watched) location.hash = `#/jobs/${job.id}`;
    } catch (problem) {
      const failed = upload;
      upload = null;
      if (failed.stopped) {
        showChoice();
        return;
      }
      const list = problem.errors?.length ? h("ul", {}, problem.errors.map((e) => h("li", {}, e))) : null;
      fill(panel,
        h("div", { class: "notice bad", role: "alert" }, h("p", {}, problem.message), list),
        h("div", { class: "row" },
          h("button", { type: "button", class: "primary", onclick: () => start(name, options, failed) }, "Try again"),
          h("button", { type: "button", onclick: async () => { await failed.cancel(); showChoice(); } }, "Back")));
    } finally {
      removeEventListener("beforeunload", warnLeaving);
    }
  }

  showChoice();
  return panel;
}

/** The few options a person may want; everything else as JSON. */
function optionFields() {
  const select = (id, choices, chosen) => h("select", { id }, choices.map(([value, label]) => h("option", { value, selected: value === chosen }, label)));
  const size = select("option-size", [["1600", "1600 pixels: quick"], ["3200", "3200 pixels"], ["20000", "as taken: slow"]], "3200");
  const rounds = select("option-rounds", [["1", "1"], ["2", "2"], ["3", "3"]], "2");
  const refine = select("option-refine", [["yes", "yes"], ["no", "no, as in the paper"]], "yes");
  const more = h("textarea", { id: "option-json", spellcheck: "false", placeholder: '{ "intake": { "default_focal": 1.0 } }', "aria-describedby": "option-json-hint" });
  const error = h("p", { class: "notice bad", role: "alert", hidden: true });
  const details = h("details", {},
    h("summary", {}, "Options"),
    h("div", { class: "option-grid" },
      h("div", { class: "field" }, h("label", { for: "option-size" }, "Long side of the pictures, at most"), size),
      h("div", { class: "field" }, h("label", { for: "option-rounds" }, "Rounds of adding cameras and points"), rounds),
      h("div", { class: "field" }, h("label", { for: "option-refine" }, "Adjust everything at the end"), refine),
      h("div", { class: "field wide" }, h("label", { for: "option-json" }, "Further options"), more,
        h("span", { class: "hint", id: "option-json-hint" }, "As a JSON object; it goes before the choices above.")),
      error));
  return {
    element: details,
    read() {
      const options = {};
      if (size.value !== "3200") options.intake = { max_long_side_px: Number(size.value) };
      if (rounds.value !== "2") options.iterations = Number(rounds.value);
      if (refine.value !== "yes") options.refine = { enabled: false };
      error.hidden = true;
      try {
        const given = more.value.trim() ? JSON.parse(more.value) : {};
        if (typeof given !== "object" || given === null || Array.isArray(given)) throw new TypeError("not an object");
        for (const [name, value] of Object.entries(given)) {
          const nested = typeof value === "object" && value !== null && !Array.isArray(value);
          options[name] = nested ? { ...options[name], ...value } : value;
        }
        return options;
      } catch (problem) {
        details.open = true;
        error.hidden = false;
        error.textContent = `The further options are not a JSON object: ${problem.message}`;
        more.focus();
        return null;
      }
    },
  };
}

function jobList() {
  const list = h("ul", { class: "job-list" });
  const note = h("p", { class: "muted" }, "Loading ...");
  const more = h("button", { type: "button", hidden: true }, "Older jobs");
  const element = h("section", { class: "card", "aria-labelledby": "jobs-title" }, h("h2", { id: "jobs-title" }, "Jobs"), note, list, more);
  let timer = null;
  let closed = false;
  let pages = 1;

  async function refresh() {
    try {
      const jobs = [];
      let cursor = null;
      for (let k = 0; k < pages; k += 1) {
        const page = await listJobs(cursor);
        jobs.push(...page.jobs);
        cursor = page.next_cursor;
        if (!cursor) break;
      }
      if (closed) return;
      more.hidden = !cursor;
      note.hidden = jobs.length > 0;
      note.textContent = "None yet. They appear here, newest first.";
      // An unchanged list is left alone, so that focus and selection stay where they are.
      const key = JSON.stringify(jobs.map((job) => [job.id, job.state, job.stage, job.models.length]));
      if (list.dataset.key !== key) {
        const focused = document.activeElement?.closest?.(".job-list a")?.getAttribute("href");
        list.dataset.key = key;
        fill(list, jobs.map(entry));
        if (focused) list.querySelector(`a[href="${CSS.escape(focused)}"]`)?.focus();
      }
    } catch (problem) {
      if (closed) return;
      note.hidden = false;
      note.textContent = problem.message;
    }
    if (!closed) timer = setTimeout(refresh, REFRESH_MS);
  }
  more.addEventListener("click", () => {
    pages += 1;
    clearTimeout(timer);
    refresh();
  });
  refresh();
  return {
    element,
    close() {
      closed = true;
      clearTimeout(timer);
    },
  };
}

function entry(job) {
  const model = job.models[0];
  const facts = model
    ? `${plural(model.points, "point")} \u00b7 ${count(model.images)} of ${plural(job.images.uploaded, "picture")}`
    : job.stage
      ? `${stageName(job.stage)}${job.stage.total ? `, ${count(job.stage.done)} of ${count(job.stage.total)}` : ""}`
      : job.error
        ? job.error.message
        : plural(job.images.uploaded, "picture");
  const took = isOver(job) && job.started_at && job.finished_at ? ` \u00b7 took ${duration((new Date(job.finished_at) - new Date(job.started_at)) / 1000)}` : "";
  return h("li", {}, h("a", { href: `#/jobs/${job.id}` },
    h("span", { class: "title" }, h("span", { class: "name" }, job.name || "Unnamed"), h("span", { class: `badge ${job.state}` }, STATES[job.state])),
    h("span", { class: "muted small" }, facts),
    h("span", { class: "muted small" }, when(job.created_at) + took)));
}
