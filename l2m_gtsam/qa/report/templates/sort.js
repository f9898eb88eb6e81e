"use strict";
// Sorts a table by a column: numbers by value, the rest as text; blanks stand last either way.
const order = new Intl.Collator("en", { numeric: true });

function value(row, column, kind) {
  const cell = row.cells[column];
  const text = cell.dataset.v ?? cell.textContent.trim();
  if (kind !== "number") return text;
  const number = parseFloat(text);
  return Number.isNaN(number) ? "" : number;
}

function sort(header) {
  const body = header.closest("table").tBodies[0];
  const rising = header.getAttribute("aria-sort") !== "ascending";
  const kind = header.dataset.kind;
  const rows = Array.from(body.rows, (row) => [value(row, header.cellIndex, kind), row]);
  const full = rows.filter(([key]) => key !== "");
  const blank = rows.filter(([key]) => key === "");
  full.sort(([a], [b]) => (rising ? 1 : -1) * (kind === "number" ? a - b : order.compare(a, b)));
  for (const other of header.parentElement.cells) other.removeAttribute("aria-sort");
  header.setAttribute("aria-sort", rising ? "ascending" : "descending");
  body.append(...[...full, ...blank].map(([, row]) => row));
}

for (const button of document.querySelectorAll("table.sortable th button")) {
  button.addEventListener("click", () => sort(button.closest("th")));
}
