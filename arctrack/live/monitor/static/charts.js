// Curves over time, and the profile, on canvases: nothing is kept but typed arrays of a fixed length.

const CAPACITY = 8192;
const VALIDITIES = { VALID: 0, HELD: 1, REFUSED: 2 };
const COLOURS = { ink: "#eef3f7", soft: "#a3b1bd", grid: "#2a3540", panel: "#151c23", green: "#35d48f", amber: "#ffb52e", red: "#ff6257",
  band: "rgba(53, 212, 143, .25)", stripe: "#ff9d2e", expected: "#6ec5ff", joint: "#f487ff" };

const orNaN = (value) => (value === null ? NaN : value);

// The latest points, oldest first from `first` on.
export class Points {
  constructor() {
    this.count = 0;
    this.columns = {};
    for (const name of ["time", "y", "sigmaY", "z", "sigmaZ", "latency"]) this.columns[name] = new Float64Array(CAPACITY);
    this.validity = new Uint8Array(CAPACITY);
  }
  clear() { this.count = 0; }
  // How much of a time, s, is shown: a part of it as long as the points fill no more.
  window(shownS, nowS) {
    const spanS = this.count ? nowS - this.columns.time[this.first % CAPACITY] : 0;
    return spanS > shownS / 3 ? shownS : spanS > shownS / 6 ? shownS / 3 : shownS / 6;
  }
  get first() { return Math.max(0, this.count - CAPACITY); }
  add([time, y, sigmaY, z, sigmaZ, validity, latency]) {
    const k = this.count % CAPACITY, c = this.columns;
    c.time[k] = time; c.y[k] = orNaN(y); c.sigmaY[k] = orNaN(sigmaY); c.z[k] = orNaN(z); c.sigmaZ[k] = orNaN(sigmaZ);
    c.latency[k] = orNaN(latency); this.validity[k] = VALIDITIES[validity] ?? VALIDITIES.REFUSED;
    this.count += 1;
  }
}

// A canvas as large as its place, in the screen's own pixels.
export class Surface {
  constructor(canvas, onResize) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.width = this.height = 0;
    new ResizeObserver(() => { this.fit(); onResize(); }).observe(canvas);
    this.fit();
  }
  fit() {
    const ratio = window.devicePixelRatio || 1, box = this.canvas.getBoundingClientRect();
    this.width = Math.max(1, Math.round(box.width)); this.height = Math.max(1, Math.round(box.height));
    this.canvas.width = Math.round(this.width * ratio); this.canvas.height = Math.round(this.height * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }
  clear() {
    this.context.clearRect(0, 0, this.width, this.height);
    this.context.font = "12px system-ui, 'DejaVu Sans', sans-serif";
    return this.context;
  }
}

function niceStep(span, most) {
  const raw = span / Math.max(1, most), power = 10 ** Math.floor(Math.log10(raw));
  for (const factor of [1, 2, 5]) if (factor * power >= raw * 0.999) return factor * power;
  return 10 * power;
}

export function spelled(value, digits, isSigned = false) {
  if (!Number.isFinite(value)) return "–";
  const text = Math.abs(value).toFixed(digits);
  const isZero = Number(text) === 0;
  return (value < 0 && !isZero ? "−" : isSigned && !isZero && value > 0 ? "+" : "") + text;
}

function decimals(step) { return Math.max(0, -Math.floor(Math.log10(step) + 1e-9)); }

