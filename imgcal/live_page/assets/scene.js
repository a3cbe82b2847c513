// The rig in 3D, drawn at rest so that it can be read: short cameras, labels that keep apart, everything in view.

const scene = { azimuth: 0, elevation: 0, drag: null, places: [], bodies: [], due: false };
const VIEWS = { rest: [0.72, 0.38], front: [0, 0.04], side: [Math.PI / 2, 0.04], above: [0, Math.PI / 2 - 0.02] };
const DISTANCE = 3.6; // of the eye, in radii of the rig: a calm perspective

const TRIES = [14, 22, 34, 46].flatMap((reach) => [0, 0.5, -0.5, 1, -1, 1.6, -1.6, 2.4, -2.4, 3.1].map((turn) => [turn, reach])); // places of a label

const add = (a, b, scale = 1) => [a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
const mean = (points) => points.reduce((sum, p) => add(sum, p, 1 / points.length), [0, 0, 0]);

function boxCorners(low, high) {
  const corners = [];
  for (let i = 0; i < 8; i++) corners.push([i & 1 ? high[0] : low[0], i & 2 ? high[1] : low[1], i & 4 ? high[2] : low[2]]);
  return corners;
}

function cameraCorners(i, length) { // apex, then the corners of its image, and where its top is
  const { centres, axes, view } = page.layout, [right, down, ahead] = axes[i], [w, h] = view[i];
  const norm = length / Math.hypot(1, w, h), at = (x, y) => add(add(add(centres[i], ahead, norm), right, x * w * norm), down, y * h * norm);
  return [centres[i], at(-1, -1), at(1, -1), at(1, 1), at(-1, 1)];
}

function eye() { // axes of the view
  const { up, ahead } = page.layout, right = cross(ahead, up), { azimuth: a, elevation: e } = scene;
  let back = add([0, 0, 0], ahead, -Math.cos(e) * Math.cos(a));
  back = add(add(back, right, Math.cos(e) * Math.sin(a)), up, Math.sin(e));
  const x = unit(cross(add([0, 0, 0], back, -1), up));
  return { x, y: cross(x, back), z: back };
}

function everything() {
  const points = boxCorners(page.layout.low, page.layout.high);
  page.layout.centres.forEach((_, i) => points.push(...cameraCorners(i, page.layout.size)));
  return points;
}

function projector(width, height) { // the whole rig, as large as there is room beside its labels
  const { x, y, z } = eye(), points = everything();
  const low = [0, 1, 2].map((k) => Math.min(...points.map((p) => p[k]))), high = [0, 1, 2].map((k) => Math.max(...points.map((p) => p[k])));
  const middle = low.map((value, k) => (value + high[k]) / 2);
  const radius = Math.max(...points.map((p) => Math.hypot(...add(p, middle, -1))));
  const flat = (p) => {
    const d = add(p, middle, -1), depth = dot(d, z), near = DISTANCE * radius / (DISTANCE * radius - depth);
    return [dot(d, x) * near, dot(d, y) * near, depth];
  };
  const shown = points.map(flat), across = shown.map((p) => p[0]), down = shown.map((p) => p[1]);
  const [left, right, top, bottom] = [Math.min(...across), Math.max(...across), Math.min(...down), Math.max(...down)];
  const scale = Math.min((width - 110) / (right - left || 1), (height - 64) / (bottom - top || 1));
  return (p) => {
    const [u, v, depth] = flat(p);
    return [width / 2 + (u - (left + right) / 2) * scale, height / 2 + (v - (top + bottom) / 2) * scale, depth];
  };
}

function drawScene() {
  scene.due = false;
  if (!page.layout || !page.hello) return;
  const canvas = $("scene"), ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width) return;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
  }
  const g = canvas.getContext("2d"), at = projector(width, height), tones = colours();
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, width, height);
  g.lineJoin = g.lineCap = "round";
  drawVolume(g, at, tones);
  drawObject(g, at, tones);
  scene.places = page.layout.centres.map(at);
  const far = page.layout.centres.map((_, i) => i).sort((a, b) => scene.places[a][2] - scene.places[b][2]);
  for (const i of far) drawCamera(g, at, i, tones);
  drawLabels(g, width, height, far.reverse(), tones);
  const words = {};
  page.hello.cameras.forEach((_, i) => { words[wordOf(i)] = (words[wordOf(i)] || 0) + 1; });
  const told = Object.entries(words).map(([word, count]) => `${count} ${word}`).join(", ");
  const label = `The rig in 3D, ${plural(page.hello.cameras.length, "camera")}: ${told}. Arrow keys turn it, Home puts it at rest.`;
  if (canvas.getAttribute("aria-label") !== label) canvas.setAttribute("aria-label", label);
}

