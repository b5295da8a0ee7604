// Sends a selection to a new dataset, in batches that are each safe to repeat: what was stored before is recognised by the
// service, so a batch whose answer was lost is simply sent again.

import { Problem, createDataset, deleteDataset, problemOf, unreachable } from "./api.js";

/** A request carries at most this many files ... */
const BATCH_FILES = 50;
/** ... and, unless a single file is larger, this many bytes: small enough that a repeated one costs little. */
const BATCH_BYTES = 64e6;
/** Waits before the 2nd, 3rd, ... attempt, in seconds. */
const RETRY_WAITS_S = [1, 2, 4, 8, 15, 30, 30, 30];

/** @returns {{part: string, path: string, file: File}[][]} */
export function batches(selection) {
  const all = [];
  let batch = [];
  let size = 0;
  for (const [path, file] of selection.named) {
    if (batch.length > 0 && (batch.length >= BATCH_FILES || size + file.size > BATCH_BYTES)) {
      all.push(batch);
      batch = [];
      size = 0;
    }
    batch.push({ part: "images", path, file });
    size += file.size;
  }
  if (batch.length > 0) all.push(batch);
  for (const [path, file] of selection.archives) all.push([{ part: "archive", path, file }]);
  return all;
}

export class Upload {
  /**
   * @param {import("./pick.js").Selection} selection
   * @param {string} name
   * @param {(progress: {sent: number, total: number, files: number, waiting: string|null}) => void} onprogress
   */
  constructor(selection, name, onprogress) {
    this.name = name;
    this.onprogress = onprogress;
    this.batches = batches(selection);
    this.total = selection.bytes;
    this.sent = 0;
    this.files = 0;
    this.next = 0;
    this.dataset = null;
    this.xhr = null;
    this.stopped = false;
  }

  /** Runs to the end; after a failure it may be called again and goes on where it was. Resolves to the dataset. */
  async run() {
    this.dataset ??= await this.persist(() => createDataset(this.name));
    while (this.next < this.batches.length) {
      const batch = this.batches[this.next];
      await this.persist(() => this.send(batch));
      this.sent += batch.reduce((sum, { file }) => sum + file.size, 0);
      this.files += batch.length;
      this.next += 1;
      this.report(0, null);
    }
    return this.dataset;
  }

  /** Stops and removes what was sent. */
  async cancel() {
    this.stopped = true;
    this.xhr?.abort();
    if (this.dataset) await deleteDataset(this.dataset).catch(() => {});
  }

  report(loaded, waiting) {
    this.onprogress({ sent: Math.min(this.total, this.sent + loaded), total: this.total, files: this.files, waiting });
  }

  async persist(action) {
    for (let attempt = 0; ; attempt += 1) {
      try {
        return await action();
      } catch (problem) {
        const wait_s = RETRY_WAITS_S[attempt];
        if (this.stopped || !(problem instanceof Problem) || !problem.passing || wait_s === undefined) throw problem;
        this.report(0, `${problem.message} Trying again in ${wait_s} s.`);
        await new Promise((resolve) => setTimeout(resolve, wait_s * 1000));
        if (this.stopped) throw problem;
      }
    }
  }

  /** One batch. XMLHttpRequest, because fetch does not tell how much of a body has been sent. */
  send(batch) {
    return new Promise((resolve, reject) => {
      const form = new FormData();
      for (const { part, path, file } of batch) form.append(part, file, path);
      const xhr = new XMLHttpRequest();
      this.xhr = xhr;
      xhr.open("POST", this.dataset.links.images);
      xhr.upload.onprogress = (event) => {
        const size = batch.reduce((sum, { file }) => sum + file.size, 0);
        this.report(event.total > 0 ? (size * event.loaded) / event.total : 0, null);
      };
      xhr.onload = () => {
        if (xhr.status >= 200 && xhr.status < 300) resolve();
        else reject(problemOf(xhr.status, xhr.responseText));
      };
      xhr.onerror = () => reject(unreachable());
      xhr.onabort = () => reject(new Problem(0, "stopped", "The upload was stopped."));
      xhr.send(form);
    });
  }
}
