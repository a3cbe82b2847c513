// What each value of the chosen camera was, with a band of one standard deviation; events are marked.

const SERIES = [["Turned", "°", 0.01], ["Moved", "mm", 0.2], ["Focal length", "%", 0.02], ["Residual", "px", 0.1]]; // and the least range
const SPANS = { fine: [1, 600], coarse: [144, 600] };

function appendHistory(state) {
  if (!page.history) return;
  for (const [name, [every, most]] of Object.entries(SPANS)) {
    const span = page.history[name], last = span.time[span.time.length - 1];
    if (last !== undefined && state.time - last < every * 0.999) continue;
    span.time.push(state.time);
    const grow = (into, from) => { page.hello.cameras.forEach((_, i) => { (into[i] ||= [[], [], [], []]); from[i].forEach((v, k) => into[i][k].push(v)); }); };
    grow(span.value, state.value); grow(span.sigma, state.sigma);
    if (span.time.length > most) {
      span.time.shift();
      for (const cameras of [span.value, span.sigma]) for (const series of cameras) for (const values of series) values.shift();
    }
  }
}

function niceStep(range) {
  const power = 10 ** Math.floor(Math.log10(range / 2));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => range / step <= 3) || power * 10;
}

function drawTimelines() {
  const holder = $("timelines");
  if (!page.history || !page.hello) return;
  const { time, value, sigma } = page.history[page.span], width = Math.max(Math.floor(holder.clientWidth - (holder.clientWidth > 620 ? 26 : 0)) / (holder.clientWidth > 620 ? 2 : 1), 200), height = 132;
  const [every, count] = SPANS[page.span], end = time.length ? time[time.length - 1] : 0, whole = every * count;
  const begin = Math.max(end - whole, Math.min(time.length ? time[0] : 0, end - whole / 10));
  const left = 46, right = width - 4, top = 26, bottom = height - 20, x = (t) => left + ((t - begin) / (end - begin || 1)) * (right - left);
  const charts = SERIES.map(([title, unit, least], k) => {
    const values = time.length ? value[page.selected][k] : [], sigmas = time.length ? sigma[page.selected][k] : [];
    const last = sigmas[sigmas.length - 1];
    const reach = (i) => (sigmas[i] !== null && (last === null || sigmas[i] <= 5 * last) ? sigmas[i] : null); // else it would hide all
    let low = Infinity, high = -Infinity;
    const sizes = values.filter((v) => v !== null).map(Math.abs).sort((a, b) => a - b), most = 3 * (sizes[Math.floor(0.95 * sizes.length)] || Infinity); // rare spikes end at the edge
    values.forEach((v, i) => { if (v !== null && Math.abs(v) <= most) { low = Math.min(low, v - (reach(i) || 0)); high = Math.max(high, v + (reach(i) || 0)); } });
    if (k !== 2) low = 0;
    if (high === -Infinity) [low, high] = [0, least];
    if (high - low < least) { const middle = k === 2 ? (low + high) / 2 : least / 2; [low, high] = [middle - least / 2, middle + least / 2]; }
    const step = niceStep(high - low), y = (v) => bottom - ((Math.min(Math.max(v, low), high) - low) / (high - low)) * (bottom - top);
    const now = [...values].reverse().find((v) => v !== null), [shown, spread] = withSigma(now, last);
    const svg = make("svg", { class: "chart", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title}: now ${shown}${spread} ${unit}` });
    svg.append(make("text", { x: 0, y: 13, class: "title" }, title));
    svg.append(make("text", { x: right, y: 13, class: "now", "text-anchor": "end" }, `${shown}${spread} ${unit}`));
    for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) {
      svg.append(make("line", { x1: left, x2: right, y1: y(v), y2: y(v), class: "grid" }), make("text", { x: left - 7, y: y(v) + 4, "text-anchor": "end" }, digits(Math.abs(v) < step / 1e3 ? 0 : v, step < 1 && Math.abs(v) > 1 ? 3 : 2)));
    }
    let line = "", upper = [], lower = [], band = "", before = -Infinity;
    const close = () => { if (upper.length > 1) band += `M${upper.join("L")}L${lower.reverse().join("L")}z`; upper = []; lower = []; };
    values.forEach((v, i) => {
      if (time[i] < begin) return;
      const broken = v === null || time[i] - before > 4 * every;
      if (broken) close();
      if (v === null) return;
      const u = x(time[i]).toFixed(1);
      line += `${broken || !line ? "M" : "L"}${u} ${y(v).toFixed(1)}`;
      if (reach(i) === null) close();
      else { upper.push(`${u} ${y(v + sigmas[i]).toFixed(1)}`); lower.push(`${u} ${y(v - sigmas[i]).toFixed(1)}`); }
      before = time[i];
    });
    close();
    svg.append(make("path", { d: band, class: "band" }), make("path", { d: line, class: "line" }));
    for (const event of page.events) {
      if (event.time < begin || (event.camera !== null && event.camera !== page.hello.cameras[page.selected])) continue;
      const u = x(Math.min(event.since ?? event.time, end)).toFixed(1);
      svg.append(make("g", {}, make("line", { x1: u, x2: u, y1: top, y2: bottom, class: "event" }), make("path", { d: `M${u} ${top}l-4 -6h8z`, class: "flag" }), make("title", {}, `${clock(event.time)} ${readable(event)}`)));
    }
    svg.append(make("text", { x: left, y: height - 4 }, end ? shortClock(begin) : ""), make("text", { x: right, y: height - 4, "text-anchor": "end" }, end ? shortClock(end) : ""));
    return svg;
  });
  holder.replaceChildren(...charts);
}

function startTimelines() {
  for (const button of document.querySelectorAll("[data-span]")) {
    button.addEventListener("click", () => {
      page.span = button.dataset.span;
      for (const other of document.querySelectorAll("[data-span]")) other.setAttribute("aria-pressed", String(other === button));
      drawTimelines();
    });
  }
  new ResizeObserver(drawTimelines).observe($("timelines"));
}
