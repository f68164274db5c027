// Parameters and the frequencies that they mean: a range of one parameter chooses draws, in all pairs and all modes.

class Pairs extends Figure {
  constructor(box, data) {
    super(box, { panels: data.pairs.panels.map(panel => ({ ...panel, title: "", series: [] })), every: 1 });
    Object.assign(this, { ...data.pairs, panels: this.panels });
    this.draws = this.columns.map(numbers);
    this.hz = this.modes.map(mode => numbers(mode.hz));
    this.n = this.draws[0].length;
    const parameter = make("select", {}, ...this.names.map((name, k) => make("option", { value: k }, name)));
    this.ends = ["0", "100"].map(value => make("input", { type: "range", min: "0", max: "100", step: "1", value }));
    this.said = make("span", { role: "status" });
    parameter.addEventListener("change", () => { this.column = +parameter.value; this.everything(); });
    this.ends.forEach(end => end.addEventListener("input", () => this.choose()));
    this.parameter = parameter;
    this.column = 0;
    this.strip = make("div", { class: "strip" });
    this.box.append(make("div", { class: "bar", role: "group", "aria-label": "Choose draws by a parameter" },
      make("label", {}, "Draws with ", parameter), make("label", {}, "from ", this.ends[0]), make("label", {}, "to ", this.ends[1]),
      tool("All", "Choose all draws", () => this.everything()), this.said), this.strip);
    this.everything();
  }

  // The least and the largest draw, by which the two sliders are scaled.
  get span() {
    const x = this.draws[this.column];
    return [x.reduce((a, b) => Math.min(a, b)), x.reduce((a, b) => Math.max(a, b))];
  }

  can_select() { return true; }
  show() {}

  chosen(panel, ends) {
    this.column = this.panels.indexOf(panel) % this.names.length;
    this.parameter.value = this.column;
    const [low, high] = this.span;
    ends.map(place => panel.x.value(place)).forEach((x, k) => { this.ends[k].value = clamp(Math.round(100 * (x - low) / (high - low)), 0, 100); });
    this.choose();
  }

  everything() { this.ends.forEach((end, k) => { end.value = 100 * k; }); this.choose(); }

  choose() {
    const [low, high] = this.span, [a, b] = this.ends.map(end => low + (high - low) * end.value / 100).sort((x, y) => x - y);
    const x = this.draws[this.column], all = a <= low && b >= high, slack = 1e-6 * (high - low);
    this.kept = [...x.keys()].filter(i => x[i] >= a - slack && x[i] <= b + slack);
    this.said.textContent = `${[this.names[this.column], digits(a), "to", digits(b), this.units[this.column]].filter(Boolean).join(" ")}: ${this.kept.length} of ${this.n} draws`;
    this.layer.replaceChildren();
    const n = this.names.length;
    if (!all) this.panels.forEach((panel, k) => {
      const [i, j] = [Math.floor(k / n), k % n];
      if (j > i) return;
      if (i === j) {
        if (i === this.column) draw_in(this.layer, "rect", { x: panel.x.at(a), y: panel.top, width: panel.x.at(b) - panel.x.at(a), height: panel.height, fill: "#d55e00", opacity: 0.25 });
        return;
      }
      const path = this.kept.map(d => [panel.x.at(this.draws[j][d]), panel.y.at(this.draws[i][d])]).filter(p => panel.has(p, 0))
        .map(([px, py]) => `M${px.toFixed(1)} ${py.toFixed(1)}h0`).join("");
      draw_in(this.layer, "path", { d: path, fill: "none", style: "stroke:#d55e00;stroke-width:2.2;stroke-linecap:round", opacity: 0.6 });
    });
    this.strip.replaceChildren(...this.modes.map((mode, k) => this.histogram(mode, this.hz[k], all)));
  }

  histogram(mode, hz, all) {
    const [w, h, bins] = [170, 70, 24], low = Math.min(hz.reduce((a, b) => Math.min(a, b)), mode.measured ?? Infinity);
    const high = Math.max(hz.reduce((a, b) => Math.max(a, b)), mode.measured ?? -Infinity), width = (high - low) / bins || 1;
    const counted = which => { const found = new Array(bins).fill(0); for (const i of which) found[clamp(Math.floor((hz[i] - low) / width), 0, bins - 1)]++; return found; };
    const everyone = counted(hz.keys()), some = counted(this.kept), most = Math.max(...everyone), top = Math.max(1, ...some);
    const mean = which => { let sum = 0; for (const i of which) sum += hz[i]; return sum / which.length; };
    const now = mean(this.kept), before = mean([...hz.keys()]);
    const words = `Mode ${mode.label}: ${this.kept.length ? digits(now) : "–"} Hz${all ? "" : ` (all: ${digits(before)})`}`;
    const svg = document.createElementNS(SVG, "svg");
    for (const [name, value] of Object.entries({ viewBox: `0 0 ${w} ${h}`, role: "img",
      "aria-label": `${words}, mean of the chosen draws${mode.measured == null ? "" : `; measured ${digits(mode.measured)} Hz`}.` })) svg.setAttribute(name, value);
    const bars = (counts, largest, colour, opacity) => draw_in(svg, "path", { fill: colour, opacity,
      d: counts.map((c, i) => `M${(i * w / bins).toFixed(1)} ${h}v${(-c / largest * (h - 6)).toFixed(1)}h${(w / bins).toFixed(1)}V${h}z`).join("") });
    bars(everyone, most, "#8c959f", 0.55);
    if (!all) bars(some, top, "#d55e00", 0.65);
    if (mode.measured != null) draw_in(svg, "path", { d: `M${(w * (mode.measured - low) / (high - low || 1)).toFixed(1)} 0V${h}`, style: "stroke:var(--ink);stroke-width:1.5" });
    return make("div", {}, make("p", {}, words), svg);
  }

  rows() {
    const head = [...this.names.map((name, k) => this.units[k] ? `${name} / ${this.units[k]}` : name), ...this.modes.map(mode => `mode ${mode.label} / Hz`)];
    return [head, ...[...this.draws[0].keys()].map(i => [...this.draws, ...this.hz].map(column => column[i]))];
  }
}
