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
  const filters = [[null, "all", uploaded], ["registered", STATES.registered, registered], ["unregistered", STATES.unregistered, unregistered], ["rejected", STATES.rejected, rejected]]
    .filter(([state, , n]) => state === null || (n ?? 0) > 0)
    .map(([state, label, n]) => h("button", { type: "button", class: "slim", "aria-pressed": "false", "data-state": state ?? "", onclick: () => choose(state) }, `${label} ${count(n)}`));
  let state = null;
  let cursor = null;
  let asked = 0;

  async function load() {
    const mine = asked;
    more.disabled = true;
    try {
      const page = await jobImages(job, cursor, state);
      // Another filter was chosen meanwhile.
      if (mine !== asked) return;
      list.append(...page.images.map(card));
      cursor = page.next_cursor;
      more.hidden = !cursor;
      note.hidden = page.total > 0;
      note.textContent = "None.";
    } catch (problem) {
      note.hidden = false;
      note.textContent = problem.message;
      more.hidden = false;
    }
    more.disabled = false;
  }

  function choose(next) {
    state = next;
    cursor = null;
    asked += 1;
    fill(list);
    for (const button of filters) button.setAttribute("aria-pressed", String(button.dataset.state === (state ?? "")));
    load();
  }
  more.addEventListener("click", load);
  // Pictures that need something done are what a person looks for first.
  choose(out > 0 && out < (registered ?? 0) ? ((unregistered ?? 0) > 0 ? "unregistered" : "rejected") : null);

  return h("section", { class: "card", "aria-labelledby": "verdicts-title" },
    h("div", { class: "section-head" }, h("h2", { id: "verdicts-title" }, "Pictures"),
      h("span", { class: "muted" }, job.state === "succeeded" ? (out === 0 ? "Every one is in the model." : `${plural(out, "picture is", "pictures are")} not in a model.`) : null)),
    h("div", { class: "filter", role: "group", "aria-label": "Show" }, filters),
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
