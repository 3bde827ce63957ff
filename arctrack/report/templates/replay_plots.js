"use strict";
const R = JSON.parse(document.getElementById("replay").textContent);
const C = R.columns;
const N = C.frame.length;
const BLUE = "#0072B2", VERMILLION = "#D55E00", GREEN = "#009E73", ORANGE = "#E69F00", SKY = "#56B4E9";
const YELLOW = "#F0E442", GREY = "#7F7F7F", INK = "#1a1a1a";
const DOTS_UP_TO = 800; // longer series are drawn as lines
const byId = (id) => document.getElementById(id);

// What all drawings need.

function svg(parent, tag, attributes, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}

function html(parent, tag, text, className) {
  const node = document.createElement(tag);
  if (text !== undefined) node.textContent = text;
  if (className) node.className = className;
  parent.append(node);
  return node;
}

const minus = (text) => text.replace("-", "−");
const known = (value) => value !== null && value !== undefined;
const number = (value, digits) => (known(value) ? minus(value.toFixed(digits)) : "–");
const signed = (value, digits) => (known(value) ? (value < 0 ? "" : "+") + number(value, digits) : "–");
// JavaScript's own & knows 32 bits.
const carries = (flags, flag) => Math.floor(flags / flag.mask) % 2 === 1;
const raised = (n) => R.flags.filter((flag) => carries(C.flags[n], flag)).sort((a, b) => b.invalidates - a.invalidates);

function path(points, x, y) {
  let text = "", down = false;
  for (const point of points) {
    if (point) text += (down ? "L" : "M") + x(point[0]).toFixed(1) + " " + y(point[1]).toFixed(1);
    down = Boolean(point);
  }
  return text;
}

function ticks(low, high, most) {
  const rough = (high - low) / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= rough);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const marks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) marks.push([k * step, number(k * step, digits)]);
  return marks;
}