export class TimeChart {
  constructor(canvas, points, name, sigmaName, options) {
    this.points = points; this.name = name; this.sigmaName = sigmaName; this.options = options;
    this.nowS = NaN; this.breakS = 0.5; this.line = NaN;
    this.surface = new Surface(canvas, () => this.draw());
  }
  draw() {
    const context = this.surface.clear(), { width, height } = this.surface;
    const box = { left: 46, right: width - 8, top: 8, bottom: height - 20 };
    if (box.bottom - box.top < 20) return;
    const shownS = this.points.window(this.options.shownS, this.nowS), [low, high] = this.range(shownS);
    const step = niceStep(high - low, (box.bottom - box.top) / 26);
    const bottom = Math.floor(low / step + 1e-9) * step, top = Math.ceil(high / step - 1e-9) * step;
    const yOf = (value) => box.bottom - ((value - bottom) / (top - bottom)) * (box.bottom - box.top);
    const xOf = (timeS) => box.right - ((this.nowS - timeS) / shownS) * (box.right - box.left);
    this.axes(context, box, bottom, top, step, yOf, shownS);
    if (!Number.isFinite(this.nowS)) return;
    context.save();
    context.beginPath(); context.rect(box.left, box.top, box.right - box.left, box.bottom - box.top); context.clip();
    if (this.sigmaName) this.band(context, xOf, yOf);
    this.curve(context, xOf, yOf, VALIDITIES.VALID, this.options.colour);
    if (this.sigmaName) {
      this.curve(context, xOf, yOf, VALIDITIES.HELD, COLOURS.amber, 5);
      this.refusals(context, xOf, box);
    }
    if (Number.isFinite(this.line)) this.level(context, box, yOf);
    context.restore();
  }
  axes(context, box, bottom, top, step, yOf, shownS) {
    context.lineWidth = 1; context.textBaseline = "middle"; context.textAlign = "right";
    const digits = decimals(step);
    for (let value = bottom; value < top + 0.5 * step; value += step) {
      const y = Math.round(yOf(value)) + 0.5;
      context.strokeStyle = Math.abs(value) < 0.01 * step && bottom < 0 ? "#5a6b7a" : COLOURS.grid;
      context.beginPath(); context.moveTo(box.left, y); context.lineTo(box.right, y); context.stroke();
      context.fillStyle = COLOURS.soft; context.fillText(spelled(value, digits), box.left - 6, y);
    }
    context.textBaseline = "top";
    for (let back = 0; back <= shownS; back += shownS / 3) {
      const x = box.right - (back / shownS) * (box.right - box.left);
      context.strokeStyle = COLOURS.grid; context.beginPath(); context.moveTo(x, box.top); context.lineTo(x, box.bottom); context.stroke();
      context.textAlign = back === 0 ? "right" : back === shownS ? "left" : "center";
      context.fillText(back === 0 ? "now" : back % 60 ? `−${back} s` : `−${back / 60} min`, x, box.bottom + 6);
    }
  }
  // Lowest and highest value that are shown; sigmas beyond three times the values' own span do not count.
  range(shownS) {
    const { points, options } = this, values = points.columns[this.name], sigmas = this.sigmaName && points.columns[this.sigmaName];
    let low = Infinity, high = -Infinity;
    for (let n = points.first; n < points.count; n += 1) {
      const k = n % CAPACITY, value = values[k];
      if (!(points.columns.time[k] >= this.nowS - shownS) || Number.isNaN(value)) continue;
      const reach = sigmas && sigmas[k] < options.minSpan ? 2 * sigmas[k] : 0;
      low = Math.min(low, value - reach); high = Math.max(high, value + reach);
    }
    if (Number.isFinite(this.line)) high = Math.max(high, this.line);
    if (options.fromZero) return [0, Math.max(options.minSpan, 1.1 * (Number.isFinite(high) ? high : 0))];
    if (low > high) return [-options.minSpan / 2, options.minSpan / 2];
    const lack = Math.max(0, options.minSpan - (high - low)) / 2;
    return [low - lack, high + lack];
  }
  // Calls `on(k, isNew)` for each point of a validity; a new stretch begins where others lie between, or time.
  stretches(validity, on) {
    const { points } = this, values = points.columns[this.name], time = points.columns.time;
    let before = NaN;
    for (let n = points.first; n < points.count; n += 1) {
      const k = n % CAPACITY;
      const isShown = !Number.isNaN(values[k]) && (!this.sigmaName || points.validity[k] === validity);
      if (isShown) on(k, !(Math.abs(time[k] - before) <= this.breakS));
      before = isShown ? time[k] : NaN;
    }
  }
  curve(context, xOf, yOf, validity, colour, lineWidth = 2) {
    const { points } = this, values = points.columns[this.name], time = points.columns.time;
    context.strokeStyle = colour; context.lineWidth = lineWidth; context.lineJoin = "round"; context.lineCap = "round";
    context.beginPath();
    this.stretches(validity, (k, isNew) => {
      const x = xOf(time[k]), y = yOf(values[k]);
      if (isNew) context.moveTo(x, y);
      context.lineTo(x, y);
    });
    context.stroke();
  }
  band(context, xOf, yOf) {
    const { points } = this, values = points.columns[this.name], sigmas = points.columns[this.sigmaName], time = points.columns.time;
    let before = -1;
    context.fillStyle = COLOURS.band;
    context.beginPath();
    this.stretches(VALIDITIES.VALID, (k, isNew) => {
      if (!isNew && before >= 0 && sigmas[before] > 0 && sigmas[k] > 0) {
        const x0 = xOf(time[before]), x1 = xOf(time[k]);
        context.moveTo(x0, yOf(values[before] + 2 * sigmas[before])); context.lineTo(x1, yOf(values[k] + 2 * sigmas[k]));
        context.lineTo(x1, yOf(values[k] - 2 * sigmas[k])); context.lineTo(x0, yOf(values[before] - 2 * sigmas[before])); context.closePath();
      }
      before = k;
    });
    context.fill();
  }
  refusals(context, xOf, box) {
    const { points } = this;
    let drawn = -1;
    context.fillStyle = COLOURS.red;
    for (let n = points.first; n < points.count; n += 1) {
      const k = n % CAPACITY;
      if (points.validity[k] !== VALIDITIES.REFUSED) continue;
      const x = Math.round(xOf(points.columns.time[k]));
      if (x !== drawn && x >= box.left) context.fillRect(x - 1, box.bottom - 9, 2, 9);
      drawn = x;
    }
  }
  level(context, box, yOf) {
    const y = Math.round(yOf(this.line)) + 0.5;
    context.strokeStyle = COLOURS.ink; context.lineWidth = 1; context.setLineDash([6, 5]);
    context.beginPath(); context.moveTo(box.left, y); context.lineTo(box.right, y); context.stroke(); context.setLineDash([]);
    const text = `99 %: ${spelled(this.line, this.line < 100 ? 1 : 0)} ms`, middle = y < box.top + 18 ? y + 11 : y - 10;
    context.fillStyle = COLOURS.panel; context.fillRect(box.left + 2, middle - 8, context.measureText(text).width + 8, 16);
    context.fillStyle = COLOURS.ink; context.textAlign = "left"; context.textBaseline = "middle";
    context.fillText(text, box.left + 6, middle);
  }
}

