// A structure in three dimensions: its modes before and after updating, turned, zoomed and animated with WebGL.
// Numbers come from unpack() of data.js. Where there is no WebGL the static picture stays alone.

const VERTEX = `#version 300 es
in vec2 corner;                 // which end, and on which side of the line
in vec3 a, b, da, db, shade;    // ends, their displacements, colour
uniform mat4 camera;
uniform vec2 half_size;         // of the picture, pixels
uniform float swing;
uniform mediump float width;
out vec3 colour;
out float across;               // pixels from the middle of the line
void main() {
  vec4 p = camera * vec4(a + swing * da, 1.0), q = camera * vec4(b + swing * db, 1.0);
  vec2 along = (q.xy / q.w - p.xy / p.w) * half_size;
  float length_ = length(along);
  vec2 unit = length_ > 1e-4 ? along / length_ : vec2(1.0, 0.0);
  vec4 end = mix(p, q, corner.x);
  across = corner.y * (0.5 * width + 1.0);
  vec2 off = across * vec2(-unit.y, unit.x) + (corner.x - 0.5) * 0.5 * width * unit;
  gl_Position = end + vec4(off / half_size * end.w, 0.0, 0.0);
  colour = shade;
}`;
const FRAGMENT = `#version 300 es
precision mediump float;
in vec3 colour;
in float across;
uniform float alpha, width;
out vec4 pixel;
void main() {                   // soft edges: cheaper than samples, which software would have to draw one by one
  float cover = clamp(0.5 * width + 0.5 - abs(across), 0.0, 1.0);
  if (cover < 0.02) discard;
  pixel = vec4(colour, alpha * cover);
}`;

const numbers = list => Array.isArray(list) ? Float32Array.from(list, x => x === null ? NaN : x) : list;
const dot = (axis, list, i) => axis[0] * list[i] + axis[1] * list[i + 1] + axis[2] * list[i + 2];
const hex = text => [1, 3, 5].map(i => parseInt(text.slice(i, i + 2), 16) / 255);
const mix = (a, b, t) => a.map((x, i) => x + t * (b[i] - x));
const make = (tag, attributes = {}, ...children) => {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
};

// Colours of relative values between -1 and 1, or of the share of the largest between 0 and 1.
const [LESS, NEUTRAL, MORE, MUCH, NONE] = ["#d6404e", "#999999", "#3f8fd6", "#a05cc8", "#6e6e6e"].map(hex);
const shade_of = (value, scale, both) => !Number.isFinite(value) ? NONE
  : mix(NEUTRAL, both && value < 0 ? LESS : both ? MORE : MUCH, Math.min(1, Math.abs(value) / (scale || 1)));

function program(gl) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  ["corner", "a", "b", "da", "db", "shade"].forEach((name, i) => gl.bindAttribLocation(made, i, name));
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

const EACH = 15, CORNERS = [0, -1, 0, 1, 1, -1, 1, 1];

// Lines, EACH numbers a line: both ends, their displacements, and the colour; drawn as thin rectangles. Every corner
// has all of them: software draws the instances of a geometry one by one, which takes five times as long.
class Lines {
  constructor(gl) {
    [this.gl, this.n, this.array, this.corners, this.indices] = [gl, 0, gl.createVertexArray(), gl.createBuffer(), gl.createBuffer()];
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    for (let i = 0, at = 0; i < 6; i++) {
      const size = i ? 3 : 2;
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, size, gl.FLOAT, false, 4 * (EACH + 2), 4 * at);
      at += size;
    }
  }
  fill(lines) {
    const gl = this.gl, n = lines.length / EACH, corners = new Float32Array(4 * n * (EACH + 2)), indices = new Uint32Array(6 * n);
    for (let i = 0; i < n; i++) {
      for (let k = 0; k < 4; k++) {
        corners.set(CORNERS.slice(2 * k, 2 * k + 2), (4 * i + k) * (EACH + 2));
        corners.set(lines.subarray(i * EACH, (i + 1) * EACH), (4 * i + k) * (EACH + 2) + 2);
      }
      indices.set([0, 1, 2, 2, 1, 3].map(k => 4 * i + k), 6 * i);
    }
    this.n = n;
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  }
  draw() {
    this.gl.bindVertexArray(this.array);
    this.gl.drawElements(this.gl.TRIANGLES, 6 * this.n, this.gl.UNSIGNED_INT, 0);
  }
}

