// What became of every picture, and what to do about those left out.

import { jobImages } from "./api.js";
import { fill, h } from "./dom.js";
import { STATES, count, fixed, plural, stageKey } from "./format.js";

export function verdicts(job) {
  const { registered, unregistered, rejected, uploaded } = job.images;
  const out = (unregistered ?? 0) + (rejected ?? 0);
  const list = h("ul", { class: "verdicts" });
  const note = h("p", { class: "muted", hidden: true });
  const more = h("button", { type: "button", hidden: true }, "Show more");
  // What can be shown: a label, how many, and the states, listed one after the other; none means all, by name.
  const views = [
    ["all", uploaded, []],
    [STATES.registered, registered, ["registered"]],
    ["not in a model", out, ["unregistered", "rejected"]],
  ].filter(([label, n]) => label === "all" || (n ?? 0) > 0);
  const buttons = views.map((view) => h("button", { type: "button", class: "slim", "aria-pressed": "false", onclick: () => choose(view) }, `${view[0]} ${count(view[1])}`));
  let waiting = [];
  let cursor = null;
  let asked = 0;

  async function load() {
    const mine = asked;
    more.disabled = true;
    try {
      do {
        const page = await jobImages(job, cursor, waiting[0]);
        // Another view was chosen meanwhile.
        if (mine !== asked) return;
        list.append(...page.images.map(card));
        cursor = page.next_cursor;
        if (!cursor) waiting.shift();
      } while (waiting.length > 0 && !cursor);
      more.hidden = waiting.length === 0;
      note.hidden = list.childElementCount > 0;
      note.textContent = "None.";
    } catch (problem) {
      if (mine !== asked) return;
      note.hidden = false;
      note.textContent = problem.message;
      more.hidden = false;
    }
    more.disabled = false;
  }

  function choose(view) {
    waiting = view[2].length > 0 ? [...view[2]] : [null];
    cursor = null;
    asked += 1;
    fill(list);
    buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(views[k] === view)));
    load();
  }
  more.addEventListener("click", load);
  // Pictures that need something done are what a person looks for first.
  choose(out > 0 && out < (uploaded ?? 0) ? views[views.length - 1] : views[0]);

  return h("section", { class: "card", "aria-labelledby": "verdicts-title" },
    h("div", { class: "section-head" }, h("h2", { id: "verdicts-title" }, "Pictures"),
      h("span", { class: "muted" }, job.state === "succeeded" ? (out === 0 ? "Every one is in the model." : `${plural(out, "picture is", "pictures are")} not in a model.`) : null)),
    h("div", { class: "filter", role: "group", "aria-label": "Show" }, buttons),
    note, list, h("div", { class: "row" }, more));
}

function card(image) {
  const frame = h("div", { class: "frame" });
  const thumbnail = h("img", { src: image.links.thumbnail, alt: "", loading: "lazy", decoding: "async", width: 320, height: 240, onerror: () => fill(frame, "no preview") });
  frame.append(thumbnail);
  const facts = image.state === "registered"
    ? [image.inliers !== null && plural(image.inliers, "point"), image.mean_reprojection_error_px !== null && `${fixed(image.mean_reprojection_error_px, 2)} px`, image.registered_in && stageKey(image.registered_in).toLowerCase()]
    : [image.features !== null && plural(image.features, "feature")];
  return h("li", { "data-reason": image.reason },
    frame,
    h("div", { class: "text" },
      h("span", { class: "name" }, image.name),
      h("span", { class: `badge ${image.state}` }, STATES[image.state] + (image.model !== null && image.model > 0 ? ` ${image.model + 1}` : "")),
      image.advice && h("span", {}, image.advice),
      h("span", { class: "muted" }, facts.filter(Boolean).join(" \u00b7 "))));
}
