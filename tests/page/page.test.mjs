// The page on the stand-in service: what the real one does too seldom, or too slowly, to be tested on it.
import assert from "node:assert/strict";
import { mkdir, mkdtemp, readFile, rm, writeFile } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { coloursOnResize, distinctColours, noBrowser, openBrowser, openPage } from "./browser.mjs";
import { startMock } from "./mock.mjs";

const skip = noBrowser;
const AXE = await readFile(new URL("./node_modules/axe-core/axe.min.js", import.meta.url), "utf8");

let browser;
let folder;

before(async () => {
  if (skip) return;
  browser = await openBrowser();
  // The stand-in never decodes pictures; a name and some bytes do.
  folder = join(await mkdtemp(join(tmpdir(), "multistage-page-")), "temple");
  await mkdir(join(folder, "north side"), { recursive: true });
  for (let k = 0; k < 6; k += 1) await writeFile(join(folder, k < 2 ? "north side" : "", `picture ${k} \u00e9.jpg`), `picture ${k}`);
  await writeFile(join(folder, "notes.txt"), "no picture");
  await writeFile(join(folder, ".hidden.jpg"), "no choice of anybody's");
});
after(async () => {
  await browser?.close();
  if (folder) await rm(join(folder, ".."), { recursive: true });
});

/** Runs a test body with a stand-in and a page on it, and fails when the console told of errors. */
async function onMock(options, body, pageOptions) {
  const mock = await startMock(options);
  const { page, errors } = await openPage(browser, mock.url, pageOptions);
  try {
    await body(page, mock);
    assert.deepEqual(errors, []);
  } finally {
    await page.close();
    await mock.close();
  }
}

async function choose(page) {
  await page.setInputFiles("#pick-folder", folder);
  await page.getByRole("heading", { name: "6 pictures" }).waitFor();
}

