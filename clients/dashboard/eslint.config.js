import js from "@eslint/js";
import { defineConfig } from "eslint/config";
import typescript from "typescript-eslint";

export default defineConfig(
  { ignores: ["dist", "node_modules"] },
  js.configs.recommended,
  typescript.configs.strictTypeChecked,
  {
    languageOptions: {
      parserOptions: { projectService: { allowDefaultProject: ["*.js", "scripts/*.mjs"] }, tsconfigRootDir: import.meta.dirname },
    },
  },
  {
    rules: {
      // typed arrays: an index inside the length is never undefined, and the compiler cannot know it
      "@typescript-eslint/no-non-null-assertion": "off",
      "@typescript-eslint/restrict-template-expressions": ["error", { allowNumber: true }],
      "max-lines": ["error", { max: 260, skipComments: true, skipBlankLines: true }],
      "max-lines-per-function": ["error", { max: 60, skipComments: true }],
    },
  },
  {
    files: ["scripts/*.mjs"],
    ...typescript.configs.disableTypeChecked,
    languageOptions: { globals: { process: "readonly", URL: "readonly" } },
  },
  { files: ["tests/**", "scripts/**"], rules: { "max-lines": "off", "max-lines-per-function": "off" } },
);
