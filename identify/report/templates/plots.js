// Line plots of the reports: zoom by dragging, read-out under the pointer, curves switched by their names.
// The data of each group of plots stands beside it as JSON; no other file is needed.
"use strict";

const MARGIN = { left: 58, right: 10, top: 6, bottom: 22 };
const HEIGHT = 190;

/** Round numbers between two values, about `count` of them. */
function ticks(low, high, count) {
  const raw = (high - low) / Math.max(count, 1);
  if (!(raw > 0) || !isFinite(raw)) return [low];
  const power = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= raw * 0.7) * power;
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found;
}

/** Round numbers between two values of an axis that is logarithmic beyond 1 in both directions. */
function signedTicks(low, high) {
  const most = Math.max(Math.abs(low), Math.abs(high));
  const steps = most < 100 ? [1, 2, 5] : [1];
  const found = [0];
  for (let power = 1; power <= most; power *= 10) steps.forEach((factor) => found.push(factor * power, -factor * power));
  return found.filter((value) => value >= low && value <= high);
}

/** A number with three to four significant digits. */
function text(value) {
  if (value === null || value === undefined || !isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(2);
  return String(Number(value.toPrecision(4)));
}

/** First and last index (inclusive) of the ascending values that lie in [low, high], with one neighbour on each side. */
function span(x, low, high) {
  let first = 0;
  let last = x.length - 1;
  while (first < last && x[first + 1] < low) first++;
  while (last > first && x[last - 1] > high) last--;
  return [first, last];
}

/** Index of the ascending value nearest to `at`. */
function nearest(x, at) {
  let low = 0;
  let high = x.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (x[middle] > at) high = middle;
    else low = middle;
  }
  return Math.abs(x[low] - at) <= Math.abs(x[high] - at) ? low : high;
}

/** Smallest and largest value of the curves that are shown between two indices, with some room around them. */
function extent(plot, shown, first, last) {
  let low = Infinity;
  let high = -Infinity;
  const take = (value) => {
    if (value === null) return;
    low = Math.min(low, value);
    high = Math.max(high, value);
  };
  plot.series.forEach((series, s) => {
    if (!shown[s]) return;
    for (let k = first; k <= last; k++) {
      if (series.y[k] === null) continue;
      const half = series.half ? series.half[k] : 0;
      take(series.y[k] - half);
      take(series.y[k] + half);
    }
  });
  plot.limits.forEach((limit) => take(limit.y));
  if (low > high) return [-1, 1];
  const room = 0.06 * (high - low) || 0.5 * Math.abs(high) || 1;
  return [low - room, high + room];
}

/** A group of plots over the same axis: zoom and pointer are common. */
class Group {
  constructor(root, data) {
    this.root = root;
    const room = data.some((plot) => plot.names.length) ? 0.6 : 0;
    this.whole = [
      Math.min(...data.map((plot) => plot.x[0])) - room,
      Math.max(...data.map((plot) => plot.x[plot.x.length - 1])) + room,
    ];
    this.range = this.whole;
    this.at = null;
    this.plots = data.map((plot) => new Plot(this, plot));
    this.draw();
  }

  zoom(low, high) {
    const least = 1e-6 * (this.whole[1] - this.whole[0]);
    this.range = high - low > least ? [Math.max(low, this.whole[0]), Math.min(high, this.whole[1])] : this.whole;
    this.draw();
  }

  point(at) {
    this.at = at;
    this.draw();
  }

  draw() {
    this.plots.forEach((plot) => plot.draw());
  }
}

