// How well points are triangulated over the volume, where the object has been, and where it should go next.

const CLASSES = 6;
const MUCH = 1.3; // times what a snapshot teaches where the object is now: worth a move
const AGED = 5; // s after which it is said of which moment the accuracy is

function target() { // where the object teaches the most, if that is worth a move
  const advice = page.volume && page.volume.advice;
  if (!advice || advice.best === null) return null;
  const here = page.state && page.state.object ? mean(page.state.object) : null;
  if (here && ratioOf(advice, here) < MUCH) return null;
  return advice.places[advice.best];
}

function ratioOf(advice, here) {
  const apart = advice.places.map((p) => Math.hypot(...add(p, here, -1))), now = advice.gain[apart.indexOf(Math.min(...apart))];
  return now > 0 ? advice.gain[advice.best] / now : Infinity;
}

function guidance() {
  const advice = page.volume && page.volume.advice;
  if (!advice) return page.state && page.state.object ? "Computing how accurate the rig is …" : "Show the object to the cameras.";
  const old = page.state && page.state.time - advice.time > AGED ? `At ${clock(advice.time)}: ` : "";
  const known = old + (advice.median === null ? "No two cameras see the same part of the volume." : `Typical error of a triangulated point: ${digits(advice.median)} mm; in 95 % of the volume below ${digits(advice.p95)} mm.`);
  const next = target();
  if (!next) return `${known} The object is in a good place: snapshots elsewhere would not improve the rig much more.`;
  const here = page.state && page.state.object ? mean(page.state.object) : null;
  if (!here) return `${known} Bring the object near ${["x", "y", "z"].map((axis, k) => `${axis} ${next[k].toFixed(0).replace("-", "−")}`).join(", ")} mm.`;
  const ratio = ratioOf(advice, here);
  const worth = ratio === Infinity ? "snapshots where it is now teach nothing" : `a snapshot there teaches ${ratio.toFixed(1)} times as much`;
  return `${known} Move the object here next: ${directions(add(next, here, -1), next)}; ${worth}.`;
}

function directions(step, place) {
  const { up, ahead, centres, inward } = page.layout, right = cross(ahead, up), parts = [];
  const tell = (value, more, less) => { if (Math.abs(value) >= 20) parts.push(`${(Math.round(Math.abs(value) / 10) * 10).toFixed(0)} mm ${value > 0 ? more : less}`); };
  if (inward) { // no side is the front one: towards a camera
    const level = add(step, up, -dot(step, up)), reach = Math.hypot(...level), from = add(place, step, -1);
    const along = centres.map((c) => { const way = add(c, from, -1); return dot(unit(add(way, up, -dot(way, up))), unit(level)); });
    tell(reach, `towards ${page.hello.cameras[along.indexOf(Math.max(...along))]}`, "");
  } else {
    tell(dot(step, right), "right", "left");
    tell(dot(step, ahead), "away from the cameras", "towards the cameras");
  }
  tell(dot(step, up), "up", "down");
  return parts.length ? parts.join(", ") : "where it is";
}

function rigAxes() { // for right, up, ahead: the axis of the box that is nearest, and its direction
  const { up, ahead } = page.layout, found = [];
  for (const way of [up, ahead, cross(ahead, up)]) {
    const free = [0, 1, 2].filter((k) => !found.some((f) => f.axis === k)), axis = free.reduce((a, b) => (Math.abs(way[b]) > Math.abs(way[a]) ? b : a));
    found.push({ axis, sign: way[axis] < 0 ? -1 : 1 });
  }
  return { up: found[0], ahead: found[1], right: found[2] };
}

function limitsOf(values) { // of the series 1, 2, 5, 10; the median lies in the second class
  const known = values.filter((v) => v !== null).sort((a, b) => a - b), middle = Math.max(known[Math.floor(known.length / 2)] || 1, 1e-9), series = [];
  for (let power = -9; power < 7; power++) for (const digit of [1, 2, 5]) series.push(digit * 10 ** power);
  const first = series.findIndex((v) => v >= middle) - 1;
  return series.slice(first, first + CLASSES - 1);
}

