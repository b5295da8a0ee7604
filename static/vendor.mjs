// Bundles the third-party code that the page uses, each library into one file of static/vendor with its licence beside it. The page
// then needs no import map, so a strict content security policy holds.
import { copyFile, mkdir } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));

await mkdir(here("vendor"), { recursive: true });
for (const [library, folder] of [["three", "three"], ["tus", "tus-js-client"]]) {
  await build({
    entryPoints: [here(`${library}-entry.mjs`)],
    outfile: here(`vendor/${library}.js`),
    bundle: true,
    minify: true,
    format: "esm",
    platform: "browser",
    target: "es2022",
    legalComments: "inline",
  });
  await copyFile(here(`node_modules/${folder}/LICENSE`), here(`vendor/${library}.LICENSE.txt`));
}
