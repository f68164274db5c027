// Tables whose columns can be sorted, and kept as CSV.

const value_of = cell => {
  const text = cell.textContent.trim(), found = text.replace(/[\u2212]/g, "-").replace(/[\s\u00a0](?=\d{3}\b)/g, "").match(/^[<>≈±]?\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)/i);
  return text === "–" || text === "" ? null : found ? +found[1] : text.toLowerCase();
};
const in_order = (a, b) => a === b ? 0 : a === null ? 1 : b === null ? -1
  : typeof a === typeof b ? (a < b ? -1 : 1) : typeof a === "number" ? -1 : 1;

function sortable(table) {
  const body = table.tBodies[0], rows = [...body.rows], heads = [...table.tHead.rows[0].cells];
  if (rows.length > 1) heads.forEach((head, column) => {
    const button = make("button", { type: "button", class: "sort" }, ...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const next = { ascending: "descending", descending: null }[head.getAttribute("aria-sort")];
      const order = next === undefined ? "ascending" : next;
      heads.forEach(one => one.removeAttribute("aria-sort"));
      if (order) head.setAttribute("aria-sort", order);
      const sign = order === "descending" ? -1 : 1, of = row => value_of(row.cells[column]);
      const missing = row => of(row) === null;
      body.append(...(order ? [...rows].sort((a, b) => (missing(a) - missing(b)) || sign * in_order(of(a), of(b))) : rows));
    });
  });
  const lines = () => [heads, ...[...body.rows].map(row => [...row.cells])].map(cells => cells.map(cell => cell.textContent.trim()));
  const words = table.caption.textContent.trim(), name = table.closest("section")?.id || "table";
  table.caption.append(" ", tool("CSV", `Save as CSV: ${words}`, () => save(`${name}.csv`, "text/csv", csv(lines()))));
}
