declare module "gltf-validator" {
  interface Report {
    issues: { messages: { code: string; message: string }[] };
    info: { hasMorphTargets: boolean; drawCallCount: number };
  }
  export function validateBytes(bytes: Uint8Array): Promise<Report>;
}
