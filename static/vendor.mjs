// Bundles the parts of three.js that the viewer uses into one file, static/vendor/three.js, with its licence beside it.
// The page then needs no import map, so a strict content security policy holds.
import { copyFile, mkdir } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));

await mkdir(here("vendor"), { recursive: true });
await build({
  entryPoints: [here("three-entry.mjs")],
  outfile: here("vendor/three.js"),
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "inline",
});
await copyFile(here("node_modules/three/LICENSE"), here("vendor/three.LICENSE.txt"));