class StructureView {
  constructor(box, model) {
    for (const key of ["nodes", "ends", "groups", "sites", "measured", "directions", "near"]) model[key] = numbers(model[key]);
    for (const key in model.shapes) model.shapes[key] = numbers(model.shapes[key]);
    for (const one of model.colourings) one.values = numbers(one.values);
    [this.box, this.model] = [box, model];
    this.still = matchMedia("(prefers-reduced-motion: reduce)");
    Object.assign(this, { mode: 0, colouring: 0, phase: Math.PI / 2, playing: !this.still.matches && model.modes.length > 0,
      amplitude: 1, zoom: 1, shown: { before: true, after: true, measured: true }, seen: false, frames: 0 });
    [this.yaw, this.pitch] = model.view;
    const { right, up } = this.axes(), ends = axis => this.ends(i => dot(axis, model.nodes, i));
    const box_ = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map(ends);
    this.centre = box_.map(([low, high]) => (low + high) / 2);
    this.size = Math.max(...box_.map(([low, high]) => high - low)) || 1;
    // what the first view needs, with room for the motion: the scale stays the same while it is turned
    this.extent = [right, up].map(ends).map(([low, high]) => high - low + 0.3 * this.size);
    this.canvas = make("canvas", { tabindex: "0", role: "img", "aria-label": model.label });
    this.gl = this.canvas.getContext("webgl2", { antialias: false, alpha: true, premultipliedAlpha: true });
    if (!this.gl) return;
    this.prepare();
    this.controls();
    this.tip = make("p", { class: "tip", hidden: "" });
    this.box.prepend(this.bar, make("div", { class: "stage" }, this.canvas, this.tip), this.legend);
    this.box.hidden = false;
    this.listen();
    this.resize();
    this.rebuild();
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    new IntersectionObserver(found => { this.seen = found[0].isIntersecting; this.run(); }).observe(this.canvas);
  }

  ends(value) {
    let [low, high] = [Infinity, -Infinity];
    for (let i = 0; i < this.model.nodes.length; i += 3) [low, high] = [Math.min(low, value(i)), Math.max(high, value(i))];
    return [low, high];
  }

  // Directions of the screen in the structure's axes, z upwards.
  axes() {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    return { right: [cy, sy, 0], up: [-sy * sp, cy * sp, cp], away: [-sy * cp, cy * cp, -sp] };
  }

  prepare() {
    const gl = this.gl;
    this.program = program(gl);
    gl.useProgram(this.program);
    this.at = Object.fromEntries(["camera", "half_size", "swing", "width", "alpha"]
      .map(name => [name, gl.getUniformLocation(this.program, name)]));
    this.lines = Object.fromEntries(["rest", "before", "after", "expanded", "arrows"].map(k => [k, new Lines(gl)]));
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.canvas.addEventListener("webglcontextlost", () => { this.box.hidden = true; });
  }

  ink() { return getComputedStyle(this.box).getPropertyValue("--ink").trim(); }

  // ---- what is drawn
  rebuild() {
    const { nodes, ends, shapes, colourings } = this.model, n = ends.length / 2, size = 3 * (nodes.length / 3);
    const moved = name => shapes[name] ? shapes[name].subarray(this.mode * size, (this.mode + 1) * size) : null;
    const found = colourings[this.colouring], ink = hex(this.ink());
    const of = (shape, colour) => {
      const numbers = new Float32Array(EACH * n);
      for (let e = 0; e < n; e++) {
        const [i, j] = [3 * ends[2 * e], 3 * ends[2 * e + 1]];
        const shade = colour(e);
        for (let k = 0; k < 3; k++) {
          numbers[EACH * e + k] = nodes[i + k];
          numbers[EACH * e + 3 + k] = nodes[j + k];
          numbers[EACH * e + 6 + k] = shape ? shape[i + k] : 0;
          numbers[EACH * e + 9 + k] = shape ? shape[j + k] : 0;
          numbers[EACH * e + 12 + k] = shade[k];
        }
      }
      return numbers;
    };
    const coloured = e => found ? shade_of(found.values[e], found.scale, found.both) : hex(this.model.colour);
    const [before, after, expanded] = ["start", "mean", "expanded"].map(moved);
    this.lines.rest.fill(of(null, after ? () => NONE : coloured));
    this.lines.before.fill(before ? of(before, () => hex("#6e6e6e")) : new Float32Array(0));
    this.lines.after.fill(after ? of(after, coloured) : new Float32Array(0));
    this.lines.expanded.fill(expanded ? of(expanded, () => ink) : new Float32Array(0));
    this.lines.arrows.fill(this.arrows(after, ink));
    this.describe();
    this.draw();
  }