function path(g, points, close = false) {
  g.beginPath();
  points.forEach((p, i) => (i ? g.lineTo(p[0], p[1]) : g.moveTo(p[0], p[1])));
  if (close) g.closePath();
}

function drawVolume(g, at, tones) {
  const corners = boxCorners(page.layout.low, page.layout.high), { up } = page.layout;
  const heights = corners.map((c) => dot(c, up)), middle = (Math.min(...heights) + Math.max(...heights)) / 2;
  g.strokeStyle = tones.ghost; g.lineWidth = 1; g.globalAlpha = 0.55;
  for (let a = 0; a < 8; a++) for (const bit of [1, 2, 4]) if (!(a & bit)) { path(g, [at(corners[a]), at(corners[a | bit])]); g.stroke(); }
  const floor = corners.filter((_, i) => heights[i] < middle);
  if (floor.length === 4) {
    path(g, [floor[0], floor[1], floor[3], floor[2]].map(at), true);
    g.fillStyle = tones.ghost; g.globalAlpha = 0.1; g.fill();
  }
  g.globalAlpha = 1;
}

function drawObject(g, at, tones) {
  const visited = page.volume ? page.volume.visited : [], next = target();
  if (visited.length) {
    g.fillStyle = tones.after; g.globalAlpha = 0.28;
    for (const p of visited) { const [x, y] = at(p); g.beginPath(); g.arc(x, y, 1.6, 0, 7); g.fill(); }
  }
  g.globalAlpha = 1;
  const points = page.state && page.state.object;
  if (points) {
    const middle = mean(points), [x, y] = at(middle);
    g.lineWidth = 1;
    page.layout.centres.forEach((centre, i) => {
      if (!page.state.sees[i]) return;
      g.strokeStyle = toneOf(i) === "good" ? tones.after : tones[toneOf(i)];
      g.globalAlpha = i === page.selected ? 0.8 : page.layout.centres.length > 24 ? 0.12 : 0.22;
      path(g, [at(centre), [x, y]]); g.stroke();
    });
    g.globalAlpha = 1;
    if (next) { g.setLineDash([4, 5]); g.strokeStyle = tones.before; g.lineWidth = 1.4; path(g, [[x, y], at(next)]); g.stroke(); g.setLineDash([]); }
    g.fillStyle = tones.ink;
    for (const p of points) { const [u, v] = at(p); g.beginPath(); g.arc(u, v, points.length > 30 ? 1.5 : 2.4, 0, 7); g.fill(); }
  }
  if (next) {
    const [x, y] = at(next);
    g.strokeStyle = tones.before; g.lineWidth = 2;
    g.beginPath(); g.arc(x, y, 8, 0, 7); g.stroke();
    g.beginPath(); g.arc(x, y, 2, 0, 7); g.fillStyle = tones.before; g.fill();
  }
}

function drawCamera(g, at, i, tones) {
  const [apex, ...rim] = cameraCorners(i, page.layout.size).map(at), tone = tones[toneOf(i)], chosen = i === page.selected;
  const across = [apex, ...rim].map((p) => p[0]), down = [apex, ...rim].map((p) => p[1]);
  scene.bodies[i] = [Math.min(...across) + 1, Math.min(...down) + 1, Math.max(...across) - 1, Math.max(...down) - 1];
  g.fillStyle = tone; g.strokeStyle = tones.panel; g.lineWidth = 1;
  const sides = rim.map((p, k) => [apex, p, rim[(k + 1) % 4]]).sort((a, b) => a[1][2] + a[2][2] - b[1][2] - b[2][2]);
  g.globalAlpha = 1;
  for (const side of sides) { path(g, side, true); g.fill(); g.stroke(); }
  path(g, rim, true); g.globalAlpha = 0.35; g.fillStyle = tones.panel; g.fill(); g.globalAlpha = 1;
  g.strokeStyle = chosen ? tones.ink : tone; g.lineWidth = chosen ? 2.2 : 1.2;
  path(g, rim, true); g.stroke();
  g.beginPath(); g.arc(apex[0], apex[1], chosen ? 4.2 : 3, 0, 7); g.fillStyle = chosen ? tones.ink : tone; g.fill();
}

