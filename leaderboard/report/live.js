"use strict";
// A page that `qrlsuite view` serves: shows the progress of runs, and loads itself anew when there are new results.
(() => {
  const { element, states } = window.report;
  const EVERY = 2000; // milliseconds
  const panel = document.getElementById("running");
  const [note, table] = [panel.querySelector("[role=status]"), panel.querySelector("table")];
  const KEPT = "qrlsuite-view";

  const restore = () => { // what the reader chose on the last page
    const kept = JSON.parse(sessionStorage.getItem(KEPT) ?? "null");
    sessionStorage.removeItem(KEPT);
    states.forEach((state, k) => {
      if (kept?.chosen[k]?.task === state.task) state.write(kept.chosen[k].state);
    });
    if (kept) window.scrollTo(0, kept.scroll);
  };
  const busy = () => document.activeElement?.matches("input[type=search]:focus, select") || getSelection().toString();
  const renew = () => {
    const chosen = states.map((state) => ({ task: state.task, state: state.read() }));
    sessionStorage.setItem(KEPT, JSON.stringify({ chosen, scroll: window.scrollY }));
    location.reload();
  };

  const show = ({ problem, groups }) => {
    const rows = groups.map((group) => {
      const bar = group.epochs ? element("progress", { max: group.epochs, value: group.epoch ?? 0, "aria-hidden": "true" }) : "";
      return element("tr", {}, element("th", { scope: "row" }, group.entry), element("td", {}, group.seeds),
        element("td", {}, bar, group.epochs ? ` ${group.epoch ?? 0} of ${group.epochs}` : ""), element("td", {}, group.score ?? ""),
        element("td", {}, [group.state, group.left, group.error].filter(Boolean).join(", ")));
    });
    table.tBodies[0].replaceChildren(...rows);
    table.hidden = !rows.length;
    const text = problem || (rows.length ? "" : "Nothing is running.");
    if (note.textContent !== text) note.textContent = text; // or it would be read aloud each time
  };
  const ask = async () => {
    try {
      const answer = await fetch("/progress");
      const progress = await answer.json();
      show(progress);
      if (progress.page !== panel.dataset.page && !busy()) return renew();
    } catch {
      note.textContent = "`qrlsuite view` has ended: this page stays as it is.";
    }
    return setTimeout(ask, EVERY);
  };
  restore();
  ask();
})();