  // An arrow goes from a sensor's place at rest to where it was measured, or shows the sensor's direction.
  arrows(after, ink) {
    const { sites, measured, directions, near } = this.model, numbers = [];
    for (let s = 0; s < sites.length / 3; s++) {
      const at = [...sites.subarray(3 * s, 3 * s + 3)];
      let stem = [0, 0, 0], base = [0, 0, 0], fixed = true, to;
      if (measured) {
        to = [...measured.subarray(3 * (this.mode * sites.length / 3 + s)).subarray(0, 3)];
        fixed = false;
      } else {
        to = [...directions.subarray(3 * s, 3 * s + 3)].map(x => 0.06 * this.size * x);
        if (after) base = [...after.subarray(3 * near[s], 3 * near[s] + 3)];
      }
      const length = Math.hypot(...to);
      if (!(length > 0)) continue;
      const other = Math.abs(to[2]) > 0.9 * length ? [1, 0, 0] : [0, 0, 1];
      const cross = [to[1] * other[2] - to[2] * other[1], to[2] * other[0] - to[0] * other[2], to[0] * other[1] - to[1] * other[0]];
      const third = [1, 2, 0].map((j, i) => (cross[j] * to[(j + 1) % 3] - cross[(j + 1) % 3] * to[j]) / length);
      const head = [cross, third].flatMap(side => [0.1, -0.1].map(s =>
        [to, to.map((x, i) => 0.78 * x + s * length * side[i] / Math.hypot(...side))]));
      for (const [from, end] of [[stem, to], ...head])
        numbers.push(...(fixed ? [...at.map((x, i) => x + from[i]), ...at.map((x, i) => x + end[i]), ...base, ...base]
          : [...at, ...at, ...from, ...end]), ...ink);
    }
    return new Float32Array(numbers);
  }

  camera() {
    const [w, h] = [this.canvas.width, this.canvas.height], { right, up, away } = this.axes();
    const pixels = this.zoom * Math.min(w / this.extent[0], h / this.extent[1]), [x, y] = [2 * pixels / w, 2 * pixels / h];
    const rows = [right.map(k => k * x), up.map(k => k * y), away.map(k => k * 0.3 / this.size), [0, 0, 0]];
    const columns = [0, 1, 2].map(i => rows.map(row => row[i]));
    return new Float32Array([...columns.flat(), ...rows.slice(0, 3).map(row => -dot(row, this.centre, 0)), 1]);
  }

  get swing() { return 0.12 * this.size * this.amplitude * Math.sin(this.phase); }

  draw() {
    const gl = this.gl, { width: w, height: h } = this.canvas, ratio = this.ratio;
    gl.viewport(0, 0, w, h);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix4fv(this.at.camera, false, this.camera());
    gl.uniform2f(this.at.half_size, w / 2, h / 2);
    const dense = this.lines.rest.n > 1500, thick = dense ? 1.2 : 3.5, has = this.lines.after.n > 0;
    for (const [name, swing, width, alpha] of [
      ["rest", has && dense ? false : 0, has ? 0.8 : thick, has ? 0.45 : 1], ["before", this.shown.before, 0.6 * thick, 0.7],
      ["expanded", this.shown.measured, 0.4 * thick, 0.9], ["after", this.shown.after, thick, 1],
      ["arrows", this.shown.measured, 1.8, 1]]) {
      if (swing === false) continue;
      gl.clear(gl.DEPTH_BUFFER_BIT);  // what comes later is in front
      gl.uniform1f(this.at.swing, swing === 0 ? 0 : this.swing);
      gl.uniform1f(this.at.width, Math.max(1, width) * ratio);
      gl.uniform1f(this.at.alpha, alpha);
      this.lines[name].draw();
    }
    this.canvas.frames = ++this.frames;
  }

