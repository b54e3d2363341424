// Shows the statements that have the words typed and the verdict chosen.
document.addEventListener("DOMContentLoaded", () => {
  const bar = document.getElementById("statements");
  if (!bar) return;
  const [search, verdict, count] = bar.querySelectorAll("input, select, output");
  const table = [...document.querySelectorAll("table")].find((each) => bar.compareDocumentPosition(each) & 4);
  const rows = [...table.tBodies[0].rows];
  const show = () => {
    const words = search.value.toLowerCase().split(/\s+/);
    let shown = 0;
    for (const row of rows) {
      const kind = row.querySelector("[data-kind]").dataset.kind;
      const text = row.textContent.toLowerCase();
      row.hidden = (verdict.value && verdict.value !== kind) || !words.every((word) => text.includes(word));
      shown += !row.hidden;
    }
    count.value = `${shown} of ${rows.length}`;
  };
  search.addEventListener("input", show);
  verdict.addEventListener("input", show);
  show();
});
