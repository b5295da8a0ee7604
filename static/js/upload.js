// Sends a selection to a new dataset. Photographs go one by one by tus, so that one whose connection broke goes on at its last byte,
// after a reload of the page too, once the same folder is chosen again. Archives go whole, as does everything where the page was
// built without the code for tus; what was stored before is recognised by the service, so they are simply sent again.

import { Problem, createDataset, datasetImages, deleteDataset, getDataset, problemOf, unreachable } from "./api.js";

/** Photographs under way at once. */
const PARALLEL = 4;
/** Up to this many bytes a photograph comes along with the request that announces it: one round trip instead of two. */
const AT_ONCE_BYTES = 512e3;
/** A form carries at most this many files ... */
const BATCH_FILES = 50;
/** ... and, unless a single file is larger, this many bytes: small enough that a repeated one costs little. */
const BATCH_BYTES = 64e6;
/** Waits before the 2nd, 3rd, ... attempt, in seconds. */
const RETRY_WAITS_S = [1, 2, 4, 8, 15, 30, 30, 30];
/** Where the browser remembers the dataset of a selection that is not complete. */
const REMEMBERED = "multistage-upload:";

/** @returns {{part: string, path: string, file: File}[][]} */
export function batches(named) {
  const all = [];
  let batch = [];
  let size = 0;
  for (const [path, file] of named) {
    if (batch.length > 0 && (batch.length >= BATCH_FILES || size + file.size > BATCH_BYTES)) {
      all.push(batch);
      batch = [];
      size = 0;
    }
    batch.push({ part: "images", path, file });
    size += file.size;
  }
  if (batch.length > 0) all.push(batch);
  return all;
}

/** A name for a selection by which the browser knows it again: what its files are called, how long and how old they are. */
function fingerprint(files) {
  let [a, b] = [0xdeadbeef, 0x41c6ce57];
  for (const letter of [...files].map(([path, file]) => `${path}|${file.size}|${file.lastModified}\n`).sort().join("")) {
    const code = letter.codePointAt(0);
    a = Math.imul(a ^ code, 2654435761);
    b = Math.imul(b ^ code, 1597334677);
  }
  return `${(a >>> 0).toString(16)}${(b >>> 0).toString(16)}`;
}

/** The browser may keep nothing, as in a private window: then a reload starts anew. */
const memory = {
  get: (key) => attempt(() => localStorage.getItem(key)),
  set: (key, value) => attempt(() => localStorage.setItem(key, value)),
  drop: (prefix) => attempt(() => Object.keys(localStorage).filter((key) => key.startsWith(prefix)).forEach((key) => localStorage.removeItem(key))),
};

function attempt(action) {
  try {
    return action();
  } catch {
    return null;
  }
}

export class Upload {
  /**
   * @param {import("./pick.js").Selection} selection
   * @param {string} name
   * @param {(progress: {sent: number, kept: number, total: number, files: number, waiting: string|null, current: {path: string, sent: number, size: number}[]}) => void} onprogress
   *   `kept` bytes of the `sent` ones were stored before this page was opened
   */
  constructor(selection, name, onprogress) {
    this.name = name;
    this.onprogress = onprogress;
    this.left = new Map(selection.named);
    this.archives = [...selection.archives].map(([path, file]) => ({ part: "archive", path, file }));
    this.memory = REMEMBERED + fingerprint([...this.left, ...selection.archives]);
    this.total = selection.bytes;
    this.sent = 0;
    this.kept = 0;
    this.files = 0;
    this.dataset = null;
    this.stopped = false;
    /** Photographs under way, with their bytes sent so far, what they wait for, and what ends them. */
    this.current = new Map();
    this.xhr = null;
  }

  /** Runs to the end; after a failure it may be called again and goes on where it was. Resolves to the dataset. */
  async run() {
    this.dataset ??= await this.persist(() => this.findOrCreateDataset());
    const tus = await import("../vendor/tus.js").catch(() => null);
    if (tus) await this.sendAll(tus.Upload);
    else for (const batch of batches(this.left)) await this.sendWhole(batch);
    while (this.archives.length > 0) await this.sendWhole(this.archives.slice(0, 1));
    return this.dataset;
  }

  /**
   * Everything has become a job: a later choice of the same files is a new one. Of a photograph that came whole just as the page
   * was loaded again, the note of its upload is still there.
   */
  finish() {
    memory.drop(this.memory);
    // As tus-js-client writes its notes.
    if (this.dataset) memory.drop(`tus::${this.dataset.id}|`);
  }

  /** Stops and removes what was sent. */
  async cancel() {
    this.stopped = true;
    this.xhr?.abort();
    for (const { abort } of this.current.values()) abort();
    this.finish();
    if (!this.dataset) return;
    await deleteDataset(this.dataset).catch(() => {});
  }

  report(waiting = null) {
    const current = [...this.current].map(([path, { sent, size }]) => ({ path, sent, size }));
    const sent = current.reduce((sum, file) => sum + file.sent, this.sent);
    const why = waiting ?? [...this.current.values()].find((file) => file.waiting)?.waiting ?? null;
    this.onprogress({ sent: Math.min(this.total, sent), kept: this.kept, total: this.total, files: this.files, waiting: why, current });
  }

