// A table that sorts by the column whose head is clicked; numbers by size, empty cells last.
(() => {
  const table = document.getElementById("table");
  const heads = [...table.tHead.rows[0].cells];
  const value = (row, i) => row.cells[i].dataset.order;
  const compare = (a, b) => {
    if (a === "" || b === "") return a === b ? 0 : a === "" ? 1 : -1;
    const x = Number(a), y = Number(b);
    return Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b) : x - y;
  };
  heads.forEach((head, i) => {
    head.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((other) => other.setAttribute("aria-sort", "none"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = [...table.tBodies[0].rows].sort((one, two) => {
        const [a, b] = [value(one, i), value(two, i)];
        return a === "" || b === "" || !down ? compare(a, b) : -compare(a, b);
      });
      table.tBodies[0].append(...rows);
    });
  });
})();
