/**
 * Generator: writes the messages of `protos/ddakf_api` with the protoc of grpcio-tools and protobuf-es.
 *
 *     node scripts/generate.mjs [FOLDER]    # default: src/gen, whose content is committed
 */
import { execFileSync } from "node:child_process";
import { mkdirSync } from "node:fs";
import { fileURLToPath } from "node:url";

const root = fileURLToPath(new URL("..", import.meta.url));
const protos = fileURLToPath(new URL("../../../protos", import.meta.url));
const out = process.argv[2] ?? `${root}/src/gen`;
mkdirSync(out, { recursive: true });
execFileSync(
  process.env.DDAKF_PYTHON ?? "python3",
  [
    ...["-m", "grpc_tools.protoc", `-I${protos}`, `--plugin=protoc-gen-es=${root}/node_modules/.bin/protoc-gen-es`],
    ...[`--es_out=${out}`, "--es_opt=target=js+dts,import_extension=js", "ddakf_api/v1/tracking.proto"],
  ],
  { cwd: protos, stdio: ["ignore", "inherit", "inherit"] },
);
