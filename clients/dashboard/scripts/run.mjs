/** Runs a program of this folder that is written in TypeScript: `node scripts/run.mjs measure --minutes 10`. */
import { fileURLToPath } from "node:url";
import { runnerImport } from "vite";

const [, , name = "", ...rest] = process.argv;
process.argv.splice(2, Infinity, ...rest);
const { module } = await runnerImport(fileURLToPath(new URL(`./${name}.ts`, import.meta.url)), { configFile: false });
await module.main(rest);
process.exit(0);
