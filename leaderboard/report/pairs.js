"use strict";
// One pair of entries, cell by cell, below the matrix of pairs.
(() => {
  const { data, element, short } = window.report;
  const SYMBOLS = {
    "+": ["+", "win", "significantly fewer"], "-": ["−", "loss", "significantly more"],
    ".": ["·", "tie", "no significant difference"], "^": ["^", "tie cap", "both at cap"],
    "?": ["?", "tie", "undecided"],
  };
  const opposite = { "+": "-", "-": "+" };

  for (const panel of document.querySelectorAll(".pair")) {
    const section = data.sections[Number(panel.dataset.section)];
    const names = section.entries.map((index) => data.entries[index].label);
    const matrix = document.querySelector(`.matrix[data-section="${panel.dataset.section}"]`);
    const buttons = new Map();
    const choice = (label) => {
      const select = element("select", { "aria-label": label });
      names.forEach((name, place) => select.append(element("option", { value: place }, `${place + 1}  ${name}`)));
      return select;
    };
    const [first, second] = [choice("First entry"), choice("Second entry")];
    const result = element("div", { class: "result", "aria-live": "polite" });
    panel.append(element("div", { class: "choice" }, first, "against", second), result);

    const show = () => {
      const [a, b] = [Number(first.value), Number(second.value)];
      for (const [key, button] of buttons) button.setAttribute("aria-pressed", key === `${a}/${b}`);
      const index = section.pairs.findIndex(([i, j]) => i === Math.min(a, b) && j === Math.max(a, b));
      if (index < 0) return result.replaceChildren(element("p", { class: "note" }, "Choose two different entries."));
      const [i, , runs, cells] = section.pairs[index];
      const words = matrix.tBodies[0].rows[a].cells[b + 1].title;
      const [one, other] = [a, b].map((place) => section.evidence[`${place}/${runs}`]);
      const interval = (numbers, k) => `${short(numbers.s[k])} (${short(numbers.l[k])} to ${short(numbers.h[k])})`;
      const head = element("tr", {}, element("th", { scope: "col" }, `${section.levelName} \\ δ`));
      for (const delta of section.deltas) head.append(element("th", { scope: "col" }, delta));
      const body = element("tbody");
      section.levels.forEach((level, e) => {
        const row = element("tr", {}, element("th", { scope: "row" }, level));
        section.deltas.forEach((delta, d) => {
          const k = e * section.deltas.length + d;
          const [symbol, style, meaning] = SYMBOLS[a === i ? cells[k] : opposite[cells[k]] ?? cells[k]];
          const scaled = (steps) => short(steps).replace(/k$/, section.horizon >= 20000 ? "" : "k");
          const title = `${names[a]}: ${interval(one, k)}\n${names[b]}: ${interval(other, k)}\n${meaning}`;
          row.append(element("td", { class: style, title }, element("b", { "aria-label": meaning }, symbol),
            `${scaled(Math.round(one.s[k]))}/${scaled(Math.round(other.s[k]))}`));
        });
        body.append(row);
      });
      const table = element("table", { class: "cells" }, element("thead", {}, head), body);
      const unit = section.horizon >= 20000 ? "in thousands of steps" : "in steps";
      return result.replaceChildren(
        element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Cells of the pair" }, table),
        element("div", {},
          element("p", { class: "verdict" }, `${words[0].toUpperCase()}${words.slice(1)}.`),
          element("p", { class: "note" }, `${runs} runs each, ${short(section.horizon)} steps. In every cell (ε, δ): ` +
            "+ significantly fewer samples, − significantly more, · no significant difference, ^ both at cap; " +
            `below, Ŝ of both ${unit}.`)),
      );
    };
    for (const [a, row] of [...matrix.tBodies[0].rows].entries()) {
      for (const [b, cell] of [...row.cells].slice(1).entries()) {
        if (a === b) continue;
        const button = element("button", {
          type: "button", "aria-pressed": "false", "aria-label": `${names[a]} against ${names[b]}: ${cell.title}`,
        }, cell.textContent);
        button.addEventListener("click", () => {
          [first.value, second.value] = [a, b];
          show();
        });
        buttons.set(`${a}/${b}`, button);
        cell.replaceChildren(button);
      }
    }
    for (const select of [first, second]) select.addEventListener("change", show);
    [first.value, second.value] = [0, 1];
    panel.hidden = false;
    show();
  }
})();
