// The service's answers as values, and its problems (RFC 9457) as errors.

const API = "api/v1";

export const isOver = (job) => job.state === "succeeded" || job.state === "failed" || job.state === "cancelled";

/** A problem that the service described, or that it could not be reached (status 0). */
export class Problem extends Error {
  constructor(status, code, message, errors = []) {
    super(message);
    this.status = status;
    this.code = code;
    this.errors = errors;
  }

  /** Whether the same request may succeed later. */
  get passing() {
    return this.status === 0 || this.status === 408 || this.status === 429 || (this.status >= 500 && this.code !== "disk_full");
  }
}

export const unreachable = () => new Problem(0, "unreachable", "The service can't be reached.");

/** The problem in a response's body. */
export function problemOf(status, text) {
  try {
    const body = JSON.parse(text);
    return new Problem(status, body.code ?? "unknown", body.detail ?? body.title ?? `The service answered ${status}.`, body.errors ?? []);
  } catch {
    return new Problem(status, "unknown", `The service answered ${status}.`);
  }
}

async function request(method, url, json) {
  let response;
  try {
    response = await fetch(url, {
      method,
      headers: json === undefined ? {} : { "content-type": "application/json" },
      body: json === undefined ? undefined : JSON.stringify(json),
    });
  } catch {
    throw unreachable();
  }
  const text = await response.text();
  if (!response.ok) throw problemOf(response.status, text);
  return text ? JSON.parse(text) : null;
}

const page = (cursor, limit, more = {}) => new URLSearchParams({ limit, ...(cursor ? { cursor } : {}), ...more });

export const listJobs = (cursor, limit = 30) => request("GET", `${API}/jobs?${page(cursor, limit)}`);
export const getJob = (id) => request("GET", `${API}/jobs/${encodeURIComponent(id)}`);
export const createJob = (body) => request("POST", `${API}/jobs`, body);
export const deleteJob = (job) => request("DELETE", job.links.self);
export const cancelJob = (job) => request("POST", job.links.cancel);
export const resumeJob = (job) => request("POST", job.links.resume);
export const jobImages = (job, cursor, state, limit = 60) => request("GET", `${job.links.images}?${page(cursor, limit, state ? { state } : {})}`);
export const jobOutputs = (job) => request("GET", job.links.outputs);
export const jobReport = (job) => request("GET", `${job.links.outputs}/report.json`);
export const createDataset = (name) => request("POST", `${API}/datasets`, { name });
export const getDataset = (id) => request("GET", `${API}/datasets/${encodeURIComponent(id)}`);
export const datasetImages = (dataset, cursor, limit = 1000) => request("GET", `${dataset.links.images}?${page(cursor, limit)}`);
export const deleteDataset = (dataset) => request("DELETE", dataset.links.self);