  resize() {
    this.ratio = Math.min(devicePixelRatio || 1, 2);
    [this.canvas.width, this.canvas.height] = [this.canvas.clientWidth, this.canvas.clientHeight].map(x => Math.max(1, Math.round(x * this.ratio)));
    this.draw();
  }

  run() {
    if (this.request || !this.playing || !this.seen || document.hidden) return;
    const step = now => {
      this.phase += this.last ? 2.5 * Math.min(0.1, (now - this.last) / 1000) : 0;
      this.last = now;
      this.draw();
      this.request = this.playing && this.seen ? requestAnimationFrame(step) : (this.last = 0);
    };
    this.request = requestAnimationFrame(step);
  }

  // ---- what is done with it
  controls() {
    const { modes, colourings } = this.model;
    const chooser = (words, names, chosen) => {
      const select = make("select", {}, ...names.map((name, i) => make("option", { value: i }, name)));
      select.addEventListener("change", () => { chosen(+select.value); this.rebuild(); });
      return [select, make("label", {}, words, select)];
    };
    const button = (words, done) => {
      const made = make("button", { type: "button" }, words);
      made.addEventListener("click", done);
      return made;
    };
    this.bar = make("div", { class: "bar", role: "group", "aria-label": "Controls of the drawing" });
    if (modes.length) {
      let label;
      [this.chosen, label] = chooser("Mode ", modes.map(mode => mode.label), k => { this.mode = k; });
      this.play = button("", () => this.toggle());
      const range = make("input", { type: "range", min: "0.1", max: "3", step: "0.1", value: "1" });
      range.addEventListener("input", () => { this.amplitude = +range.value; this.draw(); });
      this.bar.append(label, this.play, make("label", {}, "Amplitude ", range));
    }
    if (colourings.length)
      this.bar.append(chooser("Colour ", [...colourings.map(one => one.label), "none"], k => { this.colouring = k; })[1]);
    for (const [name, angles] of [["x", [Math.PI / 2, 0]], ["y", [0, 0]], ["z", [0, Math.PI / 2]]]) {
      const from = button(name, () => { [this.yaw, this.pitch] = angles; this.draw(); });
      from.setAttribute("aria-label", `Look along ${name}`);
      this.bar.append(from);
    }
    this.bar.append(button("Reset", () => { [this.yaw, this.pitch] = this.model.view; this.zoom = 1; this.draw(); }));
    this.legend = make("div", { class: "key" });
    if (this.play) this.told();
  }

  told() { this.play.textContent = this.playing ? "Pause" : "Animate"; }

  toggle() {
    this.playing = !this.playing;
    if (!this.playing && this.request) { cancelAnimationFrame(this.request); this.request = this.last = 0; }
    this.told();
    this.run();
  }

  describe() {
    const { modes, colourings, colour } = this.model, found = colourings[this.colouring], mode = modes[this.mode];
    const css = shade => `rgb(${shade.map(x => Math.round(255 * x)).join(" ")})`;
    const parts = [];
    const layer = (name, words, background) => {
      const box = make("input", { type: "checkbox" }), swatch = make("span", { class: "swatch", "aria-hidden": "true" });
      box.checked = this.shown[name];
      box.addEventListener("change", () => { this.shown[name] = box.checked; this.draw(); });
      swatch.style.background = background;
      parts.push(make("label", {}, box, swatch, words));
    };
    if (mode) {
      layer("before", `before: ${mode.before}`, "#6e6e6e");
      layer("after", `after: ${mode.after}`, found ? css(found.both ? LESS : MUCH) : colour);
    }
    if (this.lines.arrows.n)
      layer("measured", mode && mode.measured ? `measured: ${mode.measured}` : this.model.measured ? "measured" : "sensors", "var(--ink)");
    if (found) {
      const bar = make("span", { class: "scale", "aria-hidden": "true" });
      bar.style.background = `linear-gradient(90deg, ${(found.both ? [LESS, NEUTRAL, MORE] : [NEUTRAL, MUCH]).map(css).join(", ")})`;
      parts.push(make("span", {}, `${found.label}: ${found.ends[0]} `, bar, ` ${found.ends[1]}`));
    }
    this.legend.replaceChildren(...parts);
    this.canvas.setAttribute("aria-label", `${this.model.label} ${mode ? `Shown: mode ${mode.label}, before ${mode.before}, after ${mode.after}.` : ""} ` +
      "Arrow keys turn it, plus and minus zoom, space animates, Page Up and Page Down choose the mode.");
  }

