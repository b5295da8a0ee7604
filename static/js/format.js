// Numbers, sizes, times and names as people read them. An unknown number is a dash, never 0.

const whole = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });

export const DASH = "\u2013";

export const count = (n) => (n === null || n === undefined ? DASH : whole.format(n));

export const fixed = (n, digits) => (n === null || n === undefined ? DASH : n.toFixed(digits));

export function plural(n, one, many = `${one}s`) {
  return `${count(n)} ${n === 1 ? one : many}`;
}

export function bytes(n) {
  const units = ["bytes", "kB", "MB", "GB", "TB"];
  let k = 0;
  while (n >= 1000 && k < units.length - 1) { n /= 1000; k += 1; }
  return `${k === 0 || n >= 100 ? n.toFixed(0) : n.toFixed(1)} ${units[k]}`;
}

export function duration(seconds) {
  if (seconds === null || seconds === undefined) return DASH;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 60) return `${Math.round(seconds)} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 60) return `${minutes} min ${Math.round(seconds % 60)} s`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** A guess of the time left, given as a range, in coarse words. */
export function timeLeft(eta) {
  if (!eta) return "";
  const coarse = (s) => (s < 55 ? `${Math.max(5, Math.ceil(s / 5) * 5)} s` : s < 3600 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`);
  const [low, high] = [coarse(eta.low), coarse(eta.high)];
  return low === high ? `about ${high} left` : `${low} to ${high} left`;
}

export function when(iso) {
  if (!iso) return DASH;
  return new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "short" }).format(new Date(iso));
}

const STAGES = {
  intake: "Reading the pictures",
  features: "Finding features",
  coarse_match: "Matching, coarse",
  coarse_model: "Coarse model",
  add_cameras: "Adding cameras",
  add_points: "Adding points",
  refine: "Refining",
  export: "Writing the files",
};

export function stageName(stage) {
  return (STAGES[stage.name] ?? stage.name) + (stage.iteration ? `, round ${stage.iteration}` : "");
}

/** `add_cameras/1`, as reports write it. */
export function stageKey(key) {
  const [name, iteration] = key.split("/");
  return stageName({ name, iteration: iteration ? Number(iteration) : null });
}

export const STATES = {
  queued: "waiting",
  running: "running",
  succeeded: "finished",
  failed: "failed",
  cancelled: "stopped",
  pending: "pending",
  registered: "in the model",
  unregistered: "left out",
  rejected: "refused",
};
