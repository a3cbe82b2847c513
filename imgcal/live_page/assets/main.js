// The page follows the server's stream; a report is the same page of one moment.

const data = JSON.parse($("data").textContent), fixed = "contents" in data;
const STALE = 3000; // ms without a new state
const line = { source: null, wait: 500, timer: null, last: 0, until: 0, gone: null };
const GONE = 1; // s without the object from which the page says so: single snapshots may miss it
const CALM = 450; // ms between changes of numbers, which can be read then
let drawn = -Infinity, numbers = null;

function drawNumbers() {
  numbers = null;
  drawn = performance.now();
  drawCameras(); drawTimelines();
  for (const f of figures) if (f.seen) fill(f);
}

const TAKE = {
  hello(content) {
    if (page.hello && page.hello.instance !== content.instance) { location.reload(); return; }
    if (page.hello) return;
    page.hello = content;
    document.title = `${content.rig} · ${content.title}`;
    say($("rig-name"), `${content.rig} · ${content.object}`);
    say($("footer"), `imgcal ${content.version}`);
    const wanted = Number((location.hash.match(/^#camera-(\d+)$/) || [])[1]);
    page.selected = wanted < content.cameras.length ? wanted : 0;
    buildCameras(); buildPictures(); buildActions(); drawChosen();
  },
  layout(content) { page.layout = content; liveRig.refresh(); },
  controls(content) { page.controls = content; drawControls(); },
  history(content) { page.history = content; drawTimelines(); },
  events(content) { page.events = content; drawEvents(); drawState(); },
  volume(content) { page.volume = content; drawVolumeMaps(); liveRig.refresh(); },
  picture(content) { page.pictures.set(content.camera, content); drawPicture(content.camera); },
  state(content) {
    const before = page.state && page.state.health.join();
    page.state = content;
    if (content.inView) line.gone = null;
    else line.gone ??= content.time;
    line.last = performance.now();
    if (before !== content.health.join()) drawEvents(); // what was so may be over
    appendHistory(content); drawState(); liveRig.refresh();
    if (!numbers) numbers = setTimeout(drawNumbers, Math.max(0, CALM - (line.last - drawn)));
  },
};

function worstTone() {
  if (!page.state) return "none";
  if (page.controls && page.controls.paused) return "none";
  const tones = page.hello.cameras.map((_, i) => ORDER.indexOf(toneOf(i)));
  const worst = ORDER[Math.max(...tones)];
  if (worst === "good" && isGone()) return "none";
  return worst === "good" && page.events.some((event) => event.open) ? "caution" : worst;
}

const isGone = () => line.gone !== null && (fixed || page.state.time - line.gone >= GONE);
const sentenceCase = (text) => { // names of cameras stay as they are
  const named = page.hello.cameras.some((name) => text.startsWith(name));
  return (named ? text : text.charAt(0).toUpperCase() + text.slice(1)) + (/[.!?]$/.test(text) ? "" : ".");
};

function drawState() {
  if (!page.hello) return;
  const { state, controls } = page, tone = worstTone();
  if ($("sign").dataset.tone !== tone) { $("sign").dataset.tone = tone; $("sign").replaceChildren(sign(tone)); }
  if (!state) { return; }
  const paused = controls && controls.paused, gone = isGone();
  say($("sentence"), paused ? "Paused: snapshots are not evaluated." : gone ? "No object in view." : sentenceCase(state.sentence));
  const seeing = state.sees.filter((n) => n > 0).length, parts = [];
  if (paused) parts.push(`last snapshot at ${clock(state.time)}`);
  else if (gone) parts.push(state.sentence);
  else if (!state.inView) parts.push("no object in view");
  else if (state.refused) parts.push(`this snapshot was not used: ${state.refused.replace(/^identity: /, "")}`);
  else parts.push(`${seeing} of ${plural(page.hello.cameras.length, "camera")} ${seeing === 1 ? "sees" : "see"} the object`);
  const residuals = state.value.map((v) => v[3]).filter((v) => v !== null);
  if (residuals.length && !state.refused && !paused) parts.push(`residual ${digits(Math.sqrt(residuals.reduce((sum, v) => sum + v * v, 0) / residuals.length))} px`);
  if (state.rate !== null && !paused) parts.push(`${state.rate.toFixed(state.rate < 10 ? 1 : 0)} snapshots a second`);
  const detail = parts.join(" · ");
  say($("detail"), sentenceCase(detail).replace(/\.$/, ""));
  drawAlarm();
}

function notice(text) {
  line.until = performance.now() + 4000;
  say($("link").lastChild, text);
  $("link").className = "link lost";
}

function drawLink() {
  if (performance.now() < line.until) return;
  if (fixed) { say($("link").lastChild, page.state ? `as of ${new Date(page.state.time * 1000).toLocaleString([], { hour12: false })}` : "no snapshot"); return; }
  const connected = line.source && line.source.readyState === EventSource.OPEN, quiet = performance.now() - line.last;
  const paused = page.controls && page.controls.paused, stale = connected && page.state && quiet > STALE && !paused;
  const text = !connected ? "connection lost, trying again" : stale ? `no snapshot for ${Math.round(quiet / 1000)} s` : page.state ? `${paused ? "paused at" : "live"} ${clock(page.state.time)}` : "connected";
  say($("link").lastChild, text);
  $("link").className = `link ${!connected ? "lost" : stale ? "stale" : page.state ? "live" : ""}`;
  document.body.classList.toggle("away", !connected);
}

function connect() {
  clearTimeout(line.timer);
  if (line.source) line.source.close();
  const source = new EventSource("/stream");
  line.source = source;
  for (const [kind, take] of Object.entries(TAKE)) source.addEventListener(kind, (event) => take(JSON.parse(event.data)));
  source.onopen = () => { line.wait = 500; drawLink(); };
  source.onerror = () => {
    source.close();
    drawLink();
    line.timer = setTimeout(connect, line.wait);
    line.wait = Math.min(line.wait * 1.6, 5000);
  };
}

startTimelines(); startControls();
if (fixed) {
  for (const [key, content] of Object.entries(data.contents)) TAKE[key.split(":")[0]](content);
  drawCameras(); drawLink();
} else {
  connect();
  setInterval(drawLink, 500);
  document.addEventListener("visibilitychange", () => { // a hidden page requests nothing from the server
    if (!document.hidden) connect();
    else if (line.source) { clearTimeout(line.timer); line.source.close(); }
  });
}
