// Which files were chosen or dropped, with their paths inside the chosen folder.

const PICTURE = /\.(jpe?g|png|tiff?|webp)$/i;
const ARCHIVE = /\.zip$/i;

/**
 * @typedef {{file: File, path: string}} Picked
 */

/** Files of an <input>; a folder input knows each file's path below the folder. */
export function fromInput(input) {
  return [...input.files].map((file) => ({ file, path: file.webkitRelativePath || file.name }));
}

/** Files of a drop, folders walked to the bottom. */
export async function fromDrop(transfer) {
  // The entries must be taken before the first await: the transfer is emptied after the event.
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (entries.length === 0) return [...transfer.files].map((file) => ({ file, path: file.name }));
  const picked = [];
  for (const entry of entries) await walk(entry, "", picked);
  return picked;
}

async function walk(entry, folder, picked) {
  const path = folder + entry.name;
  if (entry.isFile) {
    picked.push({ file: await new Promise((resolve, reject) => entry.file(resolve, reject)), path });
    return;
  }
  const reader = entry.createReader();
  for (;;) {
    // A reader gives at most 100 entries a call.
    const batch = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (batch.length === 0) return;
    for (const child of batch) await walk(child, `${path}/`, picked);
  }
}

/** The pictures chosen so far: no path twice, other files counted and left out. */
export class Selection {
  constructor() {
    /** @type {Map<string, File>} */
    this.pictures = new Map();
    /** @type {Map<string, File>} */
    this.archives = new Map();
    this.ignored = 0;
  }

  /** @param {Picked[]} picked */
  add(picked) {
    for (const { file, path } of picked) {
      const into = PICTURE.test(path) ? this.pictures : ARCHIVE.test(path) ? this.archives : null;
      // Files that a system hides (.DS_Store, ._picture.jpg, __MACOSX) are no choice of anybody's.
      if (path.split("/").some((part) => part.startsWith(".") || part === "__MACOSX")) continue;
      if (into === null) this.ignored += 1;
      else put(into, path, file);
    }
  }

  get size() {
    return this.pictures.size + this.archives.size;
  }

  get bytes() {
    let sum = 0;
    for (const files of [this.pictures, this.archives]) for (const file of files.values()) sum += file.size;
    return sum;
  }

  /** The pictures by the path they get in the job: below the folder that holds everything, where there is one. */
  get named() {
    const { folder } = this;
    const cut = this.archives.size === 0 && folder !== "" ? folder.length + 1 : 0;
    return [...this.pictures].map(([path, file]) => [path.slice(cut), file]);
  }

  /** A name for the job: the folder that holds everything, else nothing. */
  get folder() {
    const tops = new Set([...this.pictures.keys()].map((path) => (path.includes("/") ? path.split("/")[0] : "")));
    if (tops.size === 1) return [...tops][0];
    return this.pictures.size === 0 && this.archives.size === 1 ? [...this.archives.keys()][0].replace(ARCHIVE, "") : "";
  }
}

function put(files, path, file) {
  const same = (other) => other.size === file.size && other.lastModified === file.lastModified;
  let free = path;
  for (let k = 2; files.has(free); k += 1) {
    if (same(files.get(free))) return;
    // Another file of that name, from another folder.
    free = path.replace(/(\.[^.]*)$/, ` (${k})$1`);
  }
  files.set(free, file);
}
