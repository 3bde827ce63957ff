let now = R.opens; // the position of the frame that is shown

function drawAll() {
  cursors.length = 0;
  for (const chart of CHARTS) drawChart(chart, byId("chart_" + chart.id));
  drawStrip();
  show(now);
}

// The present frame.

function showPicture(view) {
  const missing = byId("frame_missing"), image = byId("frame"), overlay = byId("overlay");
  overlay.replaceChildren();
  image.alt = `frame ${C.frame[now]}`;
  missing.hidden = Boolean(view && view.frame);
  if (view && view.frame) image.src = view.frame;
  else missing.textContent = view ? "this frame could not be read" : "its picture was left out of this long replay; frames near by have theirs: " + neighbours();
  if (!view) return;
  const tenth = (value) => value / 10 + 0.5;
  const line = (points, stroke, width, more) => {
    const d = path(points, tenth, tenth);
    if (d) svg(overlay, "path", { d, stroke, "stroke-width": width, ...more });
  };
  line(view.expected, SKY, 1.5, { "stroke-dasharray": "7 5" });
  line(view.stripe, ORANGE, 1.8);
  const saturated = new Set(view.saturated);
  line(view.stripe.map((point, n) => (saturated.has(n) ? point : null)), VERMILLION, 4, { "stroke-linecap": "round" });
  const size = R.camera.width / 40;
  if (view.truth) svg(overlay, "circle", { cx: tenth(view.truth[0]), cy: tenth(view.truth[1]), r: size * 0.7, stroke: GREEN, "stroke-width": 2.5 });
  if (view.seam) {
    const [x, y] = view.seam.map(tenth);
    for (const [stroke, width] of [["#000", 4.5], [YELLOW, 2.2]]) svg(overlay, "path", { d: `M${x - size} ${y}h${2 * size}M${x} ${y - size}v${2 * size}`, stroke, "stroke-width": width });
  }
}

function showArc(view) {
  const missing = byId("arc_missing"), image = byId("arc");
  missing.hidden = Boolean(view && view.arc);
  if (view && view.arc) image.src = view.arc;
  image.alt = "the arc's light as predicted for this pose";
  const unseen = R.camera.shows_light ? "no prediction: there is no pose from which the joint is seen" : "a profile shows no light";
  missing.textContent = view ? unseen : "left out, as the frame's picture";
  if (!R.camera.shows_light) return;
  const level = C.arc_level[now];
  byId("arc_caption").textContent = "The arc's light predicted for this pose, in the frame's grey scale" + (known(level) ? `, at the arc level found, ${number(level, 2)}.` : ", at the expected level: the frame does not tell the arc's.");
}

function neighbours() {
  const shown = Object.keys(R.shown).map(Number);
  const before = shown.filter((n) => n < now).pop(), after = shown.find((n) => n > now);
  return [before, after].filter(known).map((n) => C.frame[n]).join(" and ");
}

const PROFILE_MARKS = [
  ["measured", GREY, "dot"], ["off the section by more than 5 σ", VERMILLION, "cross"], ["fitted section", GREEN, "line"],
  ["expected section", SKY, "dash"], ["seam point", INK, "plus"],
];

function showProfile(view) {
  const node = byId("profile"), profile = view && view.profile;
  const mm = (point) => point && [point[0] / 1000, point[1] / 1000];
  const points = profile ? profile.points.map(mm) : [];
  const real = points.filter(Boolean);
  const title = "profile in the laser plane, tool frame [mm]" + (profile ? "" : view ? ": this frame has none" : ": left out, as the frame's picture");
  const extent = (k) => real.length ? [Math.min(...real.map((p) => p[k])), Math.max(...real.map((p) => p[k]))] : [-10, 10];
  const [yLow, yHigh] = extent(0), z = extent(1).slice();
  for (const value of [C.true_z_mm[now], C.seam_z_mm[now]]) if (known(value)) { z[0] = Math.min(z[0], value); z[1] = Math.max(z[1], value); }
  const margin = 0.08 * (z[1] - z[0]) + 0.2;
  const plot = axes(node, 236, [yLow - 0.3, yHigh + 0.3], [z[0] - margin, z[1] + margin]);
  legend(node, title, profile ? PROFILE_MARKS : []);
  if (!profile) return;
  svg(plot.area, "path", { d: path(profile.expected.map(mm), plot.x, plot.y), stroke: SKY, "stroke-width": 1.5, "stroke-dasharray": "7 5", fill: "none" });
  const off = new Set(profile.off);
  points.forEach((point, n) => {
    if (!point) return;
    if (off.has(n)) shape(plot.area, "cross", plot.x(point[0]), plot.y(point[1]), VERMILLION);
    else svg(plot.area, "circle", { cx: plot.x(point[0]).toFixed(1), cy: plot.y(point[1]).toFixed(1), r: 1.8, fill: GREY });
  });
  svg(plot.area, "path", { d: path(profile.section.map(mm), plot.x, plot.y), stroke: GREEN, "stroke-width": 2, fill: "none" });
  if (known(C.true_y_mm[now])) svg(plot.area, "circle", { cx: plot.x(C.true_y_mm[now]), cy: plot.y(C.true_z_mm[now]), r: 8, stroke: GREEN, "stroke-width": 2.5, fill: "none" });
  if (known(C.seam_y_mm[now])) shape(plot.area, "plus", plot.x(C.seam_y_mm[now]), plot.y(C.seam_z_mm[now]), INK);
}

