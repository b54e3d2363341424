"use strict";
// Learning curves as an SVG: medians, bands, single runs. Colors are attributes, so that a saved picture keeps them.
(() => {
  const { data, short } = window.report;
  const BASE64 = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  const CODE = Object.fromEntries([...BASE64].map((character, value) => [character, value]));
  const DASHES = ["", "8 4", "2 3", "9 3 2 3"];
  const BANDS = 5; // bands of more entries would hide the curves
  const PAPER_WIDTH = 680; // CSS pixels that fit on A4 and letter
  const [LEFT, RIGHT, TOP, BOTTOM] = [46, 16, 8, 38];

  const unpack = (text, entry) => {
    const values = new Array(text.length / 2);
    for (let i = 0; i < values.length; i += 1) {
      const code = 64 * CODE[text[2 * i]] + CODE[text[2 * i + 1]];
      values[i] = code === 4095 ? null : entry.low + ((entry.high - entry.low) * code) / 4094;
    }
    return values;
  };
  const bands = new Map();
  const bandOf = (index) => { // the 5th percentile, the median and the 95th, epoch by epoch
    if (!bands.has(index)) bands.set(index, data.entries[index].band.map((band) => unpack(band, data.entries[index])));
    return bands.get(index);
  };
  const svg = (name, attributes, ...children) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.append(...children);
    return made;
  };
  // Colors are looked up together: after a change each look-up has the browser style the whole page.
  const probe = document.createElement("span");
  probe.hidden = true;
  const probes = ["fg", "bg", "muted", "line", "c0", "c1", "c2", "c3", "c4", "c5", "c6"].map((name) => {
    const part = document.createElement("i");
    part.style.color = `var(--${name})`;
    probe.append(part);
    return [name, part];
  });
  document.body.append(probe);
  let [palette, font] = [{}, ""];
  const lookUp = () => {
    palette = Object.fromEntries(probes.map(([name, part]) => [name, getComputedStyle(part).color]));
    font = getComputedStyle(document.body).fontFamily;
  };
  lookUp();
  document.addEventListener("report:redraw", lookUp);
  const color = (name) => palette[name];
  const look = (index) => [color(`c${data.entries[index].color % 7}`), DASHES[Math.floor(data.entries[index].color / 7) % 4]];
  const ticks = (low, high, most) => {
    const rough = (high - low) / most;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= rough);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k += 1) found.push(Number((k * step).toFixed(digits)));
    return [found, digits];
  };
  const text = (content, x, y, attributes = {}) => svg("text", { x, y, "font-size": 12, fill: color("muted"), ...attributes }, content);

  // Returns the picture; its `at(share)` moves the cursor to a share of the width and returns its step and the medians
  // there; without a cursor (-1), those at the end.
  window.report.curves = (width, section, picked, singles) => {
    if (window.report.printing) width = PAPER_WIDTH;
    const height = width < 600 ? 180 : 290;
    const shown = picked.map((place) => {
      const index = section.entries[place];
      const entry = data.entries[index];
      const length = Math.floor(section.horizon / entry.steps);
      return { entry, length, look: look(index), band: bandOf(index).map((values) => values.slice(0, length)) };
    });
    const banded = shown.length <= BANDS;
    const runs = shown.map(({ entry, length }) => {
      if (!singles) return [];
      const all = unpack(entry.single, entry);
      return Array.from({ length: entry.kept }, (_, run) => all.slice(run * entry.epochs, run * entry.epochs + length));
    });
    let [low, high] = [section.level, section.level];
    const see = (values) => values.forEach((value) => { // not Math.min(...values): there may be very many
      if (value !== null) [low, high] = [Math.min(low, value), Math.max(high, value)];
    });
    shown.forEach(({ band }) => (banded ? band : [band[1]]).forEach(see));
    runs.flat().forEach(see);
    see(section.policies.map(([, score]) => score));
    const pad = (section.policies.length ? 0.07 : 0.04) * (high - low || 1); // room for a name above its line
    [low, high] = [low - pad, high + pad];

    const x = (steps) => LEFT + ((width - LEFT - RIGHT) * steps) / section.horizon;
    const y = (score) => height - BOTTOM - ((height - TOP - BOTTOM) * (score - low)) / (high - low);
    const point = (score, epoch, steps) => `${x((epoch + 1) * steps).toFixed(1)} ${y(score).toFixed(1)}`;
    const line = (values, steps) => {
      let path = "";
      let pen = "M";
      values.forEach((score, epoch) => {
        if (score === null) pen = "M";
        else [path, pen] = [path + pen + point(score, epoch, steps), "L"];
      });
      return path;
    };
    const picture = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, xmlns: "http://www.w3.org/2000/svg",
      "font-family": font });
    const [scores, digits] = ticks(low, high, height / 42);
    const at = (score) => y(score).toFixed(1);
    for (const score of scores) {
      picture.append(svg("line", { x1: LEFT, x2: width - RIGHT, y1: at(score), y2: at(score), stroke: color("line") }),
        text(score.toFixed(digits), LEFT - 7, y(score) + 4, { "text-anchor": "end" }));
    }
    for (const steps of ticks(0, section.horizon, width / 110)[0]) {
      picture.append(svg("line", { x1: x(steps), x2: x(steps), y1: height - BOTTOM, y2: height - BOTTOM + 4, stroke: color("muted") }),
        text(short(steps), x(steps), height - BOTTOM + 17, { "text-anchor": "middle" }));
    }
    picture.append(
      text(width < 600 ? `score, by environment steps` : `${section.score}, by environment steps`, x(section.horizon / 2), height - 4, { "text-anchor": "middle" }),
      svg("line", { class: "level", x1: LEFT, x2: width - RIGHT, y1: at(section.level), y2: at(section.level), stroke: color("muted"), "stroke-dasharray": "5 4" }));
    let above = -Infinity; // names of policies do not lie on each other
    [...section.policies].sort((one, other) => other[1] - one[1]).forEach(([name, score]) => {
      above = Math.max(y(score) - 4, above + 12);
      picture.append(
        svg("line", { class: "policy", x1: LEFT, x2: width - RIGHT, y1: at(score), y2: at(score), stroke: color("muted"), "stroke-dasharray": "1 4" }),
        text(name, width - RIGHT, above, { "text-anchor": "end", "font-size": 11 }));
    });
    shown.forEach(({ entry, look: [tone], band: [least, , most] }, k) => {
      if (banded) {
        const back = most.map((score, epoch) => (score === null ? "" : `L${point(score, epoch, entry.steps)}`)).reverse().join("");
        const crowd = shown.length > 2; // overlapping bands turn gray: then their edges say more than their fill
        picture.append(svg("path", { class: "band", d: `${line(least, entry.steps)}${back}Z`, fill: tone, "fill-opacity": crowd ? 0.07 : 0.15,
          stroke: tone, "stroke-opacity": crowd ? 0.4 : 0 }));
      }
      if (singles) {
        picture.append(svg("path", { class: "runs", d: runs[k].map((run) => line(run, entry.steps)).join(""), fill: "none", stroke: tone,
          "stroke-opacity": 0.3, "stroke-width": 0.7 }));
      }
    });
    shown.forEach(({ entry, look: [tone, dash], band: [, middle] }) => picture.append(svg("path", { class: "median",
      d: line(middle, entry.steps), fill: "none", stroke: tone, "stroke-width": 2.2, "stroke-dasharray": dash, "stroke-linejoin": "round" })));
    const cursor = svg("line", { class: "cursor", y1: TOP, y2: height - BOTTOM, stroke: color("muted"), visibility: "hidden" });
    picture.append(cursor);
    picture.at = (share) => {
      const inside = Math.min(1, Math.max(0, (share * width - LEFT) / (width - LEFT - RIGHT)));
      const steps = share < 0 ? section.horizon : inside * section.horizon;
      for (const end of ["x1", "x2"]) cursor.setAttribute(end, x(steps).toFixed(1));
      cursor.setAttribute("visibility", share < 0 ? "hidden" : "visible");
      return [steps, shown.map(({ entry, length, band }) => band[1][Math.min(length, Math.max(1, Math.round(steps / entry.steps))) - 1])];
    };
    return picture;
  };

  // Returns a picture as a file that stands alone: with the names of its curves below it.
  window.report.file = (picture, section, picked) => {
    const [width, height] = ["width", "height"].map((name) => Number(picture.getAttribute(name)));
    const alone = picture.cloneNode(true);
    alone.querySelector(".cursor").remove();
    const total = height + 8 + 18 * picked.length;
    alone.setAttribute("height", total);
    alone.setAttribute("viewBox", `0 0 ${width} ${total}`);
    alone.prepend(svg("rect", { width, height: total, fill: color("bg") }));
    picked.forEach((place, k) => {
      const [tone, dash] = look(section.entries[place]);
      const at = height + 12 + 18 * k;
      alone.append(svg("line", { x1: LEFT, x2: LEFT + 26, y1: at, y2: at, stroke: tone, "stroke-width": 2.2, "stroke-dasharray": dash }),
        text(data.entries[section.entries[place]].legend, LEFT + 34, at + 4, { fill: color("fg") }));
    });
    return new Blob([new XMLSerializer().serializeToString(alone)], { type: "image/svg+xml" });
  };
})();
