// What can be downloaded.

import { jobOutputs } from "./api.js";
import { fill, h } from "./dom.js";
import { bytes, plural } from "./format.js";

/** What a file is for, by the form of its path; the first that fits. */
const PURPOSES = [
  [/^report\.html$/, "The report, for people"],
  [/^report\.json$/, "The report, for programs"],
  [/^ply\/\d+\/points\.ply$/, "Coloured points (MeshLab, CloudCompare, Blender)"],
  [/^ply\/\d+\/cameras\.ply$/, "Cameras as frusta"],
  [/^sparse\/\d+\/.*\.bin$/, "COLMAP, binary"],
  [/^sparse\/\d+\/.*\.txt$/, "COLMAP, text"],
  [/^bundle\/\d+\//, "Bundler"],
];

/** These first, the rest under "all files". */
const FIRST = /^(report\.html|report\.json|ply\/\d+\/(points|cameras)\.ply)$/;

function order(path) {
  const at = PURPOSES.findIndex(([form]) => form.test(path));
  return at < 0 ? PURPOSES.length : at;
}

export function downloads(job) {
  const body = h("div", { class: "downloads" }, h("p", { class: "muted" }, "Loading ..."));
  const element = h("section", { class: "card", "aria-labelledby": "downloads-title" }, h("h2", { id: "downloads-title" }, "Downloads"), body);
  jobOutputs(job).then((list) => {
    if (list.files.length === 0) {
      fill(body, h("p", { class: "muted" }, "There are no files."));
      return;
    }
    const report = list.files.find((file) => file.path === "report.html");
    const files = [...list.files].sort((a, b) => order(a.path) - order(b.path) || a.path.localeCompare(b.path));
    const rest = files.filter((file) => !FIRST.test(file.path));
    fill(body,
      h("div", { class: "row" },
        h("a", { class: "button primary", href: list.links.archive, download: "" }, `Everything as zip (${bytes(list.total_bytes)})`),
        report && h("a", { class: "button", href: report.links.self, target: "_blank", rel: "noopener" }, "Open the report")),
      table("The main files", files.filter((file) => FIRST.test(file.path))),
      rest.length > 0 && h("details", {}, h("summary", {}, plural(rest.length, "further file")), table("Further files", rest)));
  }).catch((problem) => fill(body, h("p", { class: "notice bad" }, problem.message)));
  return element;
}

function table(caption, files) {
  return h("div", { class: "table-wrap" }, h("table", {},
    h("caption", { class: "visually-hidden" }, caption),
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "File"), h("th", { scope: "col" }, "What it is"), h("th", { scope: "col", class: "right" }, "Size"))),
    h("tbody", {}, files.map((file) => h("tr", {},
      h("td", {}, h("a", { href: file.links.self, download: file.path.split("/").pop() }, file.path)),
      h("td", { class: "muted" }, PURPOSES.find(([form]) => form.test(file.path))?.[1] ?? ""),
      h("td", { class: "right" }, bytes(file.size_bytes)))))));
}
