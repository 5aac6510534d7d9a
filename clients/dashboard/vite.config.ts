import { defineConfig } from "vite";

/** The build is committed: `make test-web` rebuilds it and compares. `npm run dev` uses a server on the default port. */
export default defineConfig({
  base: "./", // a proxy may serve the page under any path
  build: {
    outDir: "../../service/ddakf_service/static/dashboard",
    emptyOutDir: true,
    chunkSizeWarningLimit: 900,
    target: "es2022",
    modulePreload: { polyfill: false },
    license: { fileName: "assets/licenses.txt" },
    rolldownOptions: {
      output: {
        codeSplitting: { groups: [{ name: "three", test: /node_modules[\\/]three[\\/]/ }] },
        entryFileNames: "assets/[name]-[hash].js",
        chunkFileNames: "assets/[name]-[hash].js",
        assetFileNames: "assets/[name]-[hash][extname]",
      },
    },
  },
  worker: { format: "es", rolldownOptions: { output: { entryFileNames: "assets/[name]-[hash].js" } } },
  server: {
    proxy: {
      "/v1": { target: "http://127.0.0.1:7702", ws: true },
      "/metrics": "http://127.0.0.1:7702",
      "/readyz": "http://127.0.0.1:7702",
    },
  },
});
