// The page on the real service: photographs in by the page, model on the canvas, files out.
import assert from "node:assert/strict";
import { existsSync } from "node:fs";
import { mkdtemp, readFile, readdir, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { fileURLToPath } from "node:url";
import { distinctColours, noBrowser, openBrowser, openPage } from "./browser.mjs";
import { startService } from "./service.mjs";

const PHOTOGRAPHS = fileURLToPath(new URL("../../../shared/datasets/bundler-et/images/", import.meta.url));
/** The photographs are small and few; a busy machine is slow. */
const MODEL_TIMEOUT_MS = 240_000;

const skip = noBrowser || (existsSync(PHOTOGRAPHS) ? false : `the photographs of ${PHOTOGRAPHS} are absent`);

let browser;
let service;
let data;
let url;

before(async () => {
  if (skip) return;
  data = await mkdtemp(join(tmpdir(), "multistage-service-"));
  service = await startService(data);
  ({ url } = service);
  browser = await openBrowser();
});
after(async () => {
  await browser?.close();
  await service?.stop();
  if (data) await rm(data, { recursive: true, force: true });
});

test("photographs become a model on the page, and its points can be downloaded", { skip, timeout: MODEL_TIMEOUT_MS + 60_000 }, async () => {
  const { page, errors } = await openPage(browser, url);
  await page.setInputFiles("#pick-folder", PHOTOGRAPHS);
  const pictures = (await readdir(PHOTOGRAPHS)).filter((name) => name.endsWith(".jpg")).length;
  await page.getByRole("heading", { name: `${pictures} pictures` }).waitFor();
  await page.fill("#job-name", "E. T.");
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();

  await page.locator(".stages li").first().waitFor({ timeout: 30_000 });
  await page.locator(".overall progress").waitFor();
  await page.locator(".job-head .badge.succeeded, .job-head .badge.failed").waitFor({ timeout: MODEL_TIMEOUT_MS });
  assert.equal(await page.locator(".job-head .badge").textContent(), "finished", await page.locator("main").innerText());
  assert.equal(await page.locator(".stages li.done").count(), await page.locator(".stages li").count());

  await page.locator('.viewer[data-state="shown"]').waitFor({ timeout: 30_000 });
  const points = Number((await page.locator(".facts div").nth(1).locator("dd").textContent()).replaceAll(",", ""));
  assert.ok(points > 500, `only ${points} points`);
  await page.waitForTimeout(500);
  const canvas = page.locator("canvas");
  const withCameras = await distinctColours(page, canvas);
  assert.ok(withCameras > 300, `the canvas shows only ${withCameras} colours`);
  const before = (await canvas.screenshot()).toString("base64");
  await page.uncheck("#show-cameras");
  await page.waitForTimeout(300);
  assert.notEqual((await canvas.screenshot()).toString("base64"), before, "cameras are drawn");
  if (process.env.MULTISTAGE_SCREENSHOTS) {
    await page.check("#show-cameras");
    await page.screenshot({ path: join(process.env.MULTISTAGE_SCREENSHOTS, "service.png"), fullPage: true });
  }

  await page.getByRole("button", { name: /^all / }).click();
  await page.locator(".verdicts li").nth(pictures - 1).waitFor();
  await page.waitForFunction(() => [...document.querySelectorAll(".verdicts img")].slice(0, 3).every((image) => image.complete && image.naturalWidth > 1));

  const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("link", { name: "ply/0/points.ply" }).click()]);
  assert.equal(download.suggestedFilename(), "points.ply");
  const file = await readFile(await download.path());
  assert.match(file.subarray(0, 400).toString("latin1"), new RegExp(`^ply\\nformat binary_little_endian 1.0\\n[^]*element vertex ${points}\\n`));

  // The viewer names the picture behind a frustum by its place in cameras.ply: that must be the order of the paths.
  const [named, ordered] = await page.evaluate(async () => {
    const { parsePly } = await import("/static/js/viewer/ply.js");
    const folder = `/api/v1/jobs/${location.hash.split("/").pop()}/outputs`;
    const { positions } = parsePly(await (await fetch(`${folder}/ply/0/cameras.ply`)).arrayBuffer());
    const lines = (await (await fetch(`${folder}/sparse/0/images.txt`)).text()).split("\n").filter((line) => !line.startsWith("#"));
    // Every other line is an image: id, quaternion w x y z, translation, camera, name. The centre is -R^T t.
    const centres = lines.filter((line, k) => k % 2 === 0 && line !== "").map((line) => {
      const words = line.split(" ");
      const [w, x, y, z, a, b, c] = words.slice(1, 8).map(Number);
      const transposed = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
      ];
      return { name: words.slice(9).join(" "), centre: transposed.map((row) => -(row[0] * a + row[1] * b + row[2] * c)) };
    });
    centres.sort((p, q) => (p.name < q.name ? -1 : 1));
    return [centres.map(({ centre }) => centre), centres.map((_, k) => [...positions.slice(15 * k, 15 * k + 3)])];
  });
  assert.equal(named.length, pictures);
  named.forEach((centre, k) => centre.forEach((value, axis) => assert.ok(Math.abs(value - ordered[k][axis]) < 1e-4 * (1 + Math.abs(value)), `camera ${k}`)));
  assert.deepEqual(errors, []);
  await page.close();
});

test("a job of pictures that show nothing fails with a sentence and verdicts", { skip, timeout: 120_000 }, async () => {
  const { page, errors } = await openPage(browser, url);
  // Three broken pictures: the service must say so, not the browser.
  await page.setInputFiles("#pick-files", ["a", "b", "c"].map((name) => ({ name: `${name}.jpg`, mimeType: "image/jpeg", buffer: Buffer.from(`no picture ${name}`) })));
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
  await page.locator(".job-head .badge.failed").waitFor({ timeout: 60_000 });
  await page.getByText("No model came of these pictures").waitFor();
  await page.locator(".verdicts .badge.rejected").nth(2).waitFor();
  assert.deepEqual(errors, []);
  await page.close();
});
