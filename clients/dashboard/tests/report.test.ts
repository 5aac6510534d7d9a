/** Report: the document quotes the measurements that are stored. */
import { readFileSync } from "node:fs";
import { expect, test } from "vitest";
import { DOCUMENT, RESULT, withTable, type Report } from "../scripts/report.js";

test("the table of the document is that of the last measurement", () => {
  const report = JSON.parse(readFileSync(RESULT, "utf8")) as Report;
  const document = readFileSync(DOCUMENT, "utf8");
  expect(withTable(document, report)).toBe(document);
});
