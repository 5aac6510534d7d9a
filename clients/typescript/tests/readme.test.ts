/** README: its TypeScript compiles against the built package. */
import { readFileSync } from "node:fs";
import { fileURLToPath } from "node:url";
import ts from "typescript";
import { expect, test } from "vitest";

const ROOT = fileURLToPath(new URL("..", import.meta.url));

/** What the README takes for granted. */
const GIVEN = `
declare const vertices: Float32Array<ArrayBuffer>, verticesNow: Float32Array<ArrayBuffer>, faces: Uint32Array<ArrayBuffer>;
declare function camera(): AsyncIterable<import("ddakf-client").PointFrame>;
`;
const SESSION = `declare const session: import("ddakf-client").Session;`;
const POSITION = `declare const position: import("three").BufferAttribute;`;

/** Blocks of code with the imports and declarations that stand in earlier ones. */
function blocks(): string[] {
  const readme = readFileSync(`${ROOT}/README.md`, "utf8");
  const found = [...readme.matchAll(/```ts\n(.*?)```/gs)].map(([, code]) => code!);
  return found.map((code) => {
    const imports = code.includes("import {")
      ? ""
      : `import { connect, Result } from "ddakf-client";\nimport * as THREE from "three";\n`;
    const known = code.includes("createSession") ? "" : `${SESSION}\n${POSITION}\n`;
    return `${imports}${GIVEN}${known}${code}\nexport {};\n`;
  });
}

test("the code of the README compiles", () => {
  const files = new Map(blocks().map((code, i) => [`${ROOT}tests/readme-${i}.ts`, code]));
  expect(files.size).toBe(5);
  const { config } = ts.readConfigFile(`${ROOT}/tsconfig.json`, (path) => readFileSync(path, "utf8")) as { config: object };
  const { options } = ts.parseJsonConfigFileContent(config, ts.sys, ROOT);
  Object.assign(options, { noUnusedLocals: false });
  const host = ts.createCompilerHost(options);
  const disk = ts.createCompilerHost(options);
  host.fileExists = (path) => files.has(path) || disk.fileExists(path);
  host.readFile = (path) => files.get(path) ?? disk.readFile(path);
  host.getSourceFile = (path, target) =>
    files.has(path) ? ts.createSourceFile(path, files.get(path)!, target) : disk.getSourceFile(path, target);
  const program = ts.createProgram([...files.keys()], options, host);
  const messages = ts.getPreEmitDiagnostics(program).map(({ messageText }) => ts.flattenDiagnosticMessageText(messageText, "\n"));
  expect(messages).toEqual([]);
});

test("a project that knows no disposable types, and checks those of its packages, compiles", () => {
  const options: ts.CompilerOptions = {
    strict: true,
    noEmit: true,
    target: ts.ScriptTarget.ES2022,
    module: ts.ModuleKind.ESNext,
    moduleResolution: ts.ModuleResolutionKind.Bundler,
    lib: ["lib.es2022.d.ts", "lib.dom.d.ts"],
    types: [],
  };
  const entries = ["index", "adapters/index", "recordings/index"].map((name) => `${ROOT}dist/${name}.d.ts`);
  const program = ts.createProgram(entries, options);
  expect(ts.getPreEmitDiagnostics(program).map(({ messageText }) => messageText)).toEqual([]);
});