function drawVolumeMaps() {
  say($("guidance"), page.hello ? guidance() : "");
  const advice = page.volume && page.volume.advice;
  if (!advice || !page.layout || !page.hello) return;
  const axes = rigAxes(), limits = limitsOf(advice.mm.flat(2)), { inward } = page.layout;
  const views = [["From the front", axes.right, axes.up, axes.ahead], ["From above", axes.right, axes.ahead, axes.up]];
  $("maps").replaceChildren(...views.map(([title, across, up, hidden]) => {
    const title2 = inward && title === "From the front" ? "From the side" : title;
    return make("figure", {}, map(advice, limits, title2, across, up, hidden));
  }));
  const edges = limits.map((limit) => digits(limit, 1)), between = edges.slice(1).map((edge, k) => `${edges[k]}–${edge}`);
  const key = [`below ${edges[0]} mm`, ...between, `above ${edges.at(-1)}`].map((text, k) => [`c${k}`, text]);
  $("maps-key").replaceChildren(
    ...key.map(([kind, text]) => make("span", {}, make("svg", { viewBox: "0 0 13 13", "aria-hidden": "true" }, make("rect", { class: kind, width: 13, height: 13, rx: 2 })), text)),
    make("span", {}, make("svg", { viewBox: "0 0 13 13", "aria-hidden": "true" }, make("rect", { class: "blank", width: 13, height: 13, rx: 2, fill: "var(--panel)", stroke: "var(--line)" })), "seen by fewer than two cameras"),
  );
}

function map(advice, limits, title, across, up, hidden) {
  const n = advice.mm.length, low = advice.low, high = advice.high, wide = high[across.axis] - low[across.axis], tall = high[up.axis] - low[up.axis];
  const width = 300, height = Math.max(60, Math.min(340, (width * tall) / wide)), dx = width / n, dy = height / n;
  const svg = make("svg", { class: "map", viewBox: `-2 -2 ${width + 4} ${height + 22}`, role: "img", "aria-label": `Predicted error of points, ${title.toLowerCase()}` });
  const value = (i, j) => { // the median over the axis that is looked along
    const found = [];
    for (let k = 0; k < n; k++) { const at = [0, 0, 0]; at[across.axis] = i; at[up.axis] = j; at[hidden.axis] = k; const v = advice.mm[at[0]][at[1]][at[2]]; if (v !== null) found.push(v); }
    found.sort((a, b) => a - b);
    return found.length * 2 >= n ? found[Math.floor(found.length / 2)] : null;
  };
  for (let i = 0; i < n; i++) for (let j = 0; j < n; j++) {
    const v = value(across.sign > 0 ? i : n - 1 - i, up.sign > 0 ? n - 1 - j : j), kind = v === null ? "blank" : `c${limits.filter((limit) => v > limit).length}`;
    svg.append(make("rect", { class: `cell ${kind}`, x: i * dx, y: j * dy, width: dx, height: dy }));
  }
  const place = (p) => {
    const u = (p[across.axis] - low[across.axis]) / wide, v = (p[up.axis] - low[up.axis]) / tall;
    return [Math.min(Math.max(across.sign > 0 ? u : 1 - u, 0), 1) * width, Math.min(Math.max(up.sign > 0 ? 1 - v : v, 0), 1) * height];
  };
  for (const p of page.volume.visited) { const [x, y] = place(p); svg.append(make("circle", { class: "been", cx: x, cy: y, r: 1.7 })); }
  const here = page.state && page.state.object ? place(mean(page.state.object)) : null, next = target();
  if (next) { const [x, y] = place(next); for (const kind of ["shade", "next"]) svg.append(make("circle", { class: kind, cx: x, cy: y, r: 9 })); }
  if (here) svg.append(make("circle", { class: "object", cx: here[0], cy: here[1], r: 5 }));
  svg.append(make("text", { x: width, y: height + 16, "text-anchor": "end" }, `${Math.round(wide)} × ${Math.round(tall)} mm`), make("text", { x: 0, y: height + 16 }, title));
  return svg;
}