async function axe(page) {
  await page.evaluate(AXE);
  const found = await page.evaluate(() => window.axe.run(document, { runOnly: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"] }));
  return found.violations.map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.html).join(" | ")}`);
}

test("a folder goes up with its sub-folders and becomes a model on the canvas", { skip }, () => onMock({ stage_ms: 150, models: 2 }, async (page, mock) => {
  await choose(page);
  await page.getByText("1 other file left out").waitFor();
  assert.equal(await page.inputValue("#job-name"), "temple");
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.locator(".stages .running").waitFor();
  await page.locator('.viewer[data-state="shown"]').waitFor();
  const [dataset] = mock.datasets.values();
  assert.deepEqual([...dataset.files].sort(), ["north side/picture 0 \u00e9.jpg", "north side/picture 1 \u00e9.jpg", ...[2, 3, 4, 5].map((k) => `picture ${k} \u00e9.jpg`)]);
  assert.equal(await page.locator(".stages li.done").count(), 10);

  const canvas = page.locator("canvas");
  const colours = await distinctColours(page, canvas);
  assert.ok(colours > 500, `the canvas shows only ${colours} colours`);
  const look = async () => (await canvas.screenshot()).toString("base64");
  await canvas.focus();
  const first = await look();
  await page.keyboard.press("ArrowLeft");
  await page.waitForTimeout(400);
  const turned = await look();
  assert.notEqual(turned, first, "an arrow key turns the model");
  // Clicking about where the ring of cameras stands finds one, and names its picture.
  const box = await canvas.boundingBox();
  const label = page.locator(".viewer .label");
  search: for (const y of [0.55, 0.65, 0.45, 0.75]) {
    for (let x = 0.1 * box.width; x < 0.9 * box.width; x += 15) {
      await page.mouse.click(box.x + x, box.y + y * box.height);
      if (await label.isVisible()) break search;
    }
  }
  await label.getByText(/picture \d.*\.jpg/).waitFor();
  await page.keyboard.press("c");
  await page.waitForTimeout(400);
  assert.equal(await page.isChecked("#show-cameras"), false);
  const without = await look();
  assert.notEqual(without, turned, "the cameras can be hidden");
  await page.getByRole("button", { name: "Turn upside down" }).click();
  await page.waitForTimeout(400);
  assert.equal(await page.inputValue("#up-axis"), "-z");
  assert.notEqual(await look(), without);
  await page.selectOption("#which-model", "1");
  await page.locator('.viewer[data-state="shown"]').waitFor();
  const resized = await coloursOnResize(page, canvas, 300);
  assert.ok(resized > 500, `a canvas whose size changes shows only ${resized} colours`);

  await page.getByText("The scale is arbitrary").waitFor();
  await page.getByRole("button", { name: "all 6" }).click();
  await page.locator(".verdicts li").nth(5).waitFor();
  // Those left out stand together, whatever the reason; upright thumbnails hide no words.
  await page.getByRole("button", { name: "not in a model 2" }).click();
  await page.getByText("The file is cut short").waitFor();
  await page.getByText("shows nothing that another photograph shows").waitFor();
  assert.equal(await page.locator(".verdicts li").count(), 2);
  await page.waitForFunction(() => [...document.querySelectorAll(".verdicts img")].every((image) => image.complete));
  const shapes = await page.locator(".verdicts .frame").evaluateAll((frames) => frames.map((frame) => frame.clientHeight / frame.clientWidth));
  shapes.forEach((shape) => assert.ok(Math.abs(shape - 0.75) < 0.02, `a frame of ${shape}`));
}));

test("a folder can be dropped, and its sub-folders keep their names", { skip }, () => onMock({ stage_ms: 50 }, async (page, mock) => {
  // As the browser gets it from the file manager: a path, not files.
  const drop = await page.locator(".drop").boundingBox();
  const devtools = await page.context().newCDPSession(page);
  for (const type of ["dragEnter", "dragOver", "drop"]) {
    await devtools.send("Input.dispatchDragEvent", { type, x: drop.x + 20, y: drop.y + 20, data: { items: [], files: [folder], dragOperationsMask: 1 } });
  }
  await page.getByRole("heading", { name: "6 pictures" }).waitFor();
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  // The quick stand-in may be done, and its stages folded up, before this looks.
  await page.locator(".stages li").first().waitFor({ state: "attached" });
  const [dataset] = mock.datasets.values();
  assert.deepEqual([...dataset.files].sort(), ["north side/picture 0 \u00e9.jpg", "north side/picture 1 \u00e9.jpg", ...[2, 3, 4, 5].map((k) => `picture ${k} \u00e9.jpg`)]);
}));

test("an upload that is cut off goes on by itself and stores nothing twice", { skip }, () => onMock({
  stage_ms: 50,
  fail: (method, path, nth) => (method === "POST" && path === "/api/v1/uploads" ? ["drop", 503][nth - 1] : undefined),
}, async (page, mock) => {
  await choose(page);
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.getByText("Trying again in 1 s").waitFor();
  await page.locator('.viewer[data-state="shown"]').waitFor({ timeout: 20000 });
  assert.equal(mock.datasets.size, 1);
  assert.equal([...mock.datasets.values()][0].files.size, 6);
}));

test("a problem that won't pass is shown, and can be tried again", { skip }, () => onMock({
  stage_ms: 50,
  fail: (method, path, nth) => (method === "POST" && path === "/api/v1/jobs" && nth === 1 ? 422 : undefined),
}, async (page) => {
  await choose(page);
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.getByRole("alert").waitFor();
  await page.getByRole("button", { name: "Try again" }).click();
  await page.locator('.viewer[data-state="shown"]').waitFor();
}));

test("an upload goes on while another job is looked at", { skip }, () => onMock({
  stage_ms: 50,
  fail: (method, path, nth) => (method === "POST" && path === "/api/v1/uploads" && nth > 6 && nth < 14 ? 503 : undefined),
}, async (page, mock) => {
  const start = async () => {
    await choose(page);
    await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  };
  await start();
  await page.locator(".job-head .badge.succeeded").waitFor();
  await page.getByRole("link", { name: "All jobs" }).click();
  await start();
  await page.getByText("Trying again").waitFor();
  await page.locator(".job-list a").first().click();
  await page.locator(".job-head .badge.succeeded").waitFor();
  const looked = page.url();
  for (let k = 0; k < 200 && mock.seen.get("POST /api/v1/jobs") < 2; k += 1) await page.waitForTimeout(100);
  await page.waitForTimeout(300);
  assert.equal(page.url(), looked, "the view is not taken away");
  await page.getByRole("link", { name: "All jobs" }).click();
  await page.locator(".job-list a").nth(1).waitFor();
  assert.equal(mock.datasets.size, 2);
  assert.equal(await page.getByText("Drop pictures or a folder here").count(), 1);
}));

test("options that are no JSON object are refused before anything is sent", { skip }, () => onMock({}, async (page, mock) => {
  await choose(page);
  await page.getByText("Options", { exact: true }).click();
  await page.fill("#option-json", "{ nonsense");
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.getByRole("alert").filter({ hasText: "not a JSON object" }).waitFor();
  assert.equal(mock.datasets.size, 0);
}));

test("progress reaches the page by polling where the event stream is blocked", { skip }, () => onMock({
  stage_ms: 600,
  fail: (method, path) => (path.endsWith("/events") ? 503 : undefined),
}, async (page) => {
  await choose(page);
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.locator(".badge.succeeded").waitFor({ timeout: 25000 });
}));

test("a running job can be stopped, and a finished one deleted", { skip }, () => onMock({ stage_ms: 400 }, async (page) => {
  await choose(page);
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.locator(".stages .running").waitFor();
  await page.getByRole("button", { name: "Stop" }).click();
  await page.locator(".job-head .badge.cancelled").waitFor();
  await page.getByRole("button", { name: "Delete" }).click();
  await page.getByRole("button", { name: "Keep it" }).click();
  await page.getByRole("button", { name: "Delete" }).click();
  await page.getByRole("dialog").getByRole("button", { name: "Delete" }).click();
  await page.getByText("None yet").waitFor();
}));

test("a build without the 3D code says so", { skip }, () => onMock({
  stage_ms: 50,
  fail: (method, path) => (path.includes("/vendor/") ? 404 : undefined),
}, async (page) => {
  await choose(page);
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.getByText("make page").waitFor();
  await page.getByRole("link", { name: "ply/0/points.ply" }).waitFor();
}));

test("a dropped folder is walked to the bottom", { skip }, () => onMock({}, async (page) => {
  const paths = await page.evaluate(async () => {
    const { fromDrop, Selection } = await import("/static/js/pick.js");
    const file = (name) => ({ isFile: true, name, file: (resolve) => resolve(new File(["x"], name)) });
    // A reader gives at most 100 entries a call, then none.
    const folder = (name, children) => ({ isFile: false, name, createReader: () => ({ readEntries: (resolve) => resolve(children.splice(0, 100)) }) });
    const deep = folder("b", [file("deep.JPG")]);
    const top = folder("a", [...Array.from({ length: 250 }, (_, k) => file(`${k}.jpg`)), deep]);
    const picked = await fromDrop({ items: [top, file("loose.tiff")].map((entry) => ({ webkitGetAsEntry: () => entry })), files: [] });
    const selection = new Selection();
    selection.add(picked);
    selection.add(picked);
    return [...selection.pictures.keys()];
  });
  assert.equal(paths.length, 252);
  assert.ok(paths.includes("a/b/deep.JPG") && paths.includes("a/249.jpg") && paths.includes("loose.tiff"));
}));

test("PLY files of every shape are read, and broken ones refused", { skip }, () => onMock({}, async (page) => {
  const results = await page.evaluate(async () => {
    const { parsePly } = await import("/static/js/viewer/ply.js");
    const bytes = (text, ...rest) => new Blob([text, ...rest]).arrayBuffer();
    const error = async (...parts) => {
      try {
        parsePly(await bytes(...parts));
        return null;
      } catch (problem) {
        return problem.message;
      }
    };
    const head = "ply\nformat binary_little_endian 1.0\ncomment made for a test\nelement vertex 2\nproperty double x\nproperty float y\nproperty short z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    const body = new DataView(new ArrayBuffer(34));
    [1.5, -2.5].forEach((x, k) => {
      body.setFloat64(17 * k, x, true);
      body.setFloat32(17 * k + 8, 0.25, true);
      body.setInt16(17 * k + 12, -7, true);
      [10, 20, 30].forEach((c, n) => body.setUint8(17 * k + 14 + n, c + k));
    });
    const binary = parsePly(await bytes(head, body.buffer));
    const ascii = parsePly(await bytes("ply\r\nformat ascii 1.0\r\nelement vertex 3\r\nproperty float x\r\nproperty float y\r\nproperty float z\r\nelement face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n0 0 0\r\n1 0 0\r\n0 1 0\r\n3 0 1 2\r\n"));
    return {
      positions: [...binary.positions], colors: [...binary.colors], comments: binary.comments,
      sides: [...ascii.lines], plain: ascii.colors,
      short: await error(head, body.buffer.slice(0, 30)), other: await error("hello"),
      big: await error(head.replace("little", "big"), body.buffer),
      loose: await error("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nelement edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n0 0 0\n0 5\n"),
    };
  });
  assert.deepEqual(results.positions, [1.5, 0.25, -7, -2.5, 0.25, -7]);
  assert.deepEqual(results.colors, [10, 20, 30, 11, 21, 31]);
  assert.deepEqual(results.comments, ["made for a test"]);
  assert.deepEqual(results.sides, [0, 1, 1, 2, 2, 0]);
  assert.equal(results.plain, null);
  assert.match(results.short, /cut short/);
  assert.match(results.other, /not a PLY/);
  assert.match(results.big, /binary_big_endian/);
  assert.match(results.loose, /not there/);
}));

for (const colorScheme of ["light", "dark"]) {
  test(`nothing stands in the way of assistive technology (${colorScheme})`, { skip }, () => onMock({ stage_ms: 300 }, async (page) => {
    assert.deepEqual(await axe(page), []);
    await choose(page);
    await page.getByText("Options", { exact: true }).click();
    assert.deepEqual(await axe(page), []);
    await page.getByRole("button", { name: "Upload and reconstruct" }).click();
    await page.locator(".stages .running").waitFor();
    assert.deepEqual(await axe(page), []);
    await page.locator('.viewer[data-state="shown"]').waitFor();
    await page.getByRole("button", { name: "all 6" }).click();
    await page.getByText("1 further file").click();
    assert.deepEqual(await axe(page), []);
    await page.getByRole("link", { name: "All jobs" }).click();
    await page.locator(".job-list a").waitFor();
    assert.deepEqual(await axe(page), []);
  }, { colorScheme }));
}

test("the page fits a narrow screen", { skip }, () => onMock({ stage_ms: 50 }, async (page) => {
  const wider = () => page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
  assert.equal(await wider(), 0);
  await choose(page);
  assert.equal(await wider(), 0);
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.locator('.viewer[data-state="shown"]').waitFor();
  await page.getByRole("link", { name: "report.json" }).waitFor();
  assert.equal(await wider(), 0);
}, { viewport: { width: 320, height: 640 } }));
