// The real service, on a free port and a data directory of its own.
import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { createServer } from "node:net";
import { fileURLToPath } from "node:url";

const BINARY = process.env.MULTISTAGE_BIN ?? fileURLToPath(new URL("../../target/debug/multistage", import.meta.url));

const freePort = () => new Promise((resolve, reject) => {
  const probe = createServer();
  probe.on("error", reject);
  probe.listen(0, "127.0.0.1", () => {
    const { port } = probe.address();
    probe.close(() => resolve(port));
  });
});

/** Starts it and waits until it is ready. */
export async function startService(data) {
  let log = "";
  const port = await freePort();
  const url = `http://127.0.0.1:${port}/`;
  const service = spawn(BINARY, ["serve", "--bind", `127.0.0.1:${port}`, "--data-dir", data], { stdio: ["ignore", "pipe", "pipe"] });
  for (const stream of [service.stdout, service.stderr]) stream.on("data", (text) => { log += text; });
  let ended = false;
  service.on("exit", () => { ended = true; });
  service.on("error", (error) => { ended = true; log += error; });
  for (const deadline = Date.now() + 30_000; ; ) {
    if (await fetch(`${url}readyz`).then((answer) => answer.ok, () => false)) break;
    assert.ok(!ended && Date.now() < deadline, `the service did not come up: ${log}`);
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  const stop = async () => {
    if (service.exitCode !== null) return;
    const gone = new Promise((resolve) => service.on("exit", resolve));
    service.kill("SIGTERM");
    await gone;
  };
  return { port, url, stop };
}