  turn(dx, dy) {
    this.yaw += dx;
    this.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, this.pitch + dy));
    this.draw();
  }

  enlarge(by) { this.zoom = Math.max(0.3, Math.min(40, this.zoom * by)); this.draw(); }

  choose(k) {
    if (!this.chosen || !this.model.modes[k]) return;
    this.chosen.value = this.mode = k;
    this.rebuild();
  }

  listen() {
    const canvas = this.canvas, fingers = new Map();
    const keys = { ArrowLeft: () => this.turn(-0.1, 0), ArrowRight: () => this.turn(0.1, 0), ArrowUp: () => this.turn(0, 0.1),
      ArrowDown: () => this.turn(0, -0.1), "+": () => this.enlarge(1.15), "=": () => this.enlarge(1.15), "-": () => this.enlarge(1 / 1.15),
      " ": () => this.play && this.toggle(), PageDown: () => this.choose(this.mode + 1), PageUp: () => this.choose(this.mode - 1) };
    canvas.addEventListener("keydown", event => {
      if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key]();
    });
    canvas.addEventListener("pointerdown", event => {
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
    });
    canvas.addEventListener("pointermove", event => {
      const before = fingers.get(event.pointerId), now = [event.clientX, event.clientY];
      if (!before) { this.point(event); return; }
      const apart = () => { const [p, q] = [...fingers.values()]; return Math.hypot(p[0] - q[0], p[1] - q[1]); };
      const spread = fingers.size === 2 ? apart() : 0;
      fingers.set(event.pointerId, now);
      if (fingers.size === 2) this.enlarge(apart() / (spread || 1));
      else this.turn(-(now[0] - before[0]) / 150, (now[1] - before[1]) / 150);
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => fingers.delete(event.pointerId));
    canvas.addEventListener("pointerleave", () => { this.tip.hidden = true; });
    canvas.addEventListener("wheel", event => {  // until it is clicked, the wheel scrolls the page
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      this.enlarge(Math.exp(-event.deltaY / 600));
    }, { passive: false });
    this.still.addEventListener("change", () => { if (this.still.matches && this.playing) this.toggle(); });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.rebuild());
    document.addEventListener("visibilitychange", () => this.run());
  }

  // Say what changes the element under the pointer, with its uncertainty.
  point(event) {
    const { nodes, ends, shapes, groups, tips } = this.model, m = this.camera(), box = this.canvas.getBoundingClientRect();
    const shape = shapes.mean, start = shape ? this.mode * nodes.length : 0, swing = this.swing;
    const place = i => {
      const p = [0, 1, 2].map(k => nodes[3 * i + k] + (shape ? swing * shape[start + 3 * i + k] : 0));
      return [0, 1].map(r => (m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r] + 1) / 2 * (r ? box.height : box.width));
    };
    const [x, y] = [event.clientX - box.left, box.bottom - event.clientY];
    let nearest = 12, found = -1;
    for (let e = 0; e < ends.length / 2; e++) {
      const [a, b] = [place(ends[2 * e]), place(ends[2 * e + 1])], [ux, uy] = [b[0] - a[0], b[1] - a[1]];
      const t = Math.max(0, Math.min(1, ((x - a[0]) * ux + (y - a[1]) * uy) / (ux * ux + uy * uy || 1)));
      const far = Math.hypot(x - a[0] - t * ux, y - a[1] - t * uy);
      if (far < nearest) [nearest, found] = [far, e];
    }
    this.tip.hidden = found < 0;
    if (found < 0) return;
    this.tip.textContent = tips[groups[found]];
    this.tip.style.left = `${Math.min(x + 12, box.width - 180)}px`;
    this.tip.style.top = `${Math.max(0, box.height - y - 50)}px`;
  }
}
