// Sorts the rows of a table by a click on a heading. Cells without a number come last in both directions.
function makeSortable(table) {
  const heads = [...table.tHead.rows[0].cells];
  const body = table.tBodies[0];
  const value = (row, i) => (i ? parseFloat(row.cells[i].dataset.value) : row.cells[i].textContent.trim());
  const sort = (i, up) => {
    const sign = up ? 1 : -1;
    const rows = [...body.rows].sort((a, b) => {
      const [p, q] = [value(a, i), value(b, i)];
      if (typeof p === "string") return sign * p.localeCompare(q);
      if (Number.isNaN(p) || Number.isNaN(q)) return Number.isNaN(p) - Number.isNaN(q);
      return sign * (p - q);
    });
    body.append(...rows);
    heads.forEach((head) => head.removeAttribute("aria-sort"));
    heads[i].setAttribute("aria-sort", up ? "ascending" : "descending");
  };
  heads.forEach((head, i) =>
    head.querySelector("button").addEventListener("click", () => {
      const now = head.getAttribute("aria-sort");
      sort(i, now ? now === "descending" : head.dataset.better !== "higher");
    }),
  );
  return sort;
}
