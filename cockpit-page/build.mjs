// Builds the page into src/skyloop/cockpit/static, or (--tests) the tests into build/tests.
//
// The output is committed, so that the cockpit works without npm. static/manifest.json has a hash of the sources and one
// of each file: tests/cockpit/test_page_build.py fails if they do not belong together.

import { createHash } from "node:crypto";
import { cp, mkdir, readdir, readFile, rm, writeFile } from "node:fs/promises";
import { dirname, join, relative, sep } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const target = join(here, "..", "src", "skyloop", "cockpit", "static");
const SOURCES = ["src", "public"];
const SETTINGS = ["build.mjs", "package.json", "package-lock.json", "tsconfig.json"];

async function filesOf(folder) {
  const entries = await readdir(folder, { recursive: true, withFileTypes: true });
  return entries.filter((entry) => entry.isFile()).map((entry) => join(entry.parentPath, entry.name));
}

/** SHA-256 over name, NUL, content, NUL of each file, by name. */
async function hashOf(files, base) {
  const sum = createHash("sha256");
  const named = files.map((file) => [relative(base, file).split(sep).join("/"), file]);
  for (const [name, file] of named.sort(([a], [b]) => (a < b ? -1 : 1))) {
    sum.update(name).update("\0").update(await readFile(file)).update("\0");
  }
  return sum.digest("hex");
}

async function buildPage() {
  await rm(target, { recursive: true, force: true });
  await mkdir(target, { recursive: true });
  await cp(join(here, "public"), target, { recursive: true });
  await build({
    absWorkingDir: here,
    entryPoints: { cockpit: "src/main.ts" },
    outdir: target,
    bundle: true,
    format: "esm",
    splitting: true, // the 3-D view is loaded on first use
    chunkNames: "[name]-[hash]",
    minify: true,
    legalComments: "inline",
    target: ["chrome115", "firefox115", "safari17"],
    charset: "utf8",
    logLevel: "warning",
  });
  const licences = ["three", "uplot"].map(async (name) => `${name}\n\n${await readFile(join(here, "node_modules", name, "LICENSE"), "utf8")}`);
  await writeFile(join(target, "licences.txt"), (await Promise.all(licences)).join("\n"));
  const files = {};
  let total = 0;
  for (const file of (await filesOf(target)).sort()) {
    const content = await readFile(file);
    total += content.length;
    files[relative(target, file).split(sep).join("/")] = createHash("sha256").update(content).digest("hex");
    console.log(`${relative(target, file).padEnd(28)} ${String(content.length).padStart(9)} bytes`);
  }
  const sources = (await Promise.all(SOURCES.map((folder) => filesOf(join(here, folder))))).flat();
  const manifest = { sources: await hashOf([...sources, ...SETTINGS.map((name) => join(here, name))], here), files };
  await writeFile(join(target, "manifest.json"), `${JSON.stringify(manifest, null, 2)}\n`);
  console.log(`${"together".padEnd(28)} ${String(total).padStart(9)} bytes`);
}

async function buildTests() {
  const output = join(here, "build", "tests");
  await rm(output, { recursive: true, force: true });
  const entryPoints = (await filesOf(join(here, "tests"))).filter((file) => file.endsWith(".test.ts"));
  await build({ absWorkingDir: here, entryPoints, outdir: output, bundle: true, format: "esm", platform: "node",
    outExtension: { ".js": ".mjs" }, sourcemap: "inline", logLevel: "warning" });
}

await (process.argv.includes("--tests") ? buildTests() : buildPage());
