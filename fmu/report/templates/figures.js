// Figures that answer: values under the pointer or by arrow keys, zoom along the abscissa, SVG and CSV to keep.
// They are the figures drawn by matplotlib, in whose coordinates the data lie (fmu/report/figure_data.py).

const SVG = "http://www.w3.org/2000/svg";
const draw_in = (parent, tag, attributes, words = "") => {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.textContent = words;
  parent.append(made);
  return made;
};
const digits = x => !Number.isFinite(x) ? "–" : String(+x.toPrecision(5)).replace("-", "−");
const clamp = (x, low, high) => Math.max(low, Math.min(high, x));

// A text as a field: quoted where it must be, and never a formula to a spreadsheet.
const field = value => {
  if (typeof value === "number") return Number.isFinite(value) ? String(+value.toPrecision(7)) : "";
  const text = /^[=+\-@\t\r]/.test(value) && !/^[+\-−]?[\d.]/.test(value) ? `'${value}` : value;
  return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
};
const csv = rows => rows.map(row => row.map(field).join(",")).join("\n") + "\n";

function save(name, type, text) {
  const link = make("a", { download: name, href: URL.createObjectURL(new Blob([text], { type })) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

const tool = (words, label, done) => {
  const made = make("button", { type: "button", class: "tool", "aria-label": label }, words);
  made.addEventListener("click", done);
  return made;
};

class Axis {
  constructor({ range, label, log, named }, start, length) {
    Object.assign(this, { range, label, log, named, start, length });
  }
  get scale() { return this.log ? Math.log10 : x => x; }
  at(x, range = this.range) {
    const [low, high] = range.map(this.scale);
    return this.start + this.length * (this.scale(x) - low) / (high - low);
  }
  value(place) {
    const [low, high] = this.range.map(this.scale), found = low + (high - low) * (place - this.start) / this.length;
    return this.log ? 10 ** found : found;
  }
  // The name of the place that a value is at or beside: marks of several series stand side by side.
  name(x) { return this.named[Object.keys(this.named).find(place => Math.abs(place - x) < 0.5)]; }
  say(x) { return this.name(x) ?? digits(x); }
}

class Panel {
  constructor({ box: [left, top, width, height], title, x, y, series }) {
    Object.assign(this, { left, top, width, height, title, series });
    this.x = new Axis(x, left, width);
    this.y = new Axis(y, top + height, -height);
    for (const one of series) for (const key of ["x", "y", "high", "values"]) if (one[key]) one[key] = numbers(one[key]);
    this.is_path = series.some(one => one.kind === "path" && one.x.length > 8);
  }
  has([x, y], room = 4) {
    return x > this.left - room && x < this.left + this.width + room && y > this.top - room && y < this.top + this.height + room;
  }
  place(s, i) { return [this.x.at(this.series[s].x[i]), this.y.at(this.series[s].y[i])]; }
  nearest([x, y]) {
    let best = [Infinity];
    this.series.forEach((one, s) => {
      for (let i = 0; i < one.x.length; i++) {
        const [px, py] = this.place(s, i), high = one.high ? this.y.at(one.high[i]) : py;
        const dy = y < Math.min(py, high) ? Math.min(py, high) - y : y > Math.max(py, high) ? y - Math.max(py, high) : 0;
        const far = (px - x) ** 2 * (one.kind === "path" ? 4 : 1) + dy ** 2 + (one.kind === "spans" ? 0.5 : 0);
        if (far < best[0]) best = [far, s, i];
      }
    });
    return best.length > 1 ? best.slice(1) : null;
  }
  say(s, i) {
    const one = this.series[s], head = [this.title, one.label].filter(Boolean).join(", ");
    const name = (axis, fallback) => axis.label || fallback;
    const x = `${name(this.x, "x")}: ${this.x.say(one.x[i])}`;
    if (one.values) return `${x}; ${name(this.y, "y")}: ${this.y.say(one.y[i])}; value ${digits(one.values[i])}`;
    const y = `${name(this.y, "y")}: ${this.y.say(one.y[i])}${one.high ? ` to ${this.y.say(one.high[i])}` : ""}`;
    return `${head ? `${head}. ` : ""}${x}; ${y}`;
  }
}

class Figure {
  constructor(box, data) {
    [this.box, this.svg, this.name] = [box, box.querySelector("svg"), box.dataset.name];
    this.panels = data.panels.map(panel => new Panel(panel));
    this.every = data.every;
    const stage = box.querySelector(".drawing");
    this.tip = make("p", { class: "tip", role: "status", hidden: "" });
    stage.append(this.tip);
    stage.tabIndex = 0;
    if (!stage.hasAttribute("role")) stage.setAttribute("role", "group");
    stage.setAttribute("aria-label", `${box.querySelector("figcaption").firstChild.textContent.trim()} Arrow keys read the values.`);
    this.layer = draw_in(this.svg, "g", { "aria-hidden": "true" });
    this.mark = draw_in(this.svg, "circle", { r: 4, fill: "none", stroke: "#d55e00", "stroke-width": 2, visibility: "hidden" });
    this.listen(stage);
  }

  point(event) {
    const box = this.svg.getBoundingClientRect(), { width, height } = this.svg.viewBox.baseVal;
    return [(event.clientX - box.left) * width / box.width, (event.clientY - box.top) * height / box.height];
  }

  listen(stage) {
    let from = null;
    stage.addEventListener("pointermove", event => {
      const at = this.point(event), panel = this.panels.find(one => one.has(at));
      if (from) { this.select(from, at); return; }
      if (panel) this.show(panel, panel.nearest(at)); else this.hide();
    });
    stage.addEventListener("pointerleave", () => { if (!from) this.hide(); });
    stage.addEventListener("pointerdown", event => {
      const at = this.point(event), panel = this.panels.find(one => one.has(at, 0));
      if (event.button || !panel || !this.can_select(panel)) return;
      from = { panel, at };
      stage.setPointerCapture(event.pointerId);
    });
    stage.addEventListener("pointerup", event => {
      if (!from) return;
      const { panel, at } = from, to = this.point(event);
      from = null;
      this.band?.remove();
      if (Math.abs(to[0] - at[0]) > 6) this.chosen(panel, [at[0], to[0]].sort((a, b) => a - b));
    });
    stage.addEventListener("pointercancel", () => { from = null; this.band?.remove(); });
    stage.addEventListener("keydown", event => {
      if (event.target !== stage || event.ctrlKey || event.metaKey || event.altKey) return;
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key], jump = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (event.key === "Escape") { this.hide(); this.reset(); } else if (step) this.step(step); else if (jump) this.jump(jump); else return;
      event.preventDefault();
    });
    stage.addEventListener("blur", () => this.hide());
  }

  select({ panel, at }, to) {
    this.hide();
    this.band?.remove();
    const [a, b] = [at[0], clamp(to[0], panel.left, panel.left + panel.width)].sort((x, y) => x - y);
    this.band = draw_in(this.layer, "rect", { x: a, y: panel.top, width: b - a, height: panel.height, fill: "#0b57a4", opacity: 0.18 });
  }

  show(panel, found) {
    if (!found) return;
    this.current = [panel, ...found];
    const [x, y] = panel.place(...found), scale = this.svg.getBoundingClientRect().width / this.svg.viewBox.baseVal.width;
    this.mark.setAttribute("cx", x);
    this.mark.setAttribute("cy", y);
    this.mark.setAttribute("visibility", "visible");
    this.tip.textContent = panel.say(...found);
    this.tip.hidden = false;
    const stage = this.tip.parentElement;
    this.tip.style.left = `${clamp(x * scale + 10, stage.scrollLeft, Math.max(stage.scrollLeft, stage.scrollLeft + stage.clientWidth - this.tip.offsetWidth))}px`;
    this.tip.style.top = `${clamp(y * scale + 12, 0, Math.max(0, stage.clientHeight - this.tip.offsetHeight))}px`;
  }

  hide() { this.tip.hidden = true; this.mark.setAttribute("visibility", "hidden"); }

  step(by) {
    if (!this.panels.length) return;
    const [panel, s, i] = this.current || [this.panels[0], 0, -by];
    this.show(panel, [s, clamp(i + by, 0, panel.series[s].x.length - 1)]);
  }

  jump(by) {
    const all = this.panels.flatMap(panel => panel.series.map((_, s) => [panel, s]));
    const [panel, s, i] = this.current || [...all[0], 0];
    const [next, k] = all[clamp(all.findIndex(one => one[0] === panel && one[1] === s) + by, 0, all.length - 1)];
    this.show(next, [k, Math.min(i, next.series[k].x.length - 1)]);
  }

  // ---- zoom: the panels of the same abscissa are drawn anew from their data
  can_select(panel) { return panel.is_path; }

  chosen(panel, ends) {
    const range = ends.map(place => panel.x.value(clamp(place, panel.left, panel.left + panel.width)));
    this.full ??= this.panels.map(one => one.x.range);
    for (const one of this.panels)
      if (one.is_path && one.x.label === panel.x.label) one.x.range = range;
    this.redraw();
  }

  reset() {
    this.full?.forEach((range, k) => { this.panels[k].x.range = range; });
    this.full = null;
    this.redraw();
  }

  redraw() {
    this.hide();
    this.layer.replaceChildren();
    this.back?.remove();
    if (!this.full) return;
    const lowest = Math.max(...this.panels.map(one => one.top + one.height));
    this.panels.forEach((panel, k) => {
      if (panel.x.range === this.full[k]) return;
      const inside = draw_in(this.layer, "svg", { x: panel.left, y: panel.top, width: panel.width, height: panel.height,
        viewBox: `${panel.left} ${panel.top} ${panel.width} ${panel.height}` });
      draw_in(inside, "rect", { x: panel.left, y: panel.top, width: panel.width, height: panel.height, style: "fill:var(--paper,#ffffff)" });
      panel.series.forEach((one, s) => {
        const points = [...one.x.keys()].map(i => panel.place(s, i)).filter(([x, y]) => Number.isFinite(y) && x > panel.left - panel.width && x < panel.left + 2 * panel.width);
        if (one.kind === "path") draw_in(inside, "polyline", { points: points.map(p => p.map(x => x.toFixed(1)).join()).join(" "), fill: "none", stroke: one.colour, "stroke-width": 1 });
      });
      const below = this.panels.some(other => other !== panel && other.left < panel.left + panel.width && other.left + other.width > panel.left && other.top > panel.top);
      if (below) return;
      draw_in(this.layer, "rect", { x: panel.left - 12, y: lowest + 1, width: panel.width + 24, height: 15, style: "fill:var(--paper,#ffffff)" });
      for (const t of [0, 0.5, 1])
        draw_in(this.layer, "text", { x: panel.left + t * panel.width, y: lowest + 13, "font-size": 9, "text-anchor": ["start", "middle", "end"][2 * t] },
          digits(panel.x.value(panel.left + t * panel.width)));
    });
    this.back = tool("Show all", "Show the whole abscissa again", () => this.reset());
    this.box.querySelector(".tools").append(this.back);
  }

  rows() {
    const all = this.panels.flatMap(panel => panel.series.flatMap(one => [...one.x.keys()].map(i => [
      panel.title || panel.y.label, one.label, panel.x.name(one.x[i]) ?? one.x[i],
      one.values ? panel.y.say(one.y[i]) : one.y[i], one.values ? one.values[i] : one.high ? one.high[i] : NaN])));
    const [x, y] = ["x", "y"].map(key => [...new Set(this.panels.map(panel => panel[key].label))].filter(Boolean));
    return [["panel", "series", x.length === 1 ? x[0] : "x", y.length === 1 ? y[0] : "y", this.panels.some(panel => panel.series.some(one => one.values)) ? "value" : "upper end"], ...all];
  }
}

function svg_of(figure) {
  const svg = figure.querySelector("svg"), copy = svg.cloneNode(true), { width, height } = svg.viewBox.baseVal;
  for (const [name, value] of Object.entries({ xmlns: SVG, width: `${width}pt`, height: `${height}pt`, "font-family": "sans-serif" }))
    copy.setAttribute(name, value);
  return new XMLSerializer().serializeToString(copy).replace(/var\(--\w+,\s*(#\w+)\)/g, "$1");  // outside the page no scheme is known
}

// Every figure can be kept; its data are read when they are first asked for.
function enliven(figure) {
  const packed = figure.querySelector("script"), name = figure.dataset.name || "figure";
  let made = null;
  const ready = () => made ??= unpack(packed.textContent).then(data => data.pairs ? new Pairs(figure, data) : new Figure(figure, data));
  const tools = make("span", { class: "tools" }, tool("SVG", `Save ${name} as SVG`, () => save(`${name}.svg`, "image/svg+xml", svg_of(figure))));
  if (packed) {
    tools.append(tool("CSV", `Save the data of ${name} as CSV`, () => ready().then(one => save(`${name}.csv`, "text/csv", csv(one.rows())))));
    for (const event of ["pointerenter", "focusin"]) figure.addEventListener(event, ready, { once: true });
    new IntersectionObserver((seen, watch) => { if (seen[0].isIntersecting) { watch.disconnect(); ready(); } }).observe(figure);
  }
  figure.querySelector("figcaption").append(" ", tools);
}
