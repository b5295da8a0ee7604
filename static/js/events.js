// Keeps a job's state fresh: server-sent events where they come through, polling where they don't.

import { getJob, isOver } from "./api.js";

/** Without an event for so long, the job is asked for ... */
const QUIET_MS = 6000;
/** ... and this often where no stream comes through. */
const POLL_MS = 2000;
/** Several events at once are answered by one request. */
const SETTLE_MS = 120;

/**
 * Follows a job until it is over.
 * @param {object} job
 * @param {(job: object) => void} onchange called with the job whenever something changed
 * @param {(problem: Error|null) => void} ontrouble called when the service can't be asked, and with null when it can again
 */
export function follow(job, onchange, ontrouble) {
  let closed = false;
  let heard = performance.now();
  let settle = null;
  let asking = false;

  async function ask() {
    if (closed || asking) return;
    asking = true;
    try {
      const fresh = await getJob(job.id);
      heard = performance.now();
      if (closed) return;
      ontrouble(null);
      job = fresh;
      if (isOver(job)) close();
      onchange(job);
    } catch (problem) {
      if (!closed) ontrouble(problem);
    } finally {
      asking = false;
    }
  }

  const source = new EventSource(job.links.events);
  const listen = (name, apply) => source.addEventListener(name, (event) => {
    heard = performance.now();
    if (!closed) apply(JSON.parse(event.data));
  });
  // The stream begins with what happened before, so a state or stage event may be old news: the job itself is asked for.
  const refresh = () => {
    clearTimeout(settle);
    settle = setTimeout(ask, SETTLE_MS);
  };
  listen("state", refresh);
  listen("stage", refresh);
  listen("progress", ({ stage, eta_s }) => {
    // One stage runs at a time: another one that ran before has ended, though the news of it is still on the way.
    const stages = job.stages.map((s) => {
      if (s.name === stage.name && s.iteration === stage.iteration) return { ...s, state: "running", done: stage.done, total: stage.total };
      return s.state === "running" ? { ...s, state: "done" } : s;
    });
    job = { ...job, stage, eta_s, stages };
    onchange(job);
  });
  const timer = setInterval(() => {
    if (source.readyState === EventSource.CLOSED || performance.now() - heard > QUIET_MS) ask();
  }, POLL_MS);

  function close() {
    closed = true;
    clearTimeout(settle);
    clearInterval(timer);
    source.close();
  }
  return { close };
}
