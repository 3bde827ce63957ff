// The monitor page: hears the run over a WebSocket, and says so at once when it hears nothing.

import { COLOURS, Points, ProfileChart, TimeChart, spelled } from "./charts.js";
import { Picture } from "./picture.js";

const LOST_S = 1, LOOK_MS = 200, RETRY_MS = 1000, REDRAWN_S = 1;
const PICTURE = 1, HEAT = 2;
const LAYERS = ["stripe", "expected", "joint", "heat"];
const SHAPES = {
  TRACKING: "M50 4a46 46 0 1 0 0 92a46 46 0 0 0 0-92zM43 74L20 51l9-9 14 14 29-30 9 9z",
  SEARCHING: "M42 6a36 36 0 1 0 20 66l22 22 10-10-22-22a36 36 0 0 0-30-56zm0 13a23 23 0 1 1 0 46a23 23 0 0 1 0-46z",
  HOLDING: "M16 10h24v80H16zM60 10h24v80H60z",
  NO_OFFSETS: "M50 6L97 90H3zM45 34l2 30h6l2-30zM50 69a6 6 0 1 0 0 12a6 6 0 0 0 0-12z",
  FAULT: "M30 4h40l26 26v40L70 96H30L4 70V30zM43 20l2 42h10l2-42zM50 69a7 7 0 1 0 0 14a7 7 0 0 0 0-14z",
  DISARMED: "M8 8h84v84H8zM21 21v58h58V21z",
  STARTING: "M20 8h60v12L58 50l22 30v12H20V80l22-30L20 20zM33 20l17 22 17-22z",
  NO_SIGNAL: "M14 5L50 41 86 5l9 9L59 50l36 36-9 9L50 59 14 95l-9-9 36-36L5 14z",
};

const byId = (id) => document.getElementById(id);
const texts = new Map();
// Changes a text only where it is another one: a screen reader would read it again.
function say(id, text) {
  if (texts.get(id) === text) return;
  texts.set(id, text);
  byId(id).textContent = text;
}
function show(id, isShown) { byId(id).hidden = !isShown; }

const layers = {};
const points = new Points();
const isCalm = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
const picture = new Picture(byId("image"), layers);
const profile = new ProfileChart(byId("profile"));
const charts = [
  new TimeChart(byId("chart-y"), points, "y", "sigmaY", { shownS: 180, minSpan: 0.4, colour: COLOURS.green }),
  new TimeChart(byId("chart-z"), points, "z", "sigmaZ", { shownS: 180, minSpan: 0.4, colour: COLOURS.green }),
  new TimeChart(byId("chart-latency"), points, "latency", null, { shownS: 180, minSpan: 10, fromZero: true, colour: COLOURS.expected }),
];
let title = document.title, status = null, heardMs = NaN, drawnMs = -Infinity;

function hear(message) {
  heardMs = performance.now();
  if (typeof message === "string") {
    const content = JSON.parse(message);
    if (content.kind === "hello") greet(content);
    else if (content.kind === "points") content.points.forEach((point) => points.add(point));
    else if (content.kind === "status") { status = content; update(); }
    return;
  }
  const view = new DataView(message), length = view.getUint32(4, true);
  const content = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 8, length)));
  const rest = new Uint8Array(message, 8 + length);
  if (view.getUint8(0) === HEAT) picture.showHeat(content, rest).catch(() => {});
  else if (view.getUint8(0) === PICTURE) {
    picture.show(content, rest).catch(() => {});
    profile.show(content.profile);
    say("frame", `${content.frame}`);
    say("flags", content.flags.length ? content.flags.join("; ") : "nothing to remark");
  }
}

function greet(content) {
  points.clear();
  content.points.forEach((point) => points.add(point));
  say("title", content.title);
  title = content.title ? `arctrack: ${content.title}` : "arctrack monitor";
  document.querySelectorAll(".save").forEach((button) => { button.hidden = !content.has_black_box; });
  for (const chart of charts) chart.options.shownS = content.shown_s;
}

function update() {
  look();
  if (!("now_s" in status)) return;
  const live = status.source === "LIVE";
  show("source", !live); say("source", live ? "" : status.source);
  say("job", status.job.name ? `${status.job.number} · ${status.job.name}` : `${status.job.number}`);
  say("clock", new Date(1000 * status.wall_s).toLocaleTimeString([], { hour12: false }));
  tiles();
  robot();
  gap();
  const elapsedMs = performance.now() - drawnMs;
  if (isCalm && elapsedMs < 1000 * REDRAWN_S) return;
  drawnMs = performance.now();
  for (const chart of charts) {
    chart.nowS = status.now_s + status.age_s;
    chart.breakS = Math.max(0.5, status.rate_hz > 0 ? 3 / status.rate_hz : 0);
  }
  charts[2].line = status.capture_ms[1] ?? NaN;
  for (const chart of charts) chart.draw();
}

const value = (number, digits, isSigned) => spelled(number ?? NaN, digits, isSigned);
const withSigma = (sigma, digits) => (sigma === null || sigma === undefined ? "" : `± ${sigma.toFixed(digits)}`);

function tiles() {
  for (const axis of ["y", "z"]) {
    const held = status.validity === "HELD" ? "held" : status.validity === "REFUSED" ? "refused" : "";
    say(`offset-${axis}`, value(status[`offset_${axis}_mm`], 2, true));
    say(`sigma-${axis}`, withSigma(status[`sigma_${axis}_mm`], 2) || held);
  }
  say("latency", value(status.capture_ms[1], status.capture_ms[1] < 100 ? 1 : 0));
  say("rate", value(status.rate_hz, 1));
  say("dropped", `${status.dropped}`);
  say("frames", `of ${status.frames + status.dropped}`);
  say("arc-level", status.arc.is_on === false ? "off" : value(status.arc.level, 3));
  say("arc-level-sigma", withSigma(status.arc.level_sigma, 3));
  say("arc-height", value(status.arc.height_mm, 2));
  say("arc-height-sigma", withSigma(status.arc.height_sigma_mm, 2));
}