const withSigma = (value, sigma) => (known(value) ? `${signed(value, 3)}${known(sigma) ? " ± " + number(sigma, 3) : ""} mm` : "–");

function condition(n) {
  if (!known(C.laser[n])) return "not read";
  const lit = [C.laser[n] ? "laser" : "", C.arc[n] ? "arc" : ""].filter(Boolean).join(" + ") || "dark";
  return lit + (C.arc[n] && known(C.current_a[n]) ? `, ${number(C.current_a[n], 0)} A` : "") + (known(C.exposure_ms[n]) ? `, ${number(C.exposure_ms[n], 2)} ms` : "");
}

function rows(n) {
  const list = [["lit by", condition(n), "lit"]];
  for (const axis of ["y", "z"]) {
    list.push([`seam ${axis}`, withSigma(C[`seam_${axis}_mm`][n], C[`sigma_${axis}_mm`][n]), `seam_${axis}`]);
    const truth = C[`true_${axis}_mm`][n];
    if (known(truth)) list.push([`true ${axis}; error`, `${signed(truth, 3)}; ${known(C[`seam_${axis}_mm`][n]) ? signed(C[`seam_${axis}_mm`][n] - truth, 3) : "–"} mm`, `true_${axis}`]);
  }
  for (const axis of ["y", "z"]) {
    list.push([`offset ${axis} proposed`, withSigma(C[`proposed_${axis}_mm`][n], C[`proposed_sigma_${axis}_mm`][n]), `proposed_${axis}`]);
    list.push([`offset ${axis} on bus`, known(C[`offset_${axis}_mm`][n]) ? `${signed(C[`offset_${axis}_mm`][n], 3)} mm, ${C.bus[n]}` : C.bus[n] === "none" ? "none" : "–", `offset_${axis}`]);
  }
  list.push(["the gate", C.gate[n], "gate"]);
  if (known(C.run[n])) list.push(["the run itself sent", C.run[n], "run"]);
  list.push(["gap; mismatch", `${number(C.gap_mm[n], 3)}; ${signed(C.mismatch_mm[n], 3)} mm`, "gap"]);
  list.push(["seam to view's edge", known(C.fov_margin_mm[n]) ? `${number(C.fov_margin_mm[n], 2)} mm` : "–", "fov_margin"]);
  list.push(["confidence", number(C.confidence[n], 3), "confidence"]);
  list.push(["arc level; map misfit", `${number(C.arc_level[n], 3)}${known(C.arc_level_sigma[n]) ? " ± " + number(C.arc_level_sigma[n], 3) : ""}; ${number(C.map_misfit[n], 2)}`, "arc_level"]);
  list.push(["arc's height", withSigma(C.arc_height_mm[n], C.arc_height_sigma_mm[n]), "arc_height"]);
  list.push(["computed in", known(C.compute_ms[n]) ? `${number(C.compute_ms[n], 1)} ms` : "–", "compute"]);
  return list;
}

function listFlags(list, n) {
  list.replaceChildren();
  for (const flag of raised(n)) {
    const item = html(list, "li", undefined, flag.invalidates ? "refused" : "noted");
    html(item, "b", flag.name);
    item.append(`: ${flag.meaning}${flag.invalidates ? "; the seam is not used" : ""}.`);
  }
  if (!raised(n).length) html(list, "li", "no flags");
}

function showExplanation() {
  const n = now, section = byId("explanation");
  section.classList.toggle("valid", Boolean(C.valid[n]));
  section.classList.toggle("refused", !C.valid[n]);
  byId("explanation_title").textContent = `Why frame ${C.frame[n]} came out so`;
  byId("explanation_verdict").textContent = C.valid[n]
    ? `The seam is at y ${signed(C.seam_y_mm[n], 3)}, z ${signed(C.seam_z_mm[n], 3)} mm in the tool frame.`
    : `It ${known(C.seam_y_mm[n]) ? "shows a seam that is not used" : "gives no seam"}: ` +
      raised(n).filter((flag) => flag.invalidates).map((flag) => flag.meaning).join("; ") + ".";
  listFlags(byId("explanation_flags"), n);
  showChecks(n);
  byId("command").textContent = `${R.explain} ${C.frame[n]}`;
}

// What the step asked of the frame: [asked, answer, demanded, outcome], the flag of what failed in the outcome.
function showChecks(n) {
  const checks = R.checks[n].map((check) => check.map((k) => R.texts[k]));
  const body = byId("explanation_checks").tBodies[0];
  body.replaceChildren();
  for (const check of checks) {
    const row = html(body, "tr");
    for (const text of check) html(row, "td", text);
    row.lastChild.className = check[3].split(":")[0];
  }
  for (const item of byId("explanation_flags").children) {
    const flag = item.firstChild.textContent;
    for (const [asked, answer, demanded, outcome] of checks)
      if (outcome.endsWith(`: ${flag}`)) html(item, "div", `${asked}: ${answer}; demanded: ${demanded}`, "note");
  }
  byId("all_checks").hidden = !R.shown[n] || !checks.length;
  byId("checks_summary").textContent = `All ${checks.length} questions that the tracker asked of it, those that failed first`;
}

