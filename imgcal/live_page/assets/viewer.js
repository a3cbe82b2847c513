"use strict";
// A rig in 3D on a canvas: turned about its up axis, fitted into the canvas, with names that keep apart. A subclass says what
// is drawn: `points()` is what must be in view, `show()` draws it and notes in `spots` what has a name.
const Viewer = (() => {
  const add = (a, b, scale = 1) => [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
  const mean = (points) => points.reduce((sum, p) => add(sum, p, 1 / points.length), [0, 0, 0]);
  const range = (points, i) => points.reduce(([low, high], p) => [Math.min(low, p[i]), Math.max(high, p[i])], [Infinity, -Infinity]);
  const VIEWS = {rest: [-0.7, 0.45], front: [0, 0.06], side: [-Math.PI / 2, 0.06], above: [0, Math.PI / 2]}; // azimuth, elevation
  const DISTANCE = 4; // of the eye, in radii of the rig: a calm perspective
  const PLACES = [12, 22, 34, 46, 60].flatMap((gap) => [0, 0.5, -0.5, 1, -1, 1.6, -1.6, 2.4, -2.4, 3.1].map((turn) => [gap, turn])); // of a name

  class Viewer {
    constructor(canvas) {
      this.canvas = canvas;
      this.basis = null;
      this.spots = [];
      this.pointer = null; // where the pointer is, for the name beside it
      this.probe = canvas.parentElement.appendChild(document.createElement("span"));
      this.probe.hidden = true;
      this.listen();
      this.look("rest");
      new ResizeObserver(() => this.draw()).observe(canvas);
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    }

    orient(up, forward) { // of the rig: unit vectors across each other
      this.basis = {up, forward, right: cross(forward, up)};
      this.draw();
    }
    look(name) {
      [this.azimuth, this.elevation] = VIEWS[name];
      this.magnified = 1;
      this.press(name);
    }
    turn(angle, lift = 0) {
      this.azimuth += angle;
      this.elevation = Math.min(Math.max(this.elevation + lift, -Math.PI / 2), Math.PI / 2);
      this.press(null);
    }
    zoom(factor) {
      this.magnified = Math.min(Math.max(this.magnified * factor, 0.5), 20);
      this.draw();
    }
    press(name) { // the button of the view that is shown
      for (const button of document.querySelectorAll("[data-view]")) button.setAttribute("aria-pressed", String(button.dataset.view === name));
      this.draw();
    }
    pick(name) {} // what was clicked at

    listen() {
      const {canvas} = this;
      for (const button of document.querySelectorAll("[data-view]")) button.addEventListener("click", () => this.look(button.dataset.view));
      for (const button of document.querySelectorAll("[data-zoom]")) button.addEventListener("click", () => this.zoom(+button.dataset.zoom));
      let from = null;
      let dragged = false;
      canvas.addEventListener("pointerdown", (event) => {
        [from, dragged] = [[event.clientX, event.clientY], false];
        canvas.setPointerCapture(event.pointerId);
      });
      canvas.addEventListener("pointermove", (event) => {
        const box = canvas.getBoundingClientRect();
        this.pointer = [event.clientX - box.left, event.clientY - box.top];
        if (!from) return this.draw();
        const [dx, dy] = [event.clientX - from[0], event.clientY - from[1]];
        if (!dragged && Math.hypot(dx, dy) < 4) return;
        [from, dragged] = [[event.clientX, event.clientY], true];
        this.turn(-dx / 160, event.pointerType === "mouse" ? dy / 160 : 0); // a finger that moves up or down scrolls the page
      });
      canvas.addEventListener("pointerup", (event) => {
        const box = canvas.getBoundingClientRect();
        const spot = from && !dragged && this.nearest([event.clientX - box.left, event.clientY - box.top], 26);
        from = null;
        if (spot) this.pick(spot.name);
      });
      canvas.addEventListener("pointercancel", () => { from = null; });
      canvas.addEventListener("pointerleave", () => { this.pointer = null; this.draw(); });
      // The wheel belongs to the page; with Ctrl, which is also what pinching on a touchpad sends, it zooms.
      canvas.addEventListener("wheel", (event) => {
        if (!event.ctrlKey) return;
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY / 300));
      }, {passive: false});
      const keys = {
        ArrowLeft: () => this.turn(0.15), ArrowRight: () => this.turn(-0.15), ArrowUp: () => this.turn(0, 0.15),
        ArrowDown: () => this.turn(0, -0.15), "+": () => this.zoom(1.25), "-": () => this.zoom(0.8),
        0: () => this.look("rest"), Home: () => this.look("rest"),
      };
      canvas.addEventListener("keydown", (event) => {
        if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        keys[event.key]();
      });
    }
    nearest([x, y], reach) {
      const away = ({at}) => Math.hypot(at[0] - x, at[1] - y);
      return this.spots.filter((spot) => away(spot) < reach).sort((a, b) => away(a) - away(b))[0];
    }

    // All drawing happens here, once a frame however often it is asked for.
    draw() {
      if (this.waiting || !this.basis) return;
      this.waiting = true;
      requestAnimationFrame(() => { this.waiting = false; this.paint(); });
    }
    paint() {
      const {canvas} = this;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight];
      if (!width || !height) return;
      const ratio = devicePixelRatio || 1;
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
        [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
      }
      const g = this.g = canvas.getContext("2d");
      g.setTransform(ratio, 0, 0, ratio, 0, 0);
      g.clearRect(0, 0, width, height);
      g.lineJoin = g.lineCap = "round";
      g.textBaseline = "middle";
      this.font = getComputedStyle(canvas).fontFamily;
      this.colours = new Map();
      this.spots = [];
      this.aim(width, height);
      this.show(width, height);
      const spot = this.pointer && this.nearest(this.pointer, 9);
      if (!spot) return;
      const [x, y] = spot.at;
      const right = x < width / 2;
      this.text(spot.name, x + (right ? 10 : -10), y - 12, "--ink", {size: 12, align: right ? "left" : "right"});
    }

    // Direction of view, and the scale and shift that fit everything into the canvas.
    aim(width, height) {
      const {up, forward, right} = this.basis;
      const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
      const ahead = up.map((_, i) => ce * (ca * forward[i] - sa * right[i]) - se * up[i]);
      const across = up.map((_, i) => ca * right[i] + sa * forward[i]);
      const upwards = cross(across, ahead);
      const all = this.points();
      const bounds = [0, 1, 2].map((i) => range(all, i));
      this.middle = bounds.map(([low, high]) => (low + high) / 2);
      this.radius = Math.max(Math.hypot(...bounds.map(([low, high]) => (high - low) / 2)), 1e-9);
      this.view = (p) => {
        const q = add(p, this.middle, -1);
        const depth = dot(q, ahead);
        const k = DISTANCE * this.radius / (DISTANCE * this.radius + depth);
        return [k * dot(q, across), -k * dot(q, upwards), depth];
      };
      const seen = all.map(this.view);
      const [[left, most], [top, bottom]] = [range(seen, 0), range(seen, 1)];
      const margin = Math.min(56, 0.11 * width);
      const fit = Math.min((width - 2 * margin) / Math.max(most - left, 1e-9), (height - 84) / Math.max(bottom - top, 1e-9));
      const scale = this.magnified * fit;
      this.place = (p) => {
        const [x, y, depth] = this.view(p);
        return [width / 2 + scale * (x - (left + most) / 2), height / 2 + scale * (y - (top + bottom) / 2), depth];
      };
      this.directions = {across, upwards};
    }
    colour(name) {
      if (!this.colours.has(name)) { // a canvas wants plain colours: look up what the property is in the present theme
        this.probe.style.color = name.startsWith("--") ? `var(${name})` : name;
        this.colours.set(name, getComputedStyle(this.probe).color);
      }
      return this.colours.get(name);
    }
    path(points) {
      this.g.beginPath();
      points.forEach(([x, y], i) => (i ? this.g.lineTo(x, y) : this.g.moveTo(x, y)));
    }
    stroke(points, colour, width, alpha = 1) {
      this.g.globalAlpha = alpha;
      this.g.strokeStyle = this.colour(colour);
      this.g.lineWidth = width;
      this.path(points);
      this.g.stroke();
      this.g.globalAlpha = 1;
    }
    fill(points, colour, alpha = 1) {
      this.g.globalAlpha = alpha;
      this.g.fillStyle = this.colour(colour);
      this.path(points);
      this.g.fill();
      this.g.globalAlpha = 1;
    }
    disc([x, y], radius, colour, alpha = 1) {
      this.g.globalAlpha = alpha;
      this.g.fillStyle = this.colour(colour);
      this.g.beginPath();
      this.g.arc(x, y, radius, 0, 7);
      this.g.fill();
      this.g.globalAlpha = 1;
    }
    text(words, x, y, colour, {size = 11, align = "left"} = {}) {
      const {g} = this;
      g.font = `${size}px ${this.font}`;
      g.textAlign = align;
      g.lineWidth = 3;
      g.strokeStyle = this.colour("--page");
      g.strokeText(words, x, y);
      g.fillStyle = this.colour(colour);
      g.fillText(words, x, y);
    }

    // Each name goes where no other one is: near its camera, on the side that it is `away` on first; else it is left out.
    names(cameras, taken, width, height, size = 11) { // the first ones choose first
      this.g.font = `${size}px ${this.font}`;
      const free = (box) => box[0] > 2 && box[2] < width - 2 && box[1] > 2 && box[3] < height - 2
        && taken.every((other) => box[2] < other[0] || box[0] > other[2] || box[3] < other[1] || box[1] > other[3]);
      for (const {name, at: [x, y], away, colour = "--ink"} of cameras) {
        const half = this.g.measureText(name).width / 2 + 2;
        for (const [gap, turn] of PLACES) {
          const [cx, cy] = [x + (gap + half) * Math.cos(away + turn), y + (gap + 4) * Math.sin(away + turn)];
          const box = [cx - half, cy - 7, cx + half, cy + 7];
          if (!free(box)) continue;
          taken.push(box);
          if (gap > 22) this.stroke([[x, y], [cx - Math.sign(cx - x) * Math.min(half, Math.abs(cx - x)), cy]], "--muted", 0.7);
          this.text(name, cx - half + 2, cy, colour, {size});
          break;
        }
      }
    }
  }
  return Object.assign(Viewer, {vectors: {add, dot, cross, unit, mean}});
})();