function robot() {
  const said = status.robot, rows = [["Command", status.command ?? "none", false], ["Laser", status.laser, status.laser === "fault"]];
  if (said === null) rows.push(["Robot", "not heard", true]);
  else {
    if (said.emergency_stop) rows.push(["Emergency stop", "pressed", true]);
    rows.push(["Mode", said.mode], ["Motion", said.motion], ["Welding", said.welding, said.welding === "fault"], ["Arc", said.arc], ["Correction", said.correction]);
    rows.push(["Current", `${value(said.current_a, 0)} A`], ["Travel", `${value(said.speed_mm_s, 1)} mm/s`]);
  }
  if (status.is_too_busy) rows.push(["Machine", "too busy", true]);
  const faults = Object.entries(status.bus_faults);
  if (faults.length) rows.push(["Bus faults", faults.map(([name, count]) => `${name} ${count}`).join(", "), false]);
  const key = JSON.stringify(rows);
  if (texts.get("robot") === key) return;
  texts.set("robot", key);
  byId("robot").replaceChildren(...rows.map(([name, text, isBad]) => {
    const row = document.createElement("div"), term = document.createElement("dt"), detail = document.createElement("dd");
    term.textContent = name; detail.textContent = text; row.className = isBad ? "bad" : "";
    row.append(term, detail);
    return row;
  }));
}

function gap() {
  const report = status.gap, isGap = report !== null && report.is_gap;
  show("gap", isGap);
  if (!isGap) return;
  const since = report.since_wall_s === null ? "" : `, since ${new Date(1000 * report.since_wall_s).toLocaleTimeString([], { hour12: false, hour: "2-digit", minute: "2-digit" })}`;
  say("gap-since", `The map no longer explains what I see${since}.`);
  say("gap-text", report.text);
}

// Says how it stands, or since when nothing is known.
function look() {
  const silentS = (performance.now() - heardMs) / 1000;
  let lost = "", oldS = NaN;
  if (!(silentS <= LOST_S)) { lost = Number.isNaN(silentS) ? "Connecting to the tracker …" : "Connection lost."; oldS = silentS; }
  else if (status && !status.is_alive) { lost = "The tracker has ended."; oldS = status.age_s + silentS; }
  else if (status && "now_s" in status && status.age_s > LOST_S) { lost = "The tracker says nothing."; oldS = status.age_s + silentS; }
  const isStale = lost !== "";
  document.body.classList.toggle("stale", isStale);
  show("lost", isStale); say("lost-what", lost);
  say("lost-age", Number.isNaN(oldS) ? "" : `What is shown is ${age(oldS)} old.`);
  if (!status) return;
  const name = isStale || !(status.indication in SHAPES) ? "NO_SIGNAL" : status.indication;
  // Colour and shape follow what goes out. The word is the state, unless nothing goes out.
  const word = (name.startsWith("NO_") ? name : status.state).replace("_", " ");
  if (document.body.dataset.state !== name || !byId("shape").getAttribute("d")) {
    document.body.dataset.state = name;
    byId("shape").setAttribute("d", SHAPES[name]);
  }
  say("word", word);
  const without = status.indication === "NO_OFFSETS" ? " without offsets" : "";
  say("reason", isStale ? `It was ${status.state}${without} when it was last heard.` : status.reason);
  document.title = `${word} · ${title}`;
}

function age(seconds) {
  if (seconds < 60) return `${Math.max(1, Math.floor(seconds))} s`;
  return seconds < 3600 ? `${Math.floor(seconds / 60)} min` : `${Math.floor(seconds / 3600)} h`;
}

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (event) => hear(event.data);
  socket.onclose = () => setTimeout(connect, RETRY_MS);
}

async function save() {
  const buttons = document.querySelectorAll(".save");
  buttons.forEach((button) => { button.disabled = true; });
  say("saved", "Saving …");
  try {
    const answer = await (await fetch("/black_box", { method: "POST" })).json();
    say("saved", answer.saved ? `Saved: ${answer.saved}` : `Not saved: ${answer.error}`);
  } catch {
    say("saved", "Not saved: the tracker does not answer.");
  }
  buttons.forEach((button) => { button.disabled = false; });
}

function toggle(name) {
  layers[name] = !layers[name];
  localStorage.setItem(`arctrack-${name}`, layers[name] ? "on" : "off");
  document.querySelector(`[data-layer=${name}]`).setAttribute("aria-pressed", layers[name]);
  picture.draw();
}

for (const name of LAYERS) {
  layers[name] = localStorage.getItem(`arctrack-${name}`) === "off";
  toggle(name);
  document.querySelector(`[data-layer=${name}]`).addEventListener("click", () => toggle(name));
}
document.addEventListener("keydown", (event) => {
  const name = LAYERS[Number(event.key) - 1];
  if (name && !event.ctrlKey && !event.altKey && !event.metaKey) toggle(name);
});
document.querySelectorAll(".save").forEach((button) => button.addEventListener("click", save));
byId("shape").setAttribute("d", SHAPES.NO_SIGNAL);
// A token in the address has become a cookie: it need not stay in the history.
if (location.search) history.replaceState(null, "", location.pathname);
setInterval(look, LOOK_MS);
connect();
