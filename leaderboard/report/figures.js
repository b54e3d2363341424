"use strict";
// Learning curves and bars, drawn with plotly. Names reach plotly escaped, because it reads labels as markup.
(() => {
  const { data, element, short } = window.report;
  const BASE64 = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  const CODE = Object.fromEntries([...BASE64].map((character, value) => [character, value]));
  const DASHES = ["solid", "dash", "dot", "dashdot"];
  const SHOWN = 8; // entries shown at first
  const BANDS = 5; // bands of more entries would hide the curves
  const CROWD = 8; // values of more entries would fill the picture
  const plain = (text) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
  const brief = (text) => plain(text.length > 44 ? `${text.slice(0, 43)}…` : text);

  const unpack = (text, entry) => {
    const values = new Array(text.length / 2);
    for (let i = 0; i < values.length; i += 1) {
      const code = 64 * CODE[text[2 * i]] + CODE[text[2 * i + 1]];
      values[i] = code === 4095 ? null : entry.low + ((entry.high - entry.low) * code) / 4094;
    }
    return values;
  };
  const probe = element("span", { hidden: true });
  document.body.append(probe);
  const color = (name) => {
    probe.style.color = `var(--${name})`;
    return getComputedStyle(probe).color;
  };
  const look = (entry) => [color(`c${entry.color % 7}`), Math.floor(entry.color / 7) % 4]; // color and pattern
  const faint = (rgb, opacity) => rgb.replace(/^rgb\((.*)\)$/, `rgba($1, ${opacity})`);

  const base = (width) => {
    const [text, muted, line, ground] = ["fg", "muted", "line", "bg"].map(color);
    const axis = { gridcolor: line, zerolinecolor: line, linecolor: muted, tickcolor: muted, fixedrange: true };
    return {
      axis,
      layout: {
        width, paper_bgcolor: ground, plot_bgcolor: ground, showlegend: false, dragmode: false,
        font: { family: getComputedStyle(document.body).fontFamily, size: 12.5, color: text },
        margin: { l: 58, r: 24, t: 10, b: 54 },
        hoverlabel: { bgcolor: ground, bordercolor: line, font: { color: text }, namelength: -1 },
      },
    };
  };

  const drawCurves = (plot, section, shown, singles, pointed) => {
    const { axis, layout } = base(plot.width);
    const traces = [];
    const tops = [];
    section.entries.forEach((index, place) => {
      if (!shown.has(place)) return;
      const entry = data.entries[index];
      const length = Math.floor(section.horizon / entry.steps);
      const x = Array.from({ length }, (_, t) => (t + 1) * entry.steps);
      const [tone, turn] = look(entry);
      const [low, middle, high] = entry.band.map((band) => unpack(band, entry).slice(0, length));
      const common = { type: "scatter", mode: "lines", hoverinfo: "skip" };
      if (shown.size <= BANDS || place === pointed) {
        const crowd = shown.size > 2; // overlapping bands turn gray: then their edges say more than their fill
        traces.push({ ...common, x: [...x, ...x.slice().reverse()], y: [...high, ...low.slice().reverse()],
          fill: "toself", fillcolor: faint(tone, crowd ? 0.06 : 0.13), line: { color: faint(tone, 0.4), width: crowd ? 0.8 : 0 } });
      }
      if (singles) {
        const all = unpack(entry.single, entry);
        const [xs, ys] = [[], []];
        for (let run = 0; run < entry.kept; run += 1) {
          xs.push(...x, null);
          ys.push(...all.slice(run * entry.epochs, run * entry.epochs + length), null);
        }
        traces.push({ ...common, x: xs, y: ys, line: { color: faint(tone, 0.28), width: 0.7 } });
      }
      tops.push({ ...common, x, y: middle, name: brief(entry.legend), hoverinfo: "all",
        line: { color: tone, width: place === pointed ? 3.4 : 2.2, dash: DASHES[turn] }, hovertemplate: "%{y:.3f}" });
    });
    Object.assign(layout, {
      height: plot.width < 600 ? 340 : 440,
      hovermode: shown.size > CROWD ? "closest" : "x unified",
      xaxis: { ...axis, title: { text: "environment steps" }, range: [0, section.horizon], tickformat: "~s", hoverformat: "~s" },
      yaxis: { ...axis, title: { text: section.score }, automargin: true },
      shapes: [{ type: "line", xref: "paper", x0: 0, x1: 1, y0: section.level, y1: section.level,
        line: { color: color("muted"), width: 1, dash: "dash" } }],
    });
    return [[...traces, ...tops], layout];
  };

  const drawBars = (plot, section, shown) => {
    const { axis, layout } = base(plot.width);
    const wide = plot.width >= 600;
    const { levels, deltas, entries } = section.bars;
    const traces = [];
    const [text, muted] = ["fg", "muted"].map(color);
    deltas.forEach((delta, d) => {
      section.entries.forEach((index, place) => {
        if (!shown.has(place)) return;
        const [tone, turn] = look(data.entries[index]);
        const pick = (key) => levels.map((_, e) => entries[place][key][e * deltas.length + d]);
        const [s, l, h] = ["s", "l", "h"].map(pick);
        traces.push({
          type: "bar", x: levels, y: s, xaxis: d ? `x${d + 1}` : "x", yaxis: d ? `y${d + 1}` : "y",
          name: brief(data.entries[index].legend),
          marker: { color: tone, opacity: h.map((high) => (high >= section.horizon ? 0.35 : 1)),
            pattern: { shape: ["", "/", "x", "."][turn], bgcolor: tone, fgcolor: color("bg") } },
          error_y: { type: "data", symmetric: false, array: h.map((v, i) => v - s[i]), arrayminus: s.map((v, i) => v - l[i]),
            color: faint(text, 0.75), thickness: 1.2, width: 2.5 },
          customdata: s.map((_, i) => `${short(s[i])} (${short(l[i])} to ${short(h[i])})`),
          hovertemplate: "%{customdata}",
        });
      });
      const last = d === deltas.length - 1;
      layout[d ? `xaxis${d + 1}` : "xaxis"] = { ...axis, showgrid: false, anchor: d ? `y${d + 1}` : "y",
        title: { text: delta, standoff: 8 } };
      layout[d ? `yaxis${d + 1}` : "yaxis"] = { ...axis, anchor: d ? `x${d + 1}` : "x", range: [0, section.horizon * 1.02],
        tickformat: "~s", title: { text: wide && d ? "" : "environment steps" }, showticklabels: !(wide && d && !last) };
    });
    const grid = wide ? { rows: 1, columns: deltas.length, xgap: 0.08 } : { rows: deltas.length, columns: 1, ygap: 0.28 };
    Object.assign(layout, { height: wide ? 380 : 300 * deltas.length, grid: { ...grid, pattern: "independent" },
      bargap: 0.2, bargroupgap: 0.08, hovermode: "closest" });
    layout.shapes = deltas.map((_, d) => ({ type: "line", xref: `x${d ? d + 1 : ""} domain`, yref: d ? `y${d + 1}` : "y",
      x0: 0, x1: 1, y0: section.horizon, y1: section.horizon, line: { color: muted, width: 1, dash: "dash" } }));
    return [traces, layout];
  };

  const PAPER_WIDTH = 680; // CSS pixels that fit on A4 and letter
  const CONFIG = { displayModeBar: false, displaylogo: false, responsive: false };
  const drawings = [];
  data.sections.forEach((section, number) => {
    const places = section.entries.map((_, place) => place);
    const shown = new Set(places.slice(0, SHOWN));
    const [curves, bars] = ["curves", "bars"].map((kind) =>
      document.querySelector(`.plot[data-section="${number}"][data-kind="${kind}"]`));
    const legend = document.querySelector(`.legend[data-section="${number}"]`);
    const singles = element("input", { type: "checkbox" });
    let pointed = -1;
    const draw = () => {
      for (const [node, make] of [[curves, drawCurves], [bars, drawBars]]) {
        const width = window.report.printing ? PAPER_WIDTH : node.clientWidth;
        window.Plotly.react(node, ...make({ width }, section, shown, singles.checked, pointed), CONFIG);
      }
    };
    legend.classList.toggle("many", places.length > 6);
    places.forEach((place) => {
      const box = element("input", { type: "checkbox", "data-place": place });
      box.checked = shown.has(place);
      box.addEventListener("change", () => {
        if (box.checked) shown.add(place);
        else shown.delete(place);
        draw();
      });
      const swatch = document.querySelectorAll(`#board-${number} .ranks .swatch`)[place].cloneNode(true);
      const label = element("label", {}, box, swatch, element("span", {}, data.entries[section.entries[place]].legend));
      const point = (at) => () => {
        if (at === pointed || (at < 0 && pointed !== place)) return;
        pointed = at;
        window.Plotly.react(curves, ...drawCurves({ width: curves.clientWidth }, section, shown, singles.checked, pointed), CONFIG);
      };
      for (const event of ["pointerenter", "focusin"]) label.addEventListener(event, point(place));
      for (const event of ["pointerleave", "focusout"]) label.addEventListener(event, point(-1));
      legend.append(label);
    });
    singles.addEventListener("change", draw);
    legend.append(element("label", { class: "push" }, singles, "Single runs"));
    for (const [node, kind] of [[curves, "curves"], [bars, "bars"]]) {
      const save = node.closest("figure").querySelector(".save");
      save.addEventListener("click", () => window.Plotly.downloadImage(node, { format: "svg", filename: `${kind}-${number + 1}` }));
      save.hidden = false;
    }
    const thin = section.entries.map((index) => data.entries[index]).find((entry) => entry.kept < entry.runs);
    if (thin) {
      curves.closest("figure").querySelector(".thinned").textContent =
        "Single runs are a selection, evenly spaced by their last score, to keep this file small; median and band use all.";
    }
    legend.hidden = false;
    drawings.push(draw);
  });

  const drawAll = () => drawings.forEach((draw) => draw());
  document.addEventListener("report:redraw", drawAll);
  let width = window.innerWidth;
  let waiting = 0;
  window.addEventListener("resize", () => {
    if (window.innerWidth === width || window.report.printing) return;
    width = window.innerWidth;
    clearTimeout(waiting);
    waiting = setTimeout(drawAll, 150);
  });
  drawAll();
})();
