"use strict";
// What the tables gain from scripts: theme, sorting, arcs of one entry, printing. Shared with the other scripts
// through `window.report`.
(() => {
  const root = document.documentElement;
  const element = (name, attributes = {}, ...children) => {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) {
      if (value === true) made.setAttribute(key, "");
      else if (value !== false && value !== null) made.setAttribute(key, value);
    }
    made.append(...children); // text stays text: nothing here is parsed as markup
    return made;
  };
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const redraw = () => document.dispatchEvent(new CustomEvent("report:redraw"));
  const short = (steps) => {
    for (const [size, letter] of [[1e6, "M"], [1e3, "k"]]) {
      if (Math.abs(steps) >= size) return `${Number((steps / size).toPrecision(4))}${letter}`;
    }
    return `${Number(steps.toPrecision(4))}`;
  };
  window.report = { data, element, short, printing: false };

  // Theme: the system's, until the reader chooses.
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : dark.matches);
  const showTheme = () => {
    button.textContent = isDark() ? "Light mode" : "Dark mode";
    redraw();
  };
  const remembered = (value) => {
    try { // a browser may forbid storage, and forbids it to some local files
      if (value) localStorage.setItem("qrlsuite-theme", value);
      return localStorage.getItem("qrlsuite-theme");
    } catch { return null; }
  };
  if (["light", "dark"].includes(remembered())) root.dataset.theme = remembered();
  button.hidden = false;
  button.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    remembered(root.dataset.theme);
    showTheme();
  });
  dark.addEventListener("change", showTheme);
  showTheme();

  // Sorting.
  const sort = (table, key, direction) => {
    const headers = [...table.tHead.rows[0].cells];
    const column = headers.findIndex((cell) => cell.dataset.key === key);
    const value = (row) => row.cells[column].dataset.value;
    const compare = (a, b) => {
      const [x, y] = [value(a), value(b)];
      if (x === "" || y === "") return (x === "") - (y === ""); // what has no value stays last
      const order = headers[column].dataset.words === "1" ? x.localeCompare(y, "en", { numeric: true }) : Number(x) - Number(y);
      return direction === "ascending" ? order : -order;
    };
    const rows = [...table.tBodies[0].rows].sort(compare);
    table.tBodies[0].append(...rows);
    for (const cell of headers) {
      if (cell.dataset.key === key) cell.setAttribute("aria-sort", direction);
      else cell.removeAttribute("aria-sort");
    }
  };
  for (const table of document.querySelectorAll("table.ranks")) {
    const headers = [...table.tHead.rows[0].cells];
    const select = element("select", {});
    for (const cell of headers) {
      const name = cell.textContent;
      const best = cell.dataset.most === "1" ? "descending" : "ascending";
      const control = element("button", { type: "button" }, name);
      control.addEventListener("click", () => {
        const now = cell.getAttribute("aria-sort");
        sort(table, cell.dataset.key, now === null ? best : now === "ascending" ? "descending" : "ascending");
        select.value = cell.dataset.key;
      });
      cell.replaceChildren(control);
      select.append(element("option", { value: cell.dataset.key, "data-best": best }, name));
    }
    select.value = table.querySelector("[aria-sort]").dataset.key;
    select.addEventListener("change", () => sort(table, select.value, select.selectedOptions[0].dataset.best));
    const tools = document.querySelector(`[data-tools-for="${table.id}"]`);
    tools.append(element("label", { class: "only-narrow" }, "Sort by", select));
    tools.hidden = false;
  }

  // The arcs of the entry under the pointer or the focus.
  for (const ladder of document.querySelectorAll(".ladder")) {
    const mark = (place) => {
      ladder.classList.toggle("chosen", place !== null);
      for (const arc of ladder.querySelectorAll(".arc")) {
        arc.classList.toggle("from", arc.dataset.from === place);
        arc.classList.toggle("to", arc.dataset.to === place);
      }
    };
    for (const item of ladder.querySelectorAll("li")) {
      for (const event of ["mouseenter", "focusin"]) item.addEventListener(event, () => mark(item.dataset.place));
      for (const event of ["mouseleave", "focusout"]) item.addEventListener(event, () => mark(null));
    }
  }

  // A link to an entry opens its details.
  const open = () => {
    const target = location.hash.startsWith("#entry-") && document.getElementById(location.hash.slice(1));
    if (!target) return;
    target.closest("details").open = true;
    target.closest("details").scrollIntoView();
  };
  window.addEventListener("hashchange", open);
  for (const link of document.querySelectorAll('a[href^="#entry-"]')) link.addEventListener("click", () => setTimeout(open));
  open();

  // On paper everything is open; what the reader had closed is closed again afterwards.
  const closed = [];
  const print = (starts) => {
    if (starts === window.report.printing) return;
    window.report.printing = starts;
    if (starts) closed.push(...document.querySelectorAll("details:not([open])"));
    for (const details of closed) details.open = starts;
    if (!starts) closed.length = 0;
    redraw();
  };
  window.addEventListener("beforeprint", () => print(true));
  window.addEventListener("afterprint", () => print(false));
  window.matchMedia("print").addEventListener("change", (event) => print(event.matches));
  for (const part of document.querySelectorAll(".js")) part.hidden = false;
})();
