"use strict";
// Entries are found by a search, picked by clicking their rows, and compared: their curves, verdicts and cells.
(() => {
  const { data, element, short } = window.report;
  const SYMBOLS = {
    "+": ["+", "win", "significantly fewer"], "-": ["−", "loss", "significantly more"],
    ".": ["·", "tie", "no significant difference"], "^": ["^", "tie cap", "both at cap"],
    "?": ["?", "tie", "undecided"],
  };
  const OPPOSITE = { "+": "-", "-": "+" };
  const IN_WORDS = 3; // picked entries of which every pair has its sentence

  const drawings = [];
  const states = window.report.states = []; // what the reader chose in each section, to be kept while pages change
  data.sections.forEach((section, number) => {
    const find = (name) => document.querySelector(`.${name}[data-section="${number}"]`);
    const [panel, cells, matrix, decisions] = ["picked", "pair", "matrix", "p-values"].map(find);
    const table = document.getElementById(`board-${number}-table`);
    const rows = [...table.tBodies[0].rows]; // in the order of places, before anything is sorted
    const sentences = new Map([...document.querySelectorAll(`[data-sentences="${number}"] li`)].map((item) => [item.dataset.pair, item.textContent]));
    const sentence = (a, b) => sentences.get(`${Math.min(a, b)}/${Math.max(a, b)}`);
    const legends = section.entries.map((index, place) => section.names[place] + data.entries[index].legend.slice(data.entries[index].label.length));
    let picked = panel.dataset.picked.split(" ").map(Number);
    let picture = null;

    const words = panel.querySelector(".verdicts");
    const plot = element("div", { class: "plot", tabindex: 0, role: "img" });
    const legend = element("ul", { class: "legend" });
    const singles = element("input", { type: "checkbox" });
    const save = element("button", { type: "button", class: "save" }, "Save as SVG");
    const step = element("span", { class: "at" });
    panel.append(plot, legend, element("p", { class: "tools" }, step, element("label", {}, singles, "Single runs"), save),
      element("p", { class: "note thinned" }));

    const boxes = rows.map((row, place) => {
      const box = element("input", { type: "checkbox", class: "pick", "aria-label": `Pick ${section.names[place]}` });
      row.querySelector(".who").prepend(box);
      box.addEventListener("change", () => toggle(place));
      row.addEventListener("click", (event) => {
        if (!event.target.closest("a, input, abbr") && !getSelection().toString()) toggle(place);
      });
      return box;
    });
    const toggle = (place) => pick(picked.includes(place) ? picked.filter((each) => each !== place) : [...picked, place]);

    const showValues = (share) => {
      const [steps, medians] = picture.at(share);
      step.textContent = share < 0 ? "Medians at the end" : `At ${short(Number(steps.toPrecision(3)))} steps`;
      [...legend.querySelectorAll("output")].forEach((output, k) => { output.value = medians[k] === null ? "–" : medians[k].toFixed(3); });
    };
    const draw = (wide = plot.clientWidth) => {
      picture = window.report.curves(wide, section, picked, singles.checked);
      picture.setAttribute("aria-hidden", "true");
      plot.replaceChildren(picture);
      showValues(-1);
    };
    const showWords = () => {
      const several = picked.length > 1 && picked.length <= IN_WORDS;
      const pairs = several ? picked.flatMap((a, k) => picked.slice(k + 1).map((b) => sentence(a, b))) : [];
      const hint = picked.length > IN_WORDS ? `${picked.length} picked. The verdicts of two or three stand here.`
        : !picked.length ? "Click rows to see their learning curves." : rows.length > 1 ? "Click another row to compare." : "";
      words.replaceChildren(...(pairs.length ? pairs : [hint]).map((line) => element("p", { class: pairs.length ? "verdict" : "note" }, line)));
    };
    let touched = false; // until then a newer page picks anew
    const pick = (places) => {
      touched = true;
      mark(places);
      draw();
    };
    const mark = (places) => {
      picked = places;
      boxes.forEach((box, place) => {
        box.checked = picked.includes(place);
        rows[place].classList.toggle("is-picked", box.checked);
      });
      legend.replaceChildren(...picked.map((place) => {
        const unpick = element("button", { type: "button", "aria-label": `Unpick ${section.names[place]}` }, "×");
        unpick.addEventListener("click", () => { toggle(place); boxes[place].focus({ preventScroll: true }); });
        return element("li", {}, rows[place].querySelector(".swatch").cloneNode(true), element("span", {}, legends[place]), element("output", {}), unpick);
      }));
      const thin = picked.map((place) => data.entries[section.entries[place]]).some((entry) => entry.kept < entry.runs);
      panel.querySelector(".thinned").textContent = thin && singles.checked
        ? "Single runs are a selection, evenly spaced by their last score, to keep this file small; median and band use all." : "";
      plot.setAttribute("aria-label", picked.length ? `Learning curves of ${picked.map((place) => section.names[place]).join(", ")}; arrow keys move the cursor` : "No curve is picked");
      showWords();
      if (cells) showCells();
    };

    // The cursor follows the pointer, a finger or the arrow keys.
    let at = 1;
    plot.addEventListener("pointermove", (event) => {
      const box = plot.getBoundingClientRect();
      showValues((event.clientX - box.left) / box.width);
    });
    plot.addEventListener("pointerleave", () => showValues(-1));
    plot.addEventListener("keydown", (event) => {
      if (!["ArrowLeft", "ArrowRight"].includes(event.key)) return;
      at = Math.min(1, Math.max(0, at + (event.key === "ArrowLeft" ? -0.02 : 0.02)));
      showValues(at);
      event.preventDefault();
    });
    plot.addEventListener("blur", () => showValues(-1));
    singles.addEventListener("change", () => pick(picked));
    save.addEventListener("click", () => {
      const address = URL.createObjectURL(window.report.file(picture, section, picked));
      element("a", { href: address, download: `curves-${number + 1}.svg` }).click();
      URL.revokeObjectURL(address);
    });

    // The search hides rows that lack one of its words.
    const texts = rows.map((row, place) => `${row.textContent} ${legends[place]}`.toLowerCase());
    const search = element("input", { type: "search", placeholder: "Search entries", "aria-label": "Search entries", "aria-controls": table.id });
    const count = element("output", {});
    const filter = () => {
      const wanted = search.value.toLowerCase().split(/\s+/);
      rows.forEach((row, place) => { row.hidden = !wanted.every((word) => texts[place].includes(word)); });
      const shown = rows.filter((row) => !row.hidden).length;
      count.value = shown === rows.length ? "" : `${shown} of ${rows.length}`;
    };
    search.addEventListener("input", filter);
    const all = element("button", { type: "button" }, "Pick shown");
    all.addEventListener("click", () => pick([...new Set([...picked, ...rows.keys()])].filter((place) => picked.includes(place) || !rows[place].hidden)));
    const none = element("button", { type: "button" }, "Unpick all");
    none.addEventListener("click", () => pick([]));
    if (rows.length > 1) document.querySelector(`[data-tools-for="${table.id}"]`).prepend(search, count, all, none);

    // One pair, cell by cell: the two that are picked, by their rows or by the matrix.
    const names = section.names;
    const judged = new Map(section.pairs.map((pair) => [`${pair[0]}/${pair[1]}`, pair]));
    const cellsOf = (a, b) => {
      const [, , runs, signs, ...sides] = judged.get(`${Math.min(a, b)}/${Math.max(a, b)}`);
      return { runs, signs: a < b ? signs : [...signs].map((sign) => OPPOSITE[sign] ?? sign), said: section.words[sides[Number(a > b)]] };
    };
    const showCells = () => {
      if (picked.length !== 2) return cells.replaceChildren(element("p", { class: "note" }, "Pick two entries to see their cells."));
      const [a, b] = picked;
      const { runs, signs, said } = cellsOf(a, b);
      const [one, other] = [a, b].map((place) => section.evidence[`${place}/${runs}`]);
      const interval = (numbers, k) => `${short(numbers.s[k])} (${short(numbers.l[k])} to ${short(numbers.h[k])})`;
      const head = element("tr", {}, element("th", { scope: "col" }, `${section.levelName} \\ δ`));
      for (const delta of section.deltas) head.append(element("th", { scope: "col" }, delta));
      const body = element("tbody");
      section.levels.forEach((level, e) => {
        const row = element("tr", {}, element("th", { scope: "row" }, level));
        section.deltas.forEach((_, d) => {
          const k = e * section.deltas.length + d;
          const [symbol, style, meaning] = SYMBOLS[signs[k]];
          const scaled = (steps) => short(steps).replace(/k$/, section.horizon >= 20000 ? "" : "k");
          const title = `${names[a]}: ${interval(one, k)}\n${names[b]}: ${interval(other, k)}\n${meaning}`;
          row.append(element("td", { class: style, title }, element("b", { "aria-label": meaning }, symbol),
            `${scaled(Math.round(one.s[k]))}/${scaled(Math.round(other.s[k]))}`));
        });
        body.append(row);
      });
      const unit = section.horizon >= 20000 ? "in thousands of steps" : "in steps";
      return cells.replaceChildren(
        element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Cells of the pair" },
          element("table", { class: "cells" }, element("thead", {}, head), body)),
        element("div", {},
          element("p", { class: "verdict" }, `${names[a]} against ${names[b]}: ${said}.`),
          element("p", { class: "note" }, `${runs} runs each, ${short(section.horizon)} steps. In every cell (${section.levelName}, δ): ` +
            "+ significantly fewer samples, − significantly more, · no significant difference, ^ both at cap; " +
            `below, Ŝ of both ${unit}.`)),
      );
    };
    const pairOf = (target) => {
      const cell = target.closest("td");
      if (!cell) return null;
      const pair = [cell.parentNode.sectionRowIndex, cell.cellIndex - 1];
      return pair[0] === pair[1] ? null : pair;
    };
    matrix?.addEventListener("click", (event) => {
      const pair = pairOf(event.target);
      if (pair) pick(pair);
    });
    for (const [grid, told] of [[matrix, (a, b) => `${names[a]} against ${names[b]}: ${cellsOf(a, b).said}`], [decisions, sentence]]) {
      grid?.addEventListener("pointerover", (event) => { // titles of all pairs would make the page a third larger
        const pair = pairOf(event.target);
        if (pair) event.target.closest("td").title = told(...pair);
      });
    }

    if (cells) cells.hidden = false;
    mark(picked);
    states.push({
      task: section.task,
      read: () => ({ names: touched ? picked.map((place) => names[place]) : null, search: search.value, singles: singles.checked }),
      write: (state) => {
        [search.value, singles.checked] = [state.search, state.singles];
        filter();
        if (state.names) [touched] = [true, mark(state.names.map((name) => names.indexOf(name)).filter((place) => place >= 0))];
        draw();
      },
    });
    drawings.push([plot, draw]);
  });

  const drawAll = () => { // widths first: after a change each has the browser lay the page out
    const widths = drawings.map(([plot]) => plot.clientWidth);
    drawings.forEach(([, draw], k) => draw(widths[k]));
  };
  document.addEventListener("report:redraw", drawAll);
  drawAll();

  let width = window.innerWidth;
  let waiting = 0;
  window.addEventListener("resize", () => {
    if (window.innerWidth === width || window.report.printing) return;
    width = window.innerWidth;
    clearTimeout(waiting);
    waiting = setTimeout(() => document.dispatchEvent(new CustomEvent("report:redraw")), 150);
  });
})();
