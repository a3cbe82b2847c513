"use strict";
// A rig in 3D on a canvas, turned about its up axis and fitted into the canvas. Scenes come from `rig_scene`.
const RigView = (() => {
  function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  function cross(a, b) { return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]; }
  function unit(a) { const length = Math.hypot(...a) || 1; return a.map((value) => value / length); }
  function least(points, i) { return points.reduce((low, p) => Math.min(low, p[i]), Infinity); }
  function most(points, i) { return points.reduce((high, p) => Math.max(high, p[i]), -Infinity); }
  function niceStep(raw) {
    const power = 10 ** Math.floor(Math.log10(raw));
    return Number(([1, 2, 5, 10].find((digit) => digit * power >= raw * 0.999) * power).toPrecision(3));
  }
  function mixed(share) { // from the first group to the last: blue, purple, amber; on light and on dark
    const stops = [[79, 131, 232], [184, 96, 196], [240, 160, 48]];
    const [i, part] = share < 0.5 ? [0, 2 * share] : [1, 2 * share - 1];
    return `rgb(${stops[i].map((value, k) => Math.round(value + part * (stops[i + 1][k] - value))).join(",")})`;
  }

  return class RigView {
    constructor(canvas) {
      this.canvas = canvas;
      this.scene = null;
      this.step = 0;
      this.magnified = 1;
      this.probe = canvas.parentElement.appendChild(document.createElement("span"));
      this.probe.hidden = true;
      this.pointer = null; // where the pointer is, for the words beside it
      this.look("oblique");
      this.listen();
      new ResizeObserver(() => this.draw()).observe(canvas);
    }

    set(scene, step = 0) {
      this.scene = scene;
      this.step = step;
      const [u, f] = [unit(scene.up), scene.forward];
      const along = dot(f, u);
      const flat = f.map((value, i) => value - along * u[i]);
      this.basis = {u, f: unit(flat)};
      this.basis.r = cross(this.basis.f, u);
      this.draw();
    }
    look(name) {
      const views = {oblique: [0.7, 0.5], front: [0, 0.06], side: [Math.PI / 2, 0.06], above: [0, Math.PI / 2]};
      [this.azimuth, this.elevation] = views[name];
      this.magnified = 1;
      this.draw();
    }
    turn(angle, lift = 0) {
      this.azimuth += angle;
      this.elevation = Math.min(Math.max(this.elevation + lift, -Math.PI / 2), Math.PI / 2);
      this.draw();
    }
    zoom(factor) {
      this.magnified = Math.min(Math.max(this.magnified * factor, 0.5), 20);
      this.draw();
    }

    listen() {
      const canvas = this.canvas;
      let from = null;
      canvas.addEventListener("pointerdown", (event) => {
        from = [event.clientX, event.clientY];
        canvas.setPointerCapture(event.pointerId);
      });
      canvas.addEventListener("pointermove", (event) => {
        const box = canvas.getBoundingClientRect();
        this.pointer = [event.clientX - box.left, event.clientY - box.top];
        if (!from) return this.draw();
        const [x, y] = from;
        from = [event.clientX, event.clientY];
        this.turn((x - event.clientX) / 160, event.pointerType === "mouse" ? (event.clientY - y) / 160 : 0);
      });
      for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { from = null; });
      canvas.addEventListener("pointerleave", () => { this.pointer = null; this.draw(); });
      // The wheel belongs to the page; with Ctrl, which is also what pinching on a touchpad sends, it zooms.
      canvas.addEventListener("wheel", (event) => {
        if (!event.ctrlKey) return;
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY / 300));
      }, {passive: false});
      const keys = {
        ArrowLeft: () => this.turn(-0.15), ArrowRight: () => this.turn(0.15), ArrowUp: () => this.turn(0, 0.15),
        ArrowDown: () => this.turn(0, -0.15), "+": () => this.zoom(1.25), "-": () => this.zoom(0.8),
        0: () => this.look("oblique"),
      };
      canvas.addEventListener("keydown", (event) => {
        if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        keys[event.key]();
      });
    }

    // All drawing happens here, once a frame however often it is asked for.
    draw() {
      if (this.waiting || !this.scene) return;
      this.waiting = true;
      requestAnimationFrame(() => { this.waiting = false; this.paint(); });
    }
    paint() {
      const {canvas, scene} = this;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight];
      if (!width || !height) return;
      const ratio = devicePixelRatio || 1;
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
        [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
      }
      const g = this.g = canvas.getContext("2d");
      g.setTransform(ratio, 0, 0, ratio, 0, 0);
      g.clearRect(0, 0, width, height);
      this.style = getComputedStyle(canvas);
      this.colours = new Map();
      this.aim(width, height);
      this.grid();
      const cameras = this.cameras();
      const dots = this.dots();
      for (const part of [...cameras, ...dots].sort((a, b) => b.depth - a.depth)) part.paint();
      this.shifts();
      this.names(cameras.filter((camera) => camera.named), width, height);
      this.axes(height);
      this.words(cameras, dots, width);
    }

    // Direction of view, and the scale and shift that fit everything into the canvas.
    aim(width, height) {
      const {u, f, r} = this.basis;
      const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
      const d = u.map((_, i) => ce * (ca * f[i] + sa * r[i]) - se * u[i]);
      const s = u.map((_, i) => ca * r[i] - sa * f[i]);
      const t = cross(s, d);
      const all = this.everything();
      const bounds = [0, 1, 2].map((i) => [least(all, i), most(all, i)]);
      this.middle = bounds.map(([low, high]) => (low + high) / 2);
      this.radius = Math.max(Math.hypot(...bounds.map(([low, high]) => (high - low) / 2)), 1e-9);
      this.view = (p) => {
        const q = p.map((value, i) => value - this.middle[i]);
        const depth = dot(q, d);
        const k = 4 * this.radius / (4 * this.radius + depth);
        return [k * dot(q, s), -k * dot(q, t), depth];
      };
      const seen = all.map(this.view);
      const [left, right, top, bottom] = [least(seen, 0), most(seen, 0), least(seen, 1), most(seen, 1)];
      const margin = Math.min(56, 0.11 * width);
      const fit = Math.min((width - 2 * margin) / Math.max(right - left, 1e-9), (height - 84) / Math.max(bottom - top, 1e-9));
      const scale = this.magnified * fit;
      this.place = (p) => {
        const [x, y, depth] = this.view(p);
        return [width / 2 + scale * (x - (left + right) / 2), height / 2 + scale * (y - (top + bottom) / 2), depth];
      };
      this.directions = {s, t};
    }
    everything() {
      const points = [];
      for (const rig of this.scene.rigs) for (const camera of this.poses(rig)) points.push(...camera);
      for (const group of this.scene.groups) points.push(...group);
      return points;
    }
    poses(rig) { // of each camera: centre, and the corners of its view from the top left one
      return rig.steps[Math.min(this.step, rig.steps.length - 1)];
    }
    colour(name) {
      if (!this.colours.has(name)) { // a canvas wants plain colours: look up what the property is in the present theme
        this.probe.style.color = name.startsWith("--") ? `var(${name})` : name;
        this.colours.set(name, getComputedStyle(this.probe).color);
      }
      return this.colours.get(name);
    }
    near(depth) { // 1 in front, less behind
      return Math.min(Math.max(0.72 - 0.28 * depth / this.radius, 0.35), 1);
    }
    stroke(points, colour, width, alpha = 1) {
      const g = this.g;
      g.globalAlpha = alpha;
      g.strokeStyle = colour;
      g.lineWidth = width;
      g.lineJoin = g.lineCap = "round";
      g.beginPath();
      points.forEach(([x, y], i) => (i ? g.lineTo(x, y) : g.moveTo(x, y)));
      g.stroke();
      g.globalAlpha = 1;
    }
    fill(points, colour, alpha) {
      const g = this.g;
      g.globalAlpha = alpha;
      g.fillStyle = colour;
      g.beginPath();
      points.forEach(([x, y], i) => (i ? g.lineTo(x, y) : g.moveTo(x, y)));
      g.fill();
      g.globalAlpha = 1;
    }
    text(words, x, y, colour, {size = 11, align = "left"} = {}) {
      const g = this.g;
      g.font = `${size}px ${this.style.fontFamily}`;
      g.textAlign = align;
      g.textBaseline = "middle";
      g.lineWidth = 3;
      g.strokeStyle = this.colour("--page");
      g.lineJoin = "round";
      g.strokeText(words, x, y);
      g.fillStyle = colour;
      g.fillText(words, x, y);
    }

    // A level grid under everything, as wide as everything; its step is written beside it.
    grid() {
      const {u, f, r} = this.basis;
      const all = this.everything();
      const low = Math.min(...all.map((p) => dot(p, u)));
      const round = (range) => [Math.floor(range[0] / step), Math.ceil(range[1] / step)];
      const ranges = [f, r].map((axis) => { const at = all.map((p) => dot(p, axis)); return [Math.min(...at), Math.max(...at)]; });
      const step = niceStep(Math.max(...ranges.map(([a, b]) => b - a), 1e-6) / 5);
      const [fs, rs] = ranges.map(round);
      const at = (i, j) => this.place(u.map((_, k) => low * u[k] + i * step * f[k] + j * step * r[k]));
      const line = this.colour("--line");
      for (let i = fs[0]; i <= fs[1]; i += 1) this.stroke([at(i, rs[0]), at(i, rs[1])], line, 1);
      for (let j = rs[0]; j <= rs[1]; j += 1) this.stroke([at(fs[0], j), at(fs[1], j)], line, 1);
      this.text(`grid ${step >= 1000 ? `${step / 1000} m` : `${step} mm`}`, 70, this.canvas.clientHeight - 14, this.colour("--muted"));
    }
    cameras() {
      const parts = [];
      this.scene.rigs.forEach((rig, number) => this.poses(rig).forEach((corners, c) => {
        const name = this.scene.names[c];
        const tone = number > 0 || this.scene.rigs.length === 1 ? (this.scene.tones || {})[name] : undefined;
        const [apex, a, b, cc, d] = corners.map(this.place);
        const colour = this.colour(tone || rig.colour);
        const alpha = this.near(apex[2]) * (rig.filled ? 1 : 0.8);
        const up = [1.25 * (a[0] + b[0]) / 2 - 0.25 * (cc[0] + d[0]) / 2, 1.25 * (a[1] + b[1]) / 2 - 0.25 * (cc[1] + d[1]) / 2];
        parts.push({
          name, apex, depth: apex[2], named: number === this.scene.rigs.length - 1,
          far: [(a[0] + cc[0]) / 2, (a[1] + cc[1]) / 2],
          paint: () => {
            if (rig.filled) {
              for (const side of [[apex, a, b], [apex, b, cc], [apex, cc, d], [apex, d, a]]) this.fill(side, colour, 0.1);
              this.fill([a, up, b], colour, alpha);
            }
            this.stroke([a, b, cc, d, a], colour, rig.filled ? 1.6 : 1.1, alpha);
            for (const corner of [a, b, cc, d]) this.stroke([apex, corner], colour, rig.filled ? 1.2 : 0.9, 0.8 * alpha);
          },
        });
      }));
      return parts;
    }
    shifts() { // from where each camera of the first rig was to where it is in the last
      const [first, last] = [this.scene.rigs[0], this.scene.rigs[this.scene.rigs.length - 1]];
      if (first === last) return;
      const now = this.poses(last);
      this.poses(first).forEach((camera, c) => {
        const [from, to] = [this.place(camera[0]), this.place(now[c][0])];
        if (Math.hypot(to[0] - from[0], to[1] - from[1]) > 2) this.stroke([from, to], this.colour("--before"), 3);
      });
    }
    dots() {
      const {groups, groupNames = []} = this.scene;
      const count = groups.reduce((sum, group) => sum + group.length, 0);
      const size = count < 200 ? 3 : count < 1500 ? 2.2 : 1.3;
      return groups.flatMap((group, i) => {
        const share = groups.length > 1 ? i / (groups.length - 1) : 0;
        const colour = mixed(share);
        return group.map((point, fiducial) => {
          const at = this.place(point);
          return {
            name: `fiducial ${(this.scene.fiducials || [])[fiducial] ?? fiducial}${groupNames[i] ? `, ${groupNames[i]}` : ""}`,
            apex: at, depth: at[2],
            paint: () => {
              this.g.globalAlpha = this.near(at[2]);
              this.g.fillStyle = colour;
              this.g.beginPath();
              this.g.arc(at[0], at[1], size, 0, 7);
              this.g.fill();
              this.g.globalAlpha = 1;
            },
          };
        });
      });
    }

    // Each name goes where no other one is: near its camera, on the side away from what it looks at; else it is left out.
    names(cameras, width, height) {
      const taken = [[0, height - 70, 160, height]]; // the axes
      const free = (box) => box[0] > 2 && box[2] < width - 2 && box[1] > 2 && box[3] < height - 2
        && taken.every((other) => box[2] < other[0] || box[0] > other[2] || box[3] < other[1] || box[1] > other[3]);
      this.g.font = `11px ${this.style.fontFamily}`;
      for (const camera of [...cameras].sort((a, b) => a.depth - b.depth)) {
        const [x, y] = camera.apex;
        const half = this.g.measureText(camera.name).width / 2 + 2;
        const away = Math.atan2(y - camera.far[1], x - camera.far[0]);
        const turns = [0, 0.5, -0.5, 1, -1, 1.6, -1.6, 2.4, -2.4];
        const tried = [12, 24, 40].flatMap((gap) => turns.map((turn) => [gap, away + turn]));
        for (const [gap, angle] of tried) {
          const [cx, cy] = [x + (gap + half) * Math.cos(angle), y + (gap + 4) * Math.sin(angle)];
          const box = [cx - half, cy - 7, cx + half, cy + 7];
          if (!free(box)) continue;
          taken.push(box);
          if (gap > 12) this.stroke([[x, y], [cx - Math.sign(cx - x) * Math.min(half, Math.abs(cx - x)), cy]], this.colour("--muted"), 0.7);
          this.text(camera.name, cx, cy, this.colour("--ink"), {align: "center"});
          break;
        }
      }
    }
    axes(height) {
      const [x, y] = [34, height - 34];
      const {s, t} = this.directions;
      ["x", "y", "z"].forEach((name, i) => {
        const [dx, dy] = [s[i], -t[i]];
        this.stroke([[x, y], [x + 20 * dx, y + 20 * dy]], this.colour("--muted"), 1.4);
        this.text(name, x + 27 * dx, y + 27 * dy, this.colour("--muted"), {align: "center"});
      });
    }
    words(cameras, dots, width) {
      if (!this.pointer) return;
      const away = (part) => Math.hypot(part.apex[0] - this.pointer[0], part.apex[1] - this.pointer[1]);
      const near = [...cameras, ...dots].filter((part) => away(part) < 9).sort((a, b) => away(a) - away(b))[0];
      if (!near) return;
      const right = near.apex[0] < width / 2;
      this.text(near.name, near.apex[0] + (right ? 10 : -10), near.apex[1] - 12, this.colour("--ink"), {size: 12, align: right ? "left" : "right"});
    }
  };
})();