function show(asked, message) {
  const n = Math.max(0, Math.min(N - 1, asked));
  if (message !== undefined || n !== now) byId("message").textContent = message || "";
  now = n;
  const view = R.shown[now];
  byId("slider").value = now;
  byId("slider").setAttribute("aria-valuetext", `frame ${C.frame[now]}, ${number(times[now], 3)} s`);
  byId("number").value = C.frame[now];
  byId("time").textContent = `${number(times[now], 3)} s`;
  const state = byId("state");
  state.textContent = C.valid[now] ? "valid" : "no seam to use";
  state.className = "state " + (C.valid[now] ? "valid" : "refused");
  byId("picture").setAttribute("aria-label", `explain frame ${C.frame[now]}`);
  showPicture(view);
  showArc(view);
  showProfile(view);
  const table = byId("numbers");
  table.replaceChildren();
  for (const [name, value, id] of rows(now)) {
    const row = html(table, "tr");
    html(row, "th", name).scope = "row";
    html(row, "td", value).id = "value_" + id;
  }
  listFlags(byId("flags"), now);
  showExplanation();
  for (const [line, x] of cursors) for (const end of ["x1", "x2"]) line.setAttribute(end, x(times[now]));
  remember();
}

function explain(open) {
  const section = byId("explanation");
  section.hidden = !open;
  if (open) {
    section.focus({ preventScroll: true });
    section.scrollIntoView({ block: "nearest" });
  }
  byId("picture").setAttribute("aria-expanded", open);
  remember();
}

// The address says which frame is shown, so that a link opens it.
function remember() {
  if (location.hash !== address()) location.replace(address());
}

const address = () => `#frame=${C.frame[now]}${byId("explanation").hidden ? "" : "&explain"}`;

// A frame's number, typed or from the address. One that is not there leads to the nearest, and the page says so.
function go(asked) {
  const text = asked.trim(), value = text === "" ? NaN : Number(text);
  if (!Number.isFinite(value)) return show(now, `“${text}” is no frame's number; frame ${C.frame[now]} stays`);
  let n = 0;
  C.frame.forEach((frame, k) => { if (Math.abs(frame - value) < Math.abs(C.frame[n] - value)) n = k; });
  show(n, C.frame[n] === value ? "" : `there is no frame ${text}; the nearest is frame ${C.frame[n]}`);
}

function recall() {
  const asked = new URLSearchParams(location.hash.slice(1));
  if (location.hash === address()) return; // the page's own: what it says of it stays
  byId("explanation").hidden = !asked.has("explain");
  if (asked.has("frame")) go(asked.get("frame"));
  else show(now);
}

// Playing keeps the recording's pace, within 1 to 20 frames a second.
let timer = null;
function play(on) {
  clearTimeout(timer);
  timer = null;
  byId("play").textContent = on ? "stop" : "play";
  if (!on) return;
  if (now === N - 1) show(0);
  const next = () => {
    show(now + 1);
    if (now === N - 1) return play(false);
    timer = setTimeout(next, wait());
  };
  const wait = () => Math.min(1000, Math.max(50, 1000 * (times[now + 1] - times[now])));
  timer = setTimeout(next, wait());
}

const KEYS = {
  ArrowLeft: () => show(now - 1), ArrowRight: () => show(now + 1), PageUp: () => show(now - 10), PageDown: () => show(now + 10),
  Home: () => show(0), End: () => show(N - 1), " ": () => play(timer === null), Enter: () => explain(true), Escape: () => explain(false),
};
const NUMBER_KEYS = { ArrowUp: KEYS.ArrowRight, ArrowDown: KEYS.ArrowLeft };
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.target.tagName === "BUTTON" && (event.key === " " || event.key === "Enter")) return;
  const keys = event.target.id === "number" ? NUMBER_KEYS : KEYS;
  if (event.key in keys) {
    event.preventDefault();
    keys[event.key]();
  }
});
byId("slider").oninput = (event) => show(Number(event.target.value));
byId("number").onchange = (event) => go(event.target.value);
byId("before").onclick = () => show(now - 1);
byId("after").onclick = () => show(now + 1);
byId("play").onclick = () => play(timer === null);
byId("picture").onclick = () => explain(byId("explanation").hidden);
byId("close").onclick = () => explain(false);
for (const chart of CHARTS) {
  const figure = html(byId("charts"), "figure");
  html(figure, "div", undefined, "legend");
  svg(figure, "svg", { id: "chart_" + chart.id, role: "img", "aria-label": chart.title + " over time" });
}
window.addEventListener("hashchange", recall);
let width = 0;
window.addEventListener("resize", () => { if (width !== (width = document.body.clientWidth)) drawAll(); });
width = document.body.clientWidth;
recall();
drawAll();
