/** Login: asks for an API key. */
import { SERVER, useKey } from "../api/connection.js";
import { h } from "../dom.js";
import type { View } from "./view.js";

/**
 * @param refusal why the key before was refused; empty: there was none.
 * @param onKey called when a key is in use.
 */
export function loginView(refusal: string, onKey: () => void): View {
  const key = h("input", { id: "key", type: "password", autocomplete: "off", spellcheck: "false", required: true });
  const forTab = h("input", { id: "for-tab", type: "checkbox" });
  const form = h(
    "form.login",
    { "aria-labelledby": "login-title" },
    h("h1", { id: "login-title" }, "This server needs a key"),
    h("p.muted", {}, `Calls of ${new URL(SERVER).host} are allowed with an API key of the scope read or stream.`),
    h("label", { for: "key" }, "API key"),
    key,
    refusal !== "" && h("p.error", { role: "alert" }, refusal),
    h(
      "label.check",
      { for: "for-tab" },
      forTab,
      h("span", {}, "Keep it for this tab", h("small", {}, "Otherwise a reload asks again.")),
    ),
    h("button.primary", { type: "submit" }, "Open"),
    h("p.hint", {}, "Keys are made on the server's machine: ", h("code", {}, "ddakf keys create NAME --scope stream")),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    useKey(key.value.trim(), forTab.checked);
    onKey();
  });
  queueMicrotask(() => {
    key.focus();
  });
  return { element: h("section.centred", {}, form), title: "Key" };
}
