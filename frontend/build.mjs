// Bundles the pages into one folder: `node build.mjs OUTDIR`. Classic scripts, as file:// loads no modules.
import { build } from "esbuild";
import { readdir, readFile } from "node:fs/promises";
import { join } from "node:path";

const outdir = process.argv[2];
if (!outdir) throw new Error("usage: node build.mjs OUTDIR");

/** Puts the licence of a bundled package beside its code, as MIT and BSD licences ask for. */
const licences = {
  name: "licences",
  setup({ onLoad }) {
    onLoad({ filter: /node_modules[\\/].*\.m?js$/ }, async ({ path }) => {
      const [home] = /.*node_modules[\\/](@[^\\/]+[\\/])?[^\\/]+/.exec(path);
      const file = (await readdir(home)).find((name) => /^licen[cs]e/i.test(name));
      const licence = await readFile(join(home, file), "utf8");
      return { contents: `/*! ${licence.trim()} */\n${await readFile(path, "utf8")}` };
    });
  },
};

await build({
  entryPoints: {
    sheet: "src/viewer/sheet.ts",
    viewer: "src/viewer/viewer.ts",
    workbench: "src/workbench/main.ts",
    watch: "src/watch/main.ts",
  },
  outdir,
  bundle: true,
  minify: true,
  format: "iife",
  target: ["chrome110", "firefox113", "safari16.4"],
  charset: "utf8",
  legalComments: "eof",
  logLevel: "warning",
  plugins: [licences],
});