  /** The dataset that an earlier visit began to fill with these very files, or a new one. */
  async findOrCreateDataset() {
    const known = memory.get(this.memory);
    const dataset = known ? await getDataset(known).catch((problem) => (problem.status === 404 ? null : Promise.reject(problem))) : null;
    if (!dataset) {
      const created = await createDataset(this.name);
      memory.set(this.memory, created.id);
      return created;
    }
    for (let cursor; cursor !== null; ) {
      const page = await datasetImages(dataset, cursor);
      for (const { path, size_bytes } of page.images) {
        if (this.left.get(path)?.size === size_bytes) this.stored(path);
      }
      cursor = page.next_cursor;
    }
    this.kept = this.sent;
    this.report();
    return dataset;
  }

  /** A photograph is in the dataset. */
  stored(path) {
    this.sent += this.left.get(path).size;
    this.files += 1;
    this.left.delete(path);
    this.current.delete(path);
  }

  /** The photographs that are left, some at once; the first failure ends the others, which go on later where they are. */
  async sendAll(TusUpload) {
    const queue = [...this.left];
    let failure = null;
    const sender = async () => {
      while (queue.length > 0 && failure === null) {
        const [path, file] = queue.shift();
        try {
          await this.sendResumable(TusUpload, path, file);
          this.stored(path);
          this.report();
        } catch (problem) {
          failure ??= problem;
          for (const { abort } of this.current.values()) abort();
        }
      }
    };
    await Promise.all(Array.from({ length: PARALLEL }, sender));
    this.current.clear();
    if (failure !== null) throw failure;
  }

  async sendResumable(TusUpload, path, file) {
    const problemIn = (error) => {
      const answer = error.originalResponse;
      return answer ? problemOf(answer.getStatus(), answer.getBody()) : unreachable();
    };
    const id = `${this.dataset.id}|${path}|${file.size}|${file.lastModified}`;
    await new Promise((resolve, reject) => {
      const upload = new TusUpload(file, {
        endpoint: new URL("api/v1/uploads", document.baseURI).href,
        metadata: { dataset: this.dataset.id, path },
        fingerprint: async () => id,
        removeFingerprintOnSuccess: true,
        uploadDataDuringCreation: file.size <= AT_ONCE_BYTES,
        retryDelays: RETRY_WAITS_S.map((wait_s) => 1000 * wait_s),
        onShouldRetry: (error, attempts) => {
          const problem = problemIn(error);
          const retry = !this.stopped && (problem.passing || problem.status === 423 || problem.code === "offset_mismatch");
          if (retry) {
            this.current.get(path).waiting = `${problem.message} Trying again in ${RETRY_WAITS_S[attempts]} s.`;
            this.report();
          }
          return retry;
        },
        onProgress: (sent) => {
          Object.assign(this.current.get(path), { sent, waiting: null });
          this.report();
        },
        onError: (error) => reject(problemIn(error)),
        onSuccess: resolve,
      });
      const abort = () => {
        upload.abort();
        reject(new Problem(0, "stopped", "The upload was stopped."));
      };
      this.current.set(path, { sent: 0, size: file.size, waiting: null, abort });
      upload.findPreviousUploads().then((previous) => {
        if (previous.length > 0) upload.resumeFromPreviousUpload(previous[0]);
        upload.start();
      }, reject);
    });
  }

  /** Some files in one form, again until they are stored. */
  async sendWhole(batch) {
    await this.persist(() => this.send(batch));
    for (const { part, path, file } of batch) {
      if (part === "images") {
        this.stored(path);
      } else {
        this.archives.shift();
        this.sent += file.size;
        this.files += 1;
      }
    }
    this.current.clear();
    this.report();
  }

  async persist(action) {
    for (let attempts = 0; ; attempts += 1) {
      try {
        return await action();
      } catch (problem) {
        const wait_s = RETRY_WAITS_S[attempts];
        if (this.stopped || !(problem instanceof Problem) || !problem.passing || wait_s === undefined) throw problem;
        this.report(`${problem.message} Trying again in ${wait_s} s.`);
        await new Promise((resolve) => setTimeout(resolve, wait_s * 1000));
        if (this.stopped) throw problem;
      }
    }
  }

  /** One form. XMLHttpRequest, because fetch does not tell how much of a body has been sent. */
  send(batch) {
    return new Promise((resolve, reject) => {
      const form = new FormData();
      for (const { part, path, file } of batch) form.append(part, file, path);
      const xhr = new XMLHttpRequest();
      this.xhr = xhr;
      xhr.open("POST", this.dataset.links.images);
      const size = batch.reduce((sum, { file }) => sum + file.size, 0);
      xhr.upload.onprogress = (event) => {
        const sent = event.total > 0 ? (size * event.loaded) / event.total : 0;
        this.current.set(batch[0].path, { sent, size, abort: () => xhr.abort() });
        this.report();
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
