// Photographs go up through a line that breaks, and through a reload of the page: they arrive whole, and go on where they stopped.
import assert from "node:assert/strict";
import { createHash, randomFillSync } from "node:crypto";
import { mkdir, mkdtemp, rm, writeFile } from "node:fs/promises";
import { connect, createServer } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { noBrowser, openBrowser, openPage } from "./browser.mjs";
import { startService } from "./service.mjs";

const skip = noBrowser;
const PHOTOGRAPHS = 5;
const BYTES = 10e6;
const ALL_BYTES = PHOTOGRAPHS * BYTES;

let browser;
let service;
let scratch;
let folder;
const sums = new Map();
const lines = [];

before(async () => {
  if (skip) return;
  scratch = await mkdtemp(join(tmpdir(), "multistage-upload-"));
  folder = join(scratch, "survey");
  await mkdir(folder);
  for (let k = 0; k < PHOTOGRAPHS; k += 1) {
    const bytes = randomFillSync(Buffer.alloc(BYTES));
    await writeFile(join(folder, `picture ${k} \u00e9.jpg`), bytes);
    sums.set(`picture ${k} \u00e9.jpg`, createHash("sha256").update(bytes).digest("hex"));
  }
  service = await startService(join(scratch, "data"));
  browser = await openBrowser();
});
after(async () => {
  for (const line of lines) line.close();
  await browser?.close();
  await service?.stop();
  if (scratch) await rm(scratch, { recursive: true, force: true });
});

/** A line to the service that counts what goes up, cuts a connection after so many bytes of it, and lets no more than a rate through. */
async function badLine({ cuts = 0, cut_bytes = 4e6, bytes_per_s = Infinity }) {
  const line = { up: 0, cut: 0, resumed: 0, url: "" };
  const sockets = new Set();
  const server = createServer((client) => {
    const upstream = connect(service.port, "127.0.0.1");
    for (const socket of [client, upstream]) sockets.add(socket);
    let sent = 0;
    client.on("data", (chunk) => {
      line.up += chunk.length;
      // Heads are small and come at the beginning of what is read; photographs are noise.
      if (/^PATCH [^]*\r\nupload-offset: *[1-9]/i.test(chunk.toString("latin1"))) line.resumed += 1;
      sent += chunk.length;
      upstream.write(chunk);
      if (sent > cut_bytes && line.cut < cuts) {
        line.cut += 1;
        // What came this far goes on; the rest is the sender's to bring again.
        upstream.end();
        client.destroy();
      } else if (bytes_per_s < Infinity) {
        client.pause();
        setTimeout(() => client.resume(), (1000 * chunk.length) / bytes_per_s);
      }
    });
    upstream.on("data", (chunk) => client.destroyed || client.write(chunk));
    for (const [one, other] of [[client, upstream], [upstream, client]]) {
      one.on("error", () => other.destroy());
      one.on("end", () => other.end());
      one.on("close", () => other.end());
    }
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  line.url = `http://127.0.0.1:${server.address().port}/`;
  line.close = () => {
    server.close();
    for (const socket of sockets) socket.destroy();
  };
  lines.push(line);
  return line;
}

async function choose(page) {
  await page.setInputFiles("#pick-folder", folder);
  await page.getByRole("heading", { name: `${PHOTOGRAPHS} pictures` }).waitFor();
  await page.getByRole("button", { name: "Upload and reconstruct" }).click();
}

/** The job's photographs are the files, byte for byte; then everything goes. */
async function check(page) {
  await page.locator(".job-head .badge").waitFor({ timeout: 90_000 });
  const ask = async (path) => (await fetch(new URL(path, service.url))).json();
  const job = await ask(`/api/v1/jobs/${page.url().split("/").pop()}`);
  const { images } = await ask(`/api/v1/datasets/${job.dataset_id}/images`);
  assert.deepEqual(new Map(images.map((image) => [image.path, image.sha256])), sums);
  assert.equal((await ask("/api/v1/datasets")).datasets.length, 1, "one dataset was made");
  assert.equal(await page.evaluate(() => Object.keys(localStorage).length), 0, "nothing is remembered of what is over");
  for (let state = job.state; !["succeeded", "failed", "cancelled"].includes(state); ) {
    await fetch(new URL(job.links.cancel, service.url), { method: "POST" });
    await new Promise((resolve) => setTimeout(resolve, 100));
    ({ state } = await ask(job.links.self));
  }
  await fetch(new URL(job.links.self, service.url), { method: "DELETE" });
  await fetch(new URL(job.links.dataset, service.url), { method: "DELETE" });
}

test("a line that breaks again and again does not begin anew", { skip, timeout: 150_000 }, async () => {
  const line = await badLine({ cuts: 6 });
  const { page, errors } = await openPage(browser, line.url);
  await choose(page);
  await page.locator(".under-way progress").first().waitFor();
  await page.getByText("Trying again in").first().waitFor();
  await check(page);
  assert.equal(line.cut, 6);
  // How much is on its way when a line breaks, and so lost, is the system's matter; but what had arrived is built upon.
  assert.ok(line.resumed >= 1, "no photograph went on at a byte beyond its first");
  assert.deepEqual(errors, []);
  await page.close();
});

test("after a reload the same folder goes on where it stopped", { skip, timeout: 150_000 }, async () => {
  const line = await badLine({ bytes_per_s: 4e6 });
  const { page, errors } = await openPage(browser, line.url);
  page.on("dialog", (dialog) => dialog.accept());
  await choose(page);
  while (line.up < 0.55 * ALL_BYTES) await page.waitForTimeout(50);
  await page.reload();
  await choose(page);
  await check(page);
  // Whoever began anew would send again all that had gone up; what was on its way at the reload is lost in any case.
  const again = line.up - ALL_BYTES;
  assert.ok(again < 0.3 * ALL_BYTES, `${again} bytes too many went up`);
  assert.deepEqual(errors, []);
  await page.close();
});
