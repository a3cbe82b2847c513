// Words, numbers and elements. Names and messages come from elsewhere: they become text, never markup.

const page = { hello: null, layout: null, state: null, history: null, events: [], volume: null, controls: null, pictures: new Map(), selected: 0, span: "fine" };

const HEALTH = {
  ok: ["good", "calibrated"], doubtful: ["caution", "in doubt"], relearning: ["caution", "recalibrating"], dirty: ["caution", "dirty"], defocused: ["caution", "out of focus"],
  blind: ["bad", "sees nothing"], lost: ["bad", "lost"], unseen: ["none", "not seen the object yet"],
  hidden: ["none", "does not see the object"],
};
const ORDER = ["none", "good", "caution", "bad"];

const $ = (id) => document.getElementById(id);
const toneOf = (camera) => (page.state ? (HEALTH[page.state.health[camera]] || ["none"])[0] : "none");
const wordOf = (camera) => (page.state ? (HEALTH[page.state.health[camera]] || ["", page.state.health[camera]])[1] : "waiting");

function make(tag, attributes = {}, ...children) {
  const svg = ["svg", "path", "circle", "rect", "line", "text", "g", "title"].includes(tag);
  const element = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) if (value !== null && value !== undefined) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

function say(element, text) { // only what changed, so that screen readers hear it once
  if (element.textContent !== text) element.textContent = text;
}

// A sign has a shape as well as a colour.
const SHAPES = {
  good: ["M4.2 8.4l2.6 2.6 5-5.6"], caution: ["M8 4v4.8", "M8 11.6v.2"], bad: ["M5.3 5.3l5.4 5.4", "M10.7 5.3l-5.4 5.4"], none: [],
};
function sign(tone) {
  const disc = make("circle", { cx: 8, cy: 8, r: tone === "none" ? 6 : 7, class: tone === "none" ? "ring" : "tone", "stroke-width": tone === "none" ? 1.6 : 0 });
  const marks = SHAPES[tone].map((d) => make("path", { d, fill: "none", stroke: "var(--page)", "stroke-width": 1.9, "stroke-linecap": "round", "stroke-linejoin": "round" }));
  return make("svg", { viewBox: "0 0 16 16", class: tone, "aria-hidden": "true" }, disc, ...marks);
}

function digits(value, count = 2) { // 0.0123 -> "0.012", 123.4 -> "123"
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size < 1e-9) return "0";
  const places = Math.max(0, Math.min(6, count - 1 - Math.floor(Math.log10(size) + 1e-9)));
  return value.toFixed(places).replace("-", "−");
}

function withSigma(value, sigma) { // as many places as the deviation has
  if (value === null || value === undefined) return ["–", ""];
  if (sigma === null || sigma === undefined) return [digits(value), ""];
  const places = Math.max(0, Math.min(5, 1 - Math.floor(Math.log10(Math.max(sigma, 1e-5)) + 1)));
  const shown = value.toFixed(places);
  return [(Number(shown) === 0 ? shown.replace("-", "") : shown).replace("-", "−"), " ± " + sigma.toFixed(places)];
}

const clock = (seconds) => new Date(seconds * 1000).toLocaleTimeString([], { hour12: false });
const RESULT = { camera_lost: ["lost", "blind"], dirty: ["dirty"], defocused: ["defocused"] }; // the health of a camera while an alarm holds
const PAST = { camera_lost: "lost the object", camera_back: "saw the object again", dirty: "was dirty, half covered or badly lit", defocused: "was out of focus", clean: "was clear and sharp again" };
function holds(event) { // whether what an event reports is still so
  const camera = page.hello ? page.hello.cameras.indexOf(event.camera) : -1;
  return Boolean(RESULT[event.kind] && page.state && RESULT[event.kind].includes(page.state.health[camera])) && !page.events.some((later) => later.number > event.number && later.camera === event.camera && later.kind === event.kind);
}
function readable(event) { // in the past tense once it is over
  if (PAST[event.kind] && !holds(event)) return `${event.camera} ${PAST[event.kind]}`;
  const [text, again = ""] = event.message.replaceAll(" +- ", " ± ").split("; known again"), when = event.since === null ? "" : ` at ${clock(event.since)}`;
  if (event.kind === "moved") return text + when;
  if (event.kind !== "relearnt") return text;
  return `${text}${when}; known again${again.replace("± ", "±")}`;
}
const shortClock = (seconds) => clock(seconds).slice(0, 5);
const plural = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

const COMMON = () => {
  const names = page.hello.cameras;
  if (names.length < 2) return "";
  let prefix = names[0];
  for (const name of names) while (!name.startsWith(prefix)) prefix = prefix.slice(0, -1);
  return names.some((name) => name.length === prefix.length) ? "" : prefix.replace(/\d+$/, "");
};