export class ProfileChart {
  constructor(canvas) {
    this.profile = null;
    this.surface = new Surface(canvas, () => this.draw());
  }
  show(profile) { this.profile = profile; this.draw(); }
  draw() {
    const context = this.surface.clear(), { width, height } = this.surface, profile = this.profile;
    if (!profile || profile.points.length < 4) {
      context.fillStyle = COLOURS.soft; context.textAlign = "center"; context.textBaseline = "middle"; context.font = "15px system-ui, 'DejaVu Sans', sans-serif";
      context.fillText("no profile in this frame", width / 2, height / 2);
      return;
    }
    const box = { left: 46, right: width - 10, top: 8, bottom: height - 20 };
    const [lowY, highY, lowZ, highZ] = bounds([profile.points, profile.section, profile.expected]);
    const scale = Math.min((box.right - box.left) / (highY - lowY + 0.4), (box.bottom - box.top) / (highZ - lowZ + 0.6));
    const middleY = (lowY + highY) / 2, middleZ = (lowZ + highZ) / 2;
    // The tool's y points to the left of the travel, and so it does here.
    const xOf = (y) => (box.left + box.right) / 2 - (y - middleY) * scale;
    const yOf = (z) => (box.top + box.bottom) / 2 - (z - middleZ) * scale;
    this.axes(context, box, scale, middleY, middleZ, xOf, yOf);
    context.save();
    context.beginPath(); context.rect(box.left, box.top, box.right - box.left, box.bottom - box.top); context.clip();
    polyline(context, profile.expected, xOf, yOf, COLOURS.expected, 1.5, [6, 5]);
    for (let k = 0; k < profile.points.length; k += 2) {
      if (profile.points[k] === null || profile.points[k + 1] === null) continue;
      context.fillStyle = profile.off[k / 2] ? COLOURS.red : COLOURS.stripe;
      context.fillRect(xOf(profile.points[k]) - 1.25, yOf(profile.points[k + 1]) - 1.25, 2.5, 2.5);
    }
    polyline(context, profile.section, xOf, yOf, COLOURS.joint, 2, []);
    context.restore();
  }
  axes(context, box, scale, middleY, middleZ, xOf, yOf) {
    const halfY = (box.right - box.left) / 2 / scale, halfZ = (box.bottom - box.top) / 2 / scale;
    const stepY = niceStep(2 * halfY, (box.right - box.left) / 70), stepZ = niceStep(2 * halfZ, (box.bottom - box.top) / 30);
    context.strokeStyle = COLOURS.grid; context.fillStyle = COLOURS.soft; context.lineWidth = 1;
    context.textAlign = "center"; context.textBaseline = "top";
    for (let y = Math.ceil((middleY - halfY) / stepY) * stepY; y <= middleY + halfY; y += stepY) {
      const x = Math.round(xOf(y)) + 0.5;
      context.beginPath(); context.moveTo(x, box.top); context.lineTo(x, box.bottom); context.stroke();
      if (x > box.left + 8 && x < box.right - 8) context.fillText(spelled(y, decimals(stepY)), x, box.bottom + 6);
    }
    context.textAlign = "right"; context.textBaseline = "middle";
    for (let z = Math.ceil((middleZ - halfZ) / stepZ) * stepZ; z <= middleZ + halfZ; z += stepZ) {
      const y = Math.round(yOf(z)) + 0.5;
      context.beginPath(); context.moveTo(box.left, y); context.lineTo(box.right, y); context.stroke();
      context.fillText(spelled(z, decimals(stepZ)), box.left - 6, y);
    }
  }
}

// Bounds of lines [y, z, y, z, …], to half a millimetre so that they stand still.
function bounds(lines) {
  const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  for (const line of lines) {
    for (let k = 0; k < line.length; k += 1) {
      if (line[k] === null) continue;
      low[k % 2] = Math.min(low[k % 2], line[k]); high[k % 2] = Math.max(high[k % 2], line[k]);
    }
  }
  return [Math.floor(2 * low[0]) / 2, Math.ceil(2 * high[0]) / 2, Math.floor(2 * low[1]) / 2, Math.ceil(2 * high[1]) / 2];
}

export function polyline(context, line, xOf, yOf, colour, lineWidth, dash) {
  context.strokeStyle = colour; context.lineWidth = lineWidth; context.lineJoin = "round"; context.setLineDash(dash);
  context.beginPath();
  let isOpen = false;
  for (let k = 0; k < line.length; k += 2) {
    const isKnown = line[k] !== null && line[k + 1] !== null;
    if (isKnown && isOpen) context.lineTo(xOf(line[k]), yOf(line[k + 1]));
    else if (isKnown) context.moveTo(xOf(line[k]), yOf(line[k + 1]));
    isOpen = isKnown;
  }
  context.stroke(); context.setLineDash([]);
}

export { COLOURS };