function axes(node, height, xRange, yRange) {
  const width = node.clientWidth, left = 52, right = width - 8, top = 6, bottom = height - 20;
  node.replaceChildren();
  node.setAttribute("viewBox", `0 0 ${width} ${height}`);
  node.style.height = height + "px";
  const x = (value) => left + ((right - left) * (value - xRange[0])) / (xRange[1] - xRange[0]);
  const y = (value) => bottom - ((bottom - top) * (value - yRange[0])) / (yRange[1] - yRange[0]);
  const back = svg(node, "g", {});
  for (const [value, text] of ticks(yRange[0], yRange[1], (bottom - top) / 26)) {
    svg(node, "line", { x1: left, x2: right, y1: y(value), y2: y(value), stroke: "#dddddd" });
    svg(node, "text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, text);
  }
  for (const [value, text] of ticks(xRange[0], xRange[1], (right - left) / 80)) {
    svg(node, "line", { x1: x(value), x2: x(value), y1: bottom, y2: bottom + 4, stroke: GREY });
    svg(node, "text", { x: x(value), y: bottom + 16, "text-anchor": "middle" }, text);
  }
  svg(node, "line", { x1: left, x2: right, y1: bottom, y2: bottom, stroke: GREY });
  const id = "clip_" + node.id;
  svg(svg(node, "clipPath", { id }), "rect", { x: left, y: top, width: right - left, height: bottom - top });
  const area = svg(node, "g", { "clip-path": `url(#${id})` });
  return { node, area, back, x, y, left, right, top, bottom };
}

// The line above a plot: its title, and what each mark means: [text, colour, mark]. The browser breaks it to the width.
function legend(node, title, entries = []) {
  const line = node.parentNode.querySelector(".legend");
  line.replaceChildren();
  html(line, "b", title);
  for (const [text, colour, mark] of entries) {
    const entry = html(line, "span");
    const key = svg(entry, "svg", { viewBox: "0 0 18 12", "aria-hidden": "true" });
    if (mark === "line" || mark === "dash") svg(key, "path", { d: "M0 6H18", stroke: colour, "stroke-width": 2, "stroke-dasharray": mark === "dash" ? "5 3" : "none" });
    else if (mark === "band") svg(key, "rect", { y: 1, width: 18, height: 10, fill: colour, "fill-opacity": 0.35 });
    else shape(key, mark, 9, 6, colour);
    entry.append(text);
  }
}

function shape(parent, mark, x, y, colour) {
  if (mark === "ring") return svg(parent, "circle", { cx: x, cy: y, r: 3.2, fill: "#fff", stroke: colour, "stroke-width": 1.5 });
  if (mark === "cross") return svg(parent, "path", { d: `M${x - 3.5} ${y - 3.5}l7 7m0 -7l-7 7`, stroke: colour, "stroke-width": 1.6, fill: "none" });
  if (mark === "plus") return svg(parent, "path", { d: `M${x - 7} ${y}h14m-7 -7v14`, stroke: colour, "stroke-width": 2.2, fill: "none" });
  return svg(parent, "circle", { cx: x, cy: y, r: 3, fill: colour });
}

// Charts over time.

const CHARTS = [
  { id: "offset_y", title: "offset y, to the left [mm]", value: "offset_y_mm", band: ["proposed_y_mm", "proposed_sigma_y_mm"], hollow: (n) => C.bus[n] === "held" },
  { id: "seam_y", title: "seam y, tool frame [mm]", value: "seam_y_mm", band: ["seam_y_mm", "sigma_y_mm"], truth: "true_y_mm", hollow: (n) => !C.valid[n] },
  { id: "offset_z", title: "offset z, up [mm]", value: "offset_z_mm", band: ["proposed_z_mm", "proposed_sigma_z_mm"], hollow: (n) => C.bus[n] === "held" },
  { id: "seam_z", title: "seam z, tool frame [mm]", value: "seam_z_mm", band: ["seam_z_mm", "sigma_z_mm"], truth: "true_z_mm", hollow: (n) => !C.valid[n] },
  { id: "confidence", title: "confidence", value: "confidence", range: [0, 1] },
  { id: "arc_level", title: "arc over expected", value: "arc_level", second: "map_misfit", from: 0 },
  { id: "arc_height", title: "arc's height [mm]", value: "arc_height_mm", band: ["arc_height_mm", "arc_height_sigma_mm"] },
];
const cursors = []; // [line, x of a time]
const times = C.time_s;
const span = N > 1 ? [times[0], times[N - 1]] : [times[0] - 0.5, times[0] + 0.5];

function valueRange(chart) {
  if (chart.range) return chart.range;
  const shown = [];
  for (const name of [chart.value, chart.truth, chart.second]) if (name) shown.push(...C[name].filter(known));
  if (!shown.length) return [-1, 1];
  let low = shown.reduce((a, b) => Math.min(a, b)), high = shown.reduce((a, b) => Math.max(a, b));
  if (chart.band) {
    const sigmas = C[chart.band[1]].filter(known).sort((a, b) => a - b);
    const typical = sigmas.length ? sigmas[Math.floor(sigmas.length / 2)] : 0;
    low -= 1.5 * typical;
    high += 1.5 * typical;
  }
  if (chart.from !== undefined) low = chart.from;
  const margin = 0.06 * (high - low) || 0.1;
  return [low === chart.from ? low : low - margin, high + margin];
}

function runs(isIn) {
  const found = [];
  for (let n = 0; n < N; n++) {
    if (!isIn(n)) continue;
    const first = n;
    while (n + 1 < N && isIn(n + 1)) n++;
    found.push([first, n]);
  }
  return found;
}

// A frame's stretch of time ends halfway to its neighbours.
const begin = (n) => (n ? (times[n - 1] + times[n]) / 2 : span[0]);
const end = (n) => (n < N - 1 ? (times[n] + times[n + 1]) / 2 : span[1]);

function shade(plot) {
  for (const [first, last] of runs((n) => !C.valid[n]))
    svg(plot.back, "rect", { x: plot.x(begin(first)), y: plot.top, width: Math.max(1, plot.x(end(last)) - plot.x(begin(first))), height: plot.bottom - plot.top, fill: "#ececec" });
}

function drawChart(chart, node) {
  const plot = axes(node, 132, span, valueRange(chart));
  shade(plot);
  const entries = [];
  if (chart.band) {
    const [middle, sigma] = chart.band;
    for (const [first, last] of runs((n) => known(C[middle][n]) && known(C[sigma][n]))) {
      const upper = [], lower = [];
      for (let n = first; n <= last; n++) {
        upper.push([times[n], C[middle][n] + C[sigma][n]]);
        lower.unshift([times[n], C[middle][n] - C[sigma][n]]);
      }
      const single = first === last;
      svg(plot.area, "path", single
        ? { d: path([upper[0], lower[0]], plot.x, plot.y), stroke: SKY, "stroke-width": 5, "stroke-opacity": 0.5 }
        : { d: path([...upper, ...lower], plot.x, plot.y) + "Z", fill: SKY, "fill-opacity": 0.35 });
    }
    entries.push([chart.id.startsWith("seam") ? "± 1 σ, with calibration" : "± 1 σ, measurement", SKY, "band"]);
  }
  if (chart.truth && C[chart.truth].some(known)) {
    svg(plot.area, "path", { d: path(C[chart.truth].map((v, n) => (known(v) ? [times[n], v] : null)), plot.x, plot.y), stroke: INK, fill: "none" });
    entries.push(["true", INK, "line"]);
  }
  const series = [[chart.value, BLUE, "dot"]];
  if (chart.second) series.push([chart.second, VERMILLION, "cross"]);
  for (const [name, colour, mark] of series) {
    if (N > DOTS_UP_TO) {
      svg(plot.area, "path", { d: path(C[name].map((v, n) => (known(v) ? [times[n], v] : null)), plot.x, plot.y), stroke: colour, "stroke-width": 1.5, "stroke-linecap": "round", fill: "none" });
      continue;
    }
    for (let n = 0; n < N; n++) if (known(C[name][n])) shape(plot.area, chart.hollow && chart.hollow(n) ? "ring" : mark, plot.x(times[n]), plot.y(C[name][n]), colour);
  }
  if (chart.id.startsWith("offset")) entries.push(["sent", BLUE, N > DOTS_UP_TO ? "line" : "dot"], ...(N > DOTS_UP_TO ? [] : [["held", BLUE, "ring"]]));
  if (chart.id.startsWith("seam")) entries.push(["measured", BLUE, N > DOTS_UP_TO ? "line" : "dot"], ...(N > DOTS_UP_TO ? [] : [["not used", BLUE, "ring"]]));
  if (chart.second) entries.push(["arc level", BLUE, N > DOTS_UP_TO ? "line" : "dot"], ["map misfit", VERMILLION, N > DOTS_UP_TO ? "line" : "cross"]);
  legend(node, chart.title, entries);
  follow(plot);
}

function drawStrip() {
  const node = byId("strip");
  const rows = R.flags.filter((flag) => C.flags.some((flags) => carries(flags, flag)));
  rows.sort((a, b) => b.invalidates - a.invalidates);
  const width = node.clientWidth, left = 172, right = width - 8, row = 19, top = 6, bottom = top + row * rows.length + 2;
  const height = bottom + 20;
  node.replaceChildren();
  node.setAttribute("viewBox", `0 0 ${width} ${height}`);
  node.style.height = height + "px";
  const x = (value) => left + ((right - left) * (value - span[0])) / (span[1] - span[0]);
  legend(node, rows.length ? "flags" : "no frame carries a flag");
  const plot = { node, area: node, back: svg(node, "g", {}), x, left, right, top, bottom };
  shade(plot);
  rows.forEach((flag, k) => {
    const y = top + row * k;
    const label = svg(node, "text", { x: left - 8, y: y + 14, "text-anchor": "end" }, (flag.invalidates ? "✕ " : "") + flag.name);
    svg(label, "title", {}, flag.meaning);
    svg(node, "line", { x1: left, x2: right, y1: y + row, y2: y + row, stroke: "#e6e6e6" });
    for (const [first, last] of runs((n) => carries(C.flags[n], flag))) {
      const bar = svg(node, "rect", { x: x(begin(first)), y: y + 4, width: Math.max(2, x(end(last)) - x(begin(first))), height: row - 7, fill: flag.invalidates ? VERMILLION : BLUE });
      svg(bar, "title", {}, `${flag.name}: ${flag.meaning}`);
    }
  });
  for (const [value, text] of ticks(span[0], span[1], (right - left) / 80)) svg(node, "text", { x: x(value), y: bottom + 16, "text-anchor": "middle" }, text);
  follow(plot, true);
}

// The cursor follows the slider, and the slider a click.
function follow(plot, explains) {
  cursors.push([svg(plot.node, "line", { y1: plot.top - 4, y2: plot.bottom, stroke: INK, "stroke-width": 1.5 }), plot.x]);
  const pick = (event) => {
    const share = (event.clientX - plot.node.getBoundingClientRect().left - plot.left) / (plot.right - plot.left);
    if (share > -0.02 && share < 1.02) show(nearest(span[0] + share * (span[1] - span[0])));
  };
  plot.node.onpointerdown = (event) => {
    if (explains && event.target.tagName === "rect") explain(true);
    pick(event);
    plot.node.setPointerCapture(event.pointerId);
  };
  plot.node.onpointermove = (event) => event.buttons && pick(event);
}

function nearest(time) {
  let low = 0, high = N - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle;
    else high = middle;
  }
  return time - times[low] <= times[high] - time ? low : high;
}