/** One plot on a canvas. */
class Plot {
  constructor(group, data) {
    this.group = group;
    this.data = data;
    this.shown = data.series.map(() => true);
    this.drag = null;
    const figure = document.createElement("figure");
    const head = document.createElement("figcaption");
    const title = document.createElement("b");
    title.textContent = `${data.title} [${data.unit}]`;
    head.appendChild(title);
    data.series.forEach((series, s) => head.appendChild(this.key(series, s)));
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `${data.title}: ${data.series.map((series) => series.name).join(", ")}`);
    this.readout = document.createElement("output");
    figure.appendChild(head);
    figure.appendChild(this.canvas);
    figure.appendChild(this.readout);
    group.root.appendChild(figure);
    this.listen();
  }

  key(series, s) {
    const key = document.createElement("button");
    key.type = "button";
    key.textContent = series.name;
    key.style.setProperty("--colour", series.colour);
    key.addEventListener("click", () => {
      this.shown[s] = !this.shown[s];
      key.className = this.shown[s] ? "" : "off";
      this.draw();
    });
    return key;
  }

  listen() {
    const where = (event) => this.toX(event.clientX - this.canvas.getBoundingClientRect().left);
    this.canvas.addEventListener("pointerdown", (event) => {
      this.drag = where(event);
      if (this.canvas.setPointerCapture) this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => this.group.point(where(event)));
    this.canvas.addEventListener("pointerup", (event) => {
      const [low, high] = [this.drag, where(event)].sort((a, b) => a - b);
      const dragged = this.drag !== null && Math.abs(this.toPixel(high) - this.toPixel(low)) > 4;
      this.drag = null;
      if (dragged) this.group.zoom(low, high);
    });
    this.canvas.addEventListener("pointerleave", () => this.group.point(null));
    this.canvas.addEventListener("dblclick", () => this.group.zoom(...this.group.whole));
  }

  get width() {
    return Math.max(this.canvas.clientWidth || 480, 160) - MARGIN.left - MARGIN.right;
  }

  toX(pixel) {
    const [low, high] = this.group.range;
    const share = Math.min(Math.max((pixel - MARGIN.left) / this.width, 0), 1);
    return low + share * (high - low);
  }

  toPixel(x) {
    const [low, high] = this.group.range;
    return MARGIN.left + ((x - low) / (high - low || 1)) * this.width;
  }

  draw() {
    const ratio = (typeof window !== "undefined" && window.devicePixelRatio) || 1;
    const full = this.width + MARGIN.left + MARGIN.right;
    this.canvas.width = Math.round(full * ratio);
    this.canvas.height = Math.round(HEIGHT * ratio);
    this.canvas.style.height = `${HEIGHT}px`;
    const pen = this.canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, full, HEIGHT);
    const [first, last] = span(this.data.x, ...this.group.range);
    const [low, high] = extent(this.data, this.shown, first, last);
    const inside = HEIGHT - MARGIN.top - MARGIN.bottom;
    const scaled = this.data.signed_log ? Math.asinh : (value) => value;
    const toY = (value) => MARGIN.top + ((scaled(high) - scaled(value)) / (scaled(high) - scaled(low))) * inside;
    this.axes(pen, low, high, toY);
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left, MARGIN.top, this.width, inside);
    pen.clip();
    this.data.limits.forEach((limit) => this.line(pen, limit.y, toY));
    this.data.series.forEach((series, s) => {
      if (this.shown[s]) this[series.half ? "points" : "curve"](pen, series, first, last, toY);
    });
    this.pointer(pen);
    pen.restore();
    this.read();
  }

  axes(pen, low, high, toY) {
    pen.font = "11px system-ui, sans-serif";
    pen.lineWidth = 1;
    pen.fillStyle = "#6b7785";
    pen.strokeStyle = "#eceff3";
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    (this.data.signed_log ? signedTicks(low, high) : ticks(low, high, 5)).forEach((value) => {
      this.stroke(pen, MARGIN.left, toY(value), MARGIN.left + this.width, toY(value));
      pen.fillText(text(value), MARGIN.left - 6, toY(value));
    });
    pen.textAlign = "center";
    pen.textBaseline = "top";
    this.marks().forEach(([value, label]) => {
      const pixel = this.toPixel(value);
      this.stroke(pen, pixel, MARGIN.top, pixel, HEIGHT - MARGIN.bottom);
      pen.fillText(label, pixel, HEIGHT - MARGIN.bottom + 5);
    });
  }

  /** Positions and labels of the axis: round numbers, or as many names as there is room for. */
  marks() {
    const { names, x_unit } = this.data;
    const [low, high] = this.group.range;
    if (!names.length) {
      return ticks(low, high, Math.max(2, Math.floor(this.width / 90))).map((x) => [x, `${text(x)} ${x_unit}`]);
    }
    const room = 7 * Math.max(...names.map((name) => name.length)) + 10;
    const every = Math.max(1, Math.ceil((room * (high - low)) / this.width));
    return names.map((name, k) => [k, name]).filter(([k]) => k >= low && k <= high && k % every === 0);
  }

  stroke(pen, x0, y0, x1, y1) {
    pen.beginPath();
    pen.moveTo(x0, y0);
    pen.lineTo(x1, y1);
    pen.stroke();
  }

  line(pen, value, toY) {
    pen.strokeStyle = "#b5403a";
    pen.setLineDash([5, 4]);
    this.stroke(pen, MARGIN.left, toY(value), MARGIN.left + this.width, toY(value));
    pen.setLineDash([]);
  }

  curve(pen, series, first, last, toY) {
    pen.strokeStyle = series.colour;
    pen.lineWidth = series.width;
    pen.beginPath();
    let broken = true;
    for (let k = first; k <= last; k++) {
      if (series.y[k] === null) {
        broken = true;
        continue;
      }
      const [x, y] = [this.toPixel(this.data.x[k]), toY(series.y[k])];
      if (broken) pen.moveTo(x, y);
      else pen.lineTo(x, y);
      broken = false;
    }
    pen.stroke();
  }

  /** Values with intervals; those of one place stand side by side. */
  points(pen, series, first, last, toY) {
    const aside = 7 * (this.data.series.indexOf(series) - (this.data.series.length - 1) / 2);
    pen.strokeStyle = series.colour;
    pen.fillStyle = series.colour;
    pen.lineWidth = series.width;
    for (let k = first; k <= last; k++) {
      if (series.y[k] === null) continue;
      const x = this.toPixel(this.data.x[k]) + aside;
      this.stroke(pen, x, toY(series.y[k] - series.half[k]), x, toY(series.y[k] + series.half[k]));
      pen.fillRect(x - 2.5, toY(series.y[k]) - 2.5, 5, 5);
    }
  }

  pointer(pen) {
    if (this.group.at === null) return;
    const now = this.toPixel(this.group.at);
    if (this.drag !== null) {
      const begin = this.toPixel(this.drag);
      pen.fillStyle = "rgba(47, 111, 159, 0.15)";
      pen.fillRect(Math.min(begin, now), MARGIN.top, Math.abs(now - begin), HEIGHT - MARGIN.top - MARGIN.bottom);
    }
    pen.strokeStyle = "#6b7785";
    pen.lineWidth = 1;
    this.stroke(pen, now, MARGIN.top, now, HEIGHT - MARGIN.bottom);
  }

  read() {
    const { x, x_unit, unit, series, limits, readings } = this.data;
    if (this.group.at === null) {
      const names = limits.map((limit) => `${limit.name} ${text(limit.y)} ${unit}`);
      this.readout.textContent = names.length ? names.join(" · ") : "\u00a0";
      return;
    }
    const k = nearest(x, this.group.at);
    if (readings.length) {
      this.readout.textContent = readings[k];
      return;
    }
    const values = series.map((one) => `${one.name} ${text(one.y[k])} ${unit}`);
    this.readout.textContent = [`${text(x[k])} ${x_unit}`, ...values].join(" · ");
  }
}

/** Build every group of plots of the page. */
function build() {
  const groups = [];
  document.querySelectorAll(".plots").forEach((root) => {
    groups.push(new Group(root, JSON.parse(root.querySelector("script").textContent)));
  });
  const redraw = () => groups.forEach((group) => group.draw());
  window.addEventListener("resize", redraw);
  document.querySelectorAll("details").forEach((each) => each.addEventListener("toggle", redraw));
  return groups;
}

if (typeof module !== "undefined") module.exports = { ticks, signedTicks, text, span, nearest, extent, build };
else build();
