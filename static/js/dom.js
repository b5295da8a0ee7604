// Building elements without a framework and without innerHTML: text from pictures' names never becomes markup.

/**
 * Makes an element. Attributes: `class`, `on<event>` functions, booleans, anything else by setAttribute.
 * @param {string} tag
 * @param {Record<string, any>} [attributes]
 * @param {...(Node|string|number|null|undefined|false|Array)} children
 * @returns {HTMLElement}
 */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  append(element, children);
  return element;
}

function append(element, children) {
  for (const child of children.flat(Infinity)) {
    if (child === null || child === undefined || child === false) continue;
    element.append(child instanceof Node ? child : String(child));
  }
}

/** Replaces what an element holds. */
export function fill(element, ...children) {
  element.replaceChildren();
  append(element, children);
  return element;
}

const SVG = "http://www.w3.org/2000/svg";

/** A line icon on a 24 x 24 field. */
export function icon(path, attributes = {}) {
  const svg = document.createElementNS(SVG, "svg");
  const all = { viewBox: "0 0 24 24", fill: "none", stroke: "currentColor", "stroke-width": 1.8, "stroke-linecap": "round", "stroke-linejoin": "round", "aria-hidden": "true", ...attributes };
  for (const [name, value] of Object.entries(all)) svg.setAttribute(name, value);
  const line = document.createElementNS(SVG, "path");
  line.setAttribute("d", path);
  svg.append(line);
  return svg;
}

/** Tells a sentence to those who don't see the page. */
export function announce(text) {
  document.getElementById("live").textContent = text;
}

/** Asks before something that can't be undone. Resolves to whether it was confirmed. */
export function confirmed(question, action) {
  return new Promise((resolve) => {
    const dialog = h("dialog", { "aria-labelledby": "dialog-question", onclose: () => { dialog.remove(); resolve(dialog.returnValue === "yes"); } },
      h("p", { id: "dialog-question" }, question),
      h("form", { method: "dialog", class: "row" },
        h("button", { value: "yes", class: "danger" }, action),
        h("button", { value: "no", autofocus: true }, "Keep it")));
    document.body.append(dialog);
    dialog.showModal();
  });
}