function drawLabels(g, width, height, order, tones) { // the nearest cameras first, what is not well before all others
  const names = page.hello.cameras, prefix = names.length > 16 ? COMMON() : "", taken = scene.bodies.slice();
  const middle = mean(scene.places), first = (i) => (i === page.selected ? 0 : toneOf(i) === "bad" || toneOf(i) === "caution" ? 1 : 2);
  g.font = `${names.length > 24 ? 11 : 12.5}px system-ui, "Liberation Sans", sans-serif`;
  g.textBaseline = "middle";
  for (const i of [...order].sort((a, b) => first(a) - first(b))) {
    const full = names[i].slice(prefix.length), text = full.length > 16 ? full.slice(0, 15) + "…" : full;
    const w = g.measureText(text).width, h = 14, [x, y] = scene.places[i], away = Math.atan2(y - middle[1], x - middle[0]);
    for (const [turn, reach] of TRIES) {
      const a = away + turn, u = x + Math.cos(a) * (reach + w / 2), v = y + Math.sin(a) * (reach + h / 2);
      const box = [u - w / 2 - 2, v - h / 2, u + w / 2 + 2, v + h / 2];
      if (box[0] < 2 || box[1] < 2 || box[2] > width - 2 || box[3] > height - 2) continue;
      if (taken.some((t) => box[0] < t[2] && box[2] > t[0] && box[1] < t[3] && box[3] > t[1])) continue;
      taken.push(box);
      if (reach > 30) { g.strokeStyle = tones.ghost; g.lineWidth = 1; path(g, [[x, y], [u - Math.cos(a) * w / 2, v - Math.sin(a) * h / 2]]); g.stroke(); }
      g.fillStyle = first(i) === 1 ? tones[toneOf(i)] : i === page.selected ? tones.ink : tones.muted;
      g.fillText(text, u - w / 2, v + 0.5);
      break;
    }
  }
}

function refreshScene() {
  if (!scene.due) { scene.due = true; requestAnimationFrame(drawScene); }
}

function turnTo(name) {
  [scene.azimuth, scene.elevation] = VIEWS[name];
  for (const button of document.querySelectorAll("[data-view]")) button.setAttribute("aria-pressed", String(button.dataset.view === name));
  refreshScene();
}

function turnBy(azimuth, elevation) {
  scene.azimuth += azimuth;
  scene.elevation = Math.max(-1.5, Math.min(1.55, scene.elevation + elevation));
  for (const button of document.querySelectorAll("[data-view]")) button.setAttribute("aria-pressed", "false");
  refreshScene();
}

function startScene() {
  const canvas = $("scene");
  turnTo("rest");
  for (const button of document.querySelectorAll("[data-view]")) button.addEventListener("click", () => turnTo(button.dataset.view));
  canvas.addEventListener("pointerdown", (e) => { scene.drag = { x: e.clientX, y: e.clientY, moved: false }; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", (e) => {
    if (!scene.drag) return;
    const dx = e.clientX - scene.drag.x, dy = e.clientY - scene.drag.y;
    if (!scene.drag.moved && Math.hypot(dx, dy) < 4) return;
    turnBy(-dx * 0.008, dy * 0.008);
    scene.drag = { x: e.clientX, y: e.clientY, moved: true };
  });
  canvas.addEventListener("pointerup", (e) => {
    const drag = scene.drag;
    scene.drag = null;
    if (!drag || drag.moved) return;
    const box = canvas.getBoundingClientRect(), x = e.clientX - box.left, y = e.clientY - box.top;
    const apart = scene.places.map((p) => Math.hypot(p[0] - x, p[1] - y)), nearest = apart.indexOf(Math.min(...apart));
    if (apart[nearest] < 26) choose(nearest);
  });
  canvas.addEventListener("pointercancel", () => { scene.drag = null; });
  canvas.addEventListener("keydown", (e) => {
    const steps = { ArrowLeft: [0.15, 0], ArrowRight: [-0.15, 0], ArrowUp: [0, 0.12], ArrowDown: [0, -0.12] };
    if (steps[e.key]) turnBy(...steps[e.key]);
    else if (e.key === "Home") turnTo("rest");
    else return;
    e.preventDefault();
  });
  new ResizeObserver(refreshScene).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { inks = null; refreshScene(); });
}
