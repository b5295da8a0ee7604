// A stand-in for the service, for work on the page and for what the real one does too seldom to be tested on it: requests that
// fail on the way, slow stages, several models. It keeps to openapi.yaml. Run by itself it prints its address:
//     node tests/page/mock.mjs
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";

const STATIC = fileURLToPath(new URL("../../static", import.meta.url));
const TYPES = { ".html": "text/html; charset=utf-8", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml" };
const PLAN = [["intake", null, 20], ["features", null, 20], ["coarse_match", null, 190], ["coarse_model", null, 20], ["add_cameras", 1, 6], ["add_points", 1, 80], ["add_cameras", 2, 2], ["add_points", 2, 80], ["refine", null, null], ["export", null, 6]];
const VERDICTS = [
  { state: "unregistered", reason: "no_matching_image", advice: "It shows nothing that another photograph shows as well. If it belongs here, add photographs taken between it and its neighbours." },
  { state: "rejected", reason: "unreadable", advice: "The file is cut short. Copy it from the camera again." },
];

/**
 * @param {{stage_ms?: number, fail?: (method: string, path: string, nth: number) => number|"drop"|undefined, models?: number}} [options]
 *   `fail` may answer the nth request to a path with a status, or drop its connection
 */
export async function startMock({ stage_ms = 300, fail = () => undefined, models = 1 } = {}) {
  const datasets = new Map();
  const uploads = new Map();
  const jobs = new Map();
  const seen = new Map();
  const id = () => crypto.randomUUID();

  const datasetBody = (d) => ({ id: d.id, name: d.name, created_at: d.created_at, images: d.files.size, size_bytes: 1000 * d.files.size, links: { self: `/api/v1/datasets/${d.id}`, images: `/api/v1/datasets/${d.id}/images` } });
  const jobBody = (j) => {
    const self = `/api/v1/jobs/${j.id}`;
    const stage = j.stages.find((s) => s.state === "running");
    return {
      id: j.id, name: j.name, state: j.state, cancel_requested: j.cancel_requested, created_at: j.created_at, started_at: j.started_at, finished_at: j.finished_at, dataset_id: j.dataset.id, options: j.options,
      images: { uploaded: j.dataset.files.size, ignored: null, ...(j.state === "succeeded" ? { registered: Math.max(0, j.dataset.files.size - 2), unregistered: 1, rejected: 1 } : { registered: null, unregistered: null, rejected: null }) },
      stage: stage ? { name: stage.name, iteration: stage.iteration, done: stage.done, total: stage.total } : null,
      stages: j.stages, eta_s: j.state === "running" ? { low: 20, high: 70 } : null,
      models: j.state === "succeeded" ? Array.from({ length: models }, (_, k) => ({ id: k, images: Math.max(0, j.dataset.files.size - 2), points: 30000, points_3plus: 21000, observations: 98000, mean_track_length: 3.27, mean_reprojection_error_px: 0.61, median_reprojection_error_px: 0.48, links: { points: `${self}/outputs/ply/${k}/points.ply`, cameras: `${self}/outputs/ply/${k}/cameras.ply` } })) : [],
      error: j.error, links: { self, events: `${self}/events`, cancel: `${self}/cancel`, resume: `${self}/resume`, images: `${self}/images`, outputs: `${self}/outputs`, archive: `${self}/outputs.zip`, report: `${self}/outputs/report.html`, dataset: `/api/v1/datasets/${j.dataset.id}` },
    };
  };
  const tell = (job, event, data, stored = true) => {
    const entry = { id: stored ? job.log.length + 1 : null, event, data };
    if (stored) job.log.push(entry);
    for (const response of job.listeners) write(response, entry);
  };
  const write = (response, { id: n, event, data }) => response.write(`${n ? `id: ${n}\n` : ""}event: ${event}\ndata: ${JSON.stringify(data)}\n\n`);

  async function work(job) {
    const now = () => new Date().toISOString();
    const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
    const state = (value) => {
      job.state = value;
      tell(job, "state", { state: value, at: now(), error: job.error });
    };
    await pause(stage_ms / 2);
    job.started_at = now();
    job.stages = PLAN.map(([name, iteration, total]) => ({ name, iteration, state: "pending", done: 0, total, started_at: null, finished_at: null, wall_s: null, cpu_s: null, counts: {} }));
    state("running");
    for (const stage of job.stages) {
      Object.assign(stage, { state: "running", started_at: now() });
      tell(job, "stage", stage);
      for (let k = 1; k <= 5 && !job.cancel_requested; k += 1) {
        await pause(stage_ms / 5);
        stage.done = Math.round(((stage.total ?? 0) * k) / 5);
        tell(job, "progress", { stage: { name: stage.name, iteration: stage.iteration, done: stage.done, total: stage.total }, eta_s: { low: 20, high: 70 } }, false);
      }
      if (job.cancel_requested) break;
      Object.assign(stage, { state: "done", finished_at: now(), wall_s: stage_ms / 1000, cpu_s: stage_ms / 500, counts: { pairs_tried: 190, points_after: 30000 } });
      tell(job, "stage", stage);
    }
    job.finished_at = now();
    state(job.cancel_requested ? "cancelled" : "succeeded");
    for (const response of job.listeners) response.end();
    job.listeners.clear();
  }

  /** As much of tus as a page needs: announce, ask, bring. */
  function tus(request, response, path, body, problem) {
    response.setHeader("tus-resumable", "1.0.0");
    const bring = (upload) => {
      upload.offset += body.length;
      if (upload.offset === upload.length) datasets.get(upload.dataset).files.add(upload.path);
      response.setHeader("upload-offset", upload.offset);
    };
    if (request.method === "POST") {
      const metadata = Object.fromEntries(request.headers["upload-metadata"].split(",").map((pair) => {
        const [key, value] = pair.split(" ");
        return [key, Buffer.from(value, "base64").toString()];
      }));
      const upload = { id: id(), length: Number(request.headers["upload-length"]), offset: 0, ...metadata };
      uploads.set(upload.id, upload);
      bring(upload);
      return response.setHeader("location", `/api/v1/uploads/${upload.id}`).writeHead(201).end();
    }
    const upload = uploads.get(path.split("/").pop());
    if (!upload) return problem(404, "upload_not_found", "There is no such upload.");
    if (request.method === "PATCH") bring(upload);
    return response.setHeader("upload-length", upload.length).setHeader("upload-offset", upload.offset).writeHead(request.method === "PATCH" ? 204 : 200).end();
  }

  const server = createServer(async (request, response) => {
    const url = new URL(request.url, "http://mock");
    const path = decodeURIComponent(url.pathname);
    const key = `${request.method} ${path.replace(/[0-9a-f-]{36}/, "*")}`;
    seen.set(key, (seen.get(key) ?? 0) + 1);
    const broken = fail(request.method, path, seen.get(key));
    if (broken === "drop") {
      request.socket.destroy();
      return;
    }
    const body = await new Promise((resolve) => {
      const parts = [];
      request.on("data", (part) => parts.push(part));
      request.on("end", () => resolve(Buffer.concat(parts)));
    });
    const json = (status, value) => response.writeHead(status, { "content-type": "application/json" }).end(value === undefined ? "" : JSON.stringify(value));
    const problem = (status, code, detail) => response.writeHead(status, { "content-type": "application/problem+json" }).end(JSON.stringify({ type: "about:blank", title: code, status, code, detail, request_id: "0" }));
    const send = (type, bytes) => response.writeHead(200, { "content-type": type, "content-length": bytes.length }).end(bytes);
    response.setHeader("content-security-policy", "default-src 'self'; img-src 'self' data: blob:; style-src 'self'");
    if (broken) return problem(broken, "not_ready", "The service is busy.");

    let m;
    if (path === "/" || path.startsWith("/static/")) {
      const file = path === "/" ? "index.html" : normalize(path.slice("/static/".length));
      try {
        return send(TYPES[extname(file)] ?? "application/octet-stream", await readFile(join(STATIC, file)));
      } catch {
        return problem(404, "not_found", "There is nothing at this address.");
      }
    }
    if (path === "/api/v1/datasets" && request.method === "POST") {
      const dataset = { id: id(), name: JSON.parse(body).name ?? "", created_at: new Date().toISOString(), files: new Set() };
      datasets.set(dataset.id, dataset);
      return json(201, datasetBody(dataset));
    }
    if ((m = path.match(/^\/api\/v1\/datasets\/([^/]+)(\/images)?$/))) {
      const dataset = datasets.get(m[1]);
      if (!dataset) return problem(404, "dataset_not_found", "There is no such dataset.");
      if (request.method === "DELETE") {
        datasets.delete(m[1]);
        return response.writeHead(204).end();
      }
      if (request.method === "GET") return json(200, { images: [...dataset.files].sort().map((file) => ({ path: file, size_bytes: 1000, sha256: "0".repeat(64) })), next_cursor: null });
      const before = dataset.files.size;
      const names = [...body.toString("latin1").matchAll(/name="images"; filename="([^"]*)"/g)].map((found) => Buffer.from(found[1], "latin1").toString());
      for (const name of names) dataset.files.add(name);
      return json(200, { stored: dataset.files.size - before, unchanged: names.length - (dataset.files.size - before), ignored: [], dataset: datasetBody(dataset) });
    }
    if (path.startsWith("/api/v1/uploads")) return tus(request, response, path, body, problem);
    if (path === "/api/v1/jobs") {
      if (request.method === "GET") return json(200, { jobs: [...jobs.values()].reverse().map(jobBody), next_cursor: null });
      const given = JSON.parse(body);
      const job = { id: id(), name: given.name ?? "", state: "queued", cancel_requested: false, created_at: new Date().toISOString(), started_at: null, finished_at: null, dataset: datasets.get(given.dataset_id), options: given.options ?? {}, stages: [], error: null, log: [], listeners: new Set() };
      jobs.set(job.id, job);
      work(job);
      response.setHeader("location", `/api/v1/jobs/${job.id}`);
      return json(202, jobBody(job));
    }
    if ((m = path.match(/^\/api\/v1\/jobs\/([^/]+)(.*)$/))) {
      const job = jobs.get(m[1]);
      if (!job) return problem(404, "job_not_found", "There is no job with this id.");
      const files = job.dataset.files;
      const over = job.state === "succeeded";
      const rest = m[2];
      if (rest === "" && request.method === "DELETE") {
        jobs.delete(job.id);
        return response.writeHead(204).end();
      }
      if (rest === "") return json(200, jobBody(job));
      if (rest === "/cancel") {
        job.cancel_requested = true;
        return json(202, jobBody(job));
      }
      if (rest === "/events") {
        response.writeHead(200, { "content-type": "text/event-stream", "cache-control": "no-store" });
        for (const entry of job.log) write(response, entry);
        job.listeners.add(response);
        request.on("close", () => job.listeners.delete(response));
        return undefined;
      }
      if (rest === "/images") {
        const all = [...files].sort().map((name, n) => ({ n, name, size_bytes: 1000, sha256: "0".repeat(64), width: 1200, height: 900, features: 8211, ...(over && files.size - n <= 2 ? { ...VERDICTS[files.size - n - 1], model: null, registered_in: null, inliers: null, mean_reprojection_error_px: null, focal_px: null } : { state: over ? "registered" : "pending", model: 0, registered_in: n % 3 ? "coarse_model" : "add_cameras/1", inliers: 2011, mean_reprojection_error_px: 0.61, focal_px: 1400, reason: null, advice: null }), links: { thumbnail: `/api/v1/jobs/${job.id}/images/${n}/thumbnail` } }));
        const state = url.searchParams.get("state");
        const asked = all.filter((image) => !state || image.state === state);
        const from = Number(url.searchParams.get("cursor") ?? 0);
        const to = from + Number(url.searchParams.get("limit") ?? 100);
        return json(200, { images: asked.slice(from, to), total: asked.length, next_cursor: to < asked.length ? String(to) : null });
      }
      if (rest.endsWith("/thumbnail")) {
        const n = Number(rest.split("/")[2]);
        const [width, height] = n % 2 ? [240, 320] : [320, 240];
        return send("image/svg+xml", Buffer.from(`<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}" viewBox="0 0 320 240" preserveAspectRatio="xMidYMid slice"><rect width="320" height="240" fill="hsl(${(n * 47) % 360} 25% 65%)"/><path d="M0 200 90 110l60 50 80-90 90 130v40H0z" fill="hsl(${(n * 47) % 360} 20% 42%)"/></svg>`));
      }
      const outputs = { "ply/0/cameras.ply": () => camerasPly(Math.max(0, files.size - 2)), "ply/0/points.ply": pointsPly, "ply/1/cameras.ply": () => camerasPly(Math.max(0, files.size - 2)), "ply/1/points.ply": pointsPly, "report.html": () => Buffer.from("<!doctype html><title>Report</title>"), "report.json": () => Buffer.from(JSON.stringify({ notes: ["The scale is arbitrary: no photograph says where it was taken."] })), "sparse/0/images.bin": () => Buffer.alloc(5000) };
      if (rest === "/outputs") {
        const list = Object.entries(outputs).filter(([file]) => models > 1 || !file.startsWith("ply/1")).map(([file, make]) => ({ path: file, size_bytes: make().length, media_type: "application/octet-stream", etag: '"0"', links: { self: `/api/v1/jobs/${job.id}/outputs/${file}` } }));
        return json(200, { files: over ? list : [], total_bytes: list.reduce((sum, f) => sum + f.size_bytes, 0), links: { archive: `/api/v1/jobs/${job.id}/outputs.zip` } });
      }
      const output = outputs[rest.slice("/outputs/".length)];
      if (output) return send(rest.endsWith(".html") ? "text/html" : "application/octet-stream", output());
      return problem(404, "output_not_found", "There is no such file.");
    }
    return problem(404, "not_found", "There is nothing at this address.");
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  const port = server.address().port;
  return { url: `http://127.0.0.1:${port}/`, port, seen, datasets, close: () => new Promise((resolve) => { server.closeAllConnections(); server.close(resolve); }) };
}

const PLY_HEAD = (elements) => Buffer.from(`ply\nformat binary_little_endian 1.0\n${elements}end_header\n`);

/** A colonnade of points, z up. */
function pointsPly() {
  const n = 30000;
  const rows = Buffer.alloc(15 * n);
  let seed = 1;
  const random = () => (seed = (seed * 48271) % 2147483647) / 2147483647;
  for (let i = 0; i < n; i += 1) {
    let [x, y, z] = [12 * random() - 6, 8 * random() - 4, 0];
    let tint = [150 + 30 * random(), 140 + 30 * random(), 110 + 20 * random()];
    if (i % 3 > 0) {
      const k = i % 16;
      const angle = 6.283 * random();
      const stripe = Math.round(8 * angle) % 2;
      x = ((k % 8) - 3.5) * 1.4 + 0.3 * Math.cos(angle);
      y = (k < 8 ? -3 : 3) + 0.3 * Math.sin(angle);
      z = 4 * random();
      tint = [200 - 25 * stripe, 180 - 25 * stripe, 145 - 20 * stripe + 20 * random()];
    } else if (i % 9 === 0) {
      z = 4 + 1.6 * (1 - Math.abs(y) / 4) * random();
      tint = [170, 95 + 40 * random(), 70];
    }
    rows.writeFloatLE(x, 15 * i);
    rows.writeFloatLE(y, 15 * i + 4);
    rows.writeFloatLE(z, 15 * i + 8);
    tint.forEach((value, k) => rows.writeUInt8(Math.floor(value), 15 * i + 12 + k));
  }
  return Buffer.concat([PLY_HEAD(`element vertex ${n}\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n`), rows]);
}

/** n frusta in a ring round it. */
function camerasPly(n) {
  const vertices = Buffer.alloc(12 * 5 * n);
  const edges = Buffer.alloc(8 * 8 * n);
  for (let c = 0; c < n; c += 1) {
    const angle = (6.283 * c) / n;
    const forward = [-Math.cos(angle), -Math.sin(angle)];
    const apex = [12 * Math.cos(angle), 11 * Math.sin(angle), 2.5];
    const corners = [apex, ...[[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([u, v]) => [apex[0] + forward[0] - 0.6 * u * forward[1], apex[1] + forward[1] + 0.6 * u * forward[0], apex[2] + 0.45 * v])];
    corners.forEach((corner, k) => corner.forEach((value, a) => vertices.writeFloatLE(value, 12 * (5 * c + k) + 4 * a)));
    [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]].forEach((edge, k) => edge.forEach((value, a) => edges.writeInt32LE(5 * c + value, 8 * (8 * c + k) + 4 * a)));
  }
  return Buffer.concat([PLY_HEAD(`element vertex ${5 * n}\nproperty float x\nproperty float y\nproperty float z\nelement edge ${8 * n}\nproperty int vertex1\nproperty int vertex2\n`), vertices, edges]);
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  const mock = await startMock({ stage_ms: 1500 });
  console.log(mock.url);
}
