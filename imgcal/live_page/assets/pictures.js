// Each camera's latest frame, with what was found in it and what was expected.

const figures = [];
let large = null;

function figure(i, kind) {
  const [w, h] = page.hello.sizes[i], img = make("img", { alt: "", hidden: "" }), nothing = make("span", { class: "nothing" }, "no frame");
  const overlay = make("svg", { viewBox: `0 0 1000 ${(1000 * h) / w}`, preserveAspectRatio: "none", "aria-hidden": "true" });
  const box = make("div", { class: "picture" }, img, nothing, overlay), name = make("b", {}, page.hello.cameras[i]), note = make("span");
  box.style.aspectRatio = `${w} / ${h}`;
  const caption = make("figcaption", {}, make("i"), name, note), element = make("figure", {}, box, caption);
  return { i, kind, element, img, nothing, overlay, caption, note, height: (1000 * h) / w, seen: kind === "large" };
}

function buildPictures() {
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) { const f = figures[Number(entry.target.dataset.camera)]; f.seen = entry.isIntersecting; if (f.seen) fill(f); }
  }, { rootMargin: "200px" });
  figures.length = 0;
  const holder = $("frames");
  holder.classList.toggle("many", page.hello.cameras.length > MOST_ROWS);
  holder.replaceChildren(...page.hello.cameras.map((name, i) => {
    const f = figure(i, "small"), button = make("button", { type: "button", "data-camera": i, "aria-label": `Show ${name}` }, f.element);
    button.addEventListener("click", () => { choose(i); $("camera").scrollIntoView({ block: "nearest" }); });
    f.button = button;
    figures.push(f);
    watch.observe(button);
    return button;
  }));
  large = null;
}

function fill(f) {
  const picture = page.pictures.get(f.i), tone = toneOf(f.i);
  if (f.tone !== tone) { f.tone = tone; f.caption.replaceChild(sign(tone), f.caption.firstChild); }
  if (f.button) f.button.classList.toggle("chosen", f.i === page.selected);
  if (!picture) return;
  f.nothing.hidden = Boolean(picture.jpeg) || picture.detected.length > 0;
  f.img.hidden = !picture.jpeg;
  if (picture.jpeg) f.img.src = "data:image/jpeg;base64," + picture.jpeg;
  const found = picture.labelled.filter(Boolean).length, r = f.kind === "large" ? 11 : 22, s = f.kind === "large" ? 9 : 19;
  const ring = (x, y) => `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`;
  let own = "", stray = "", expected = "";
  picture.detected.forEach(([x, y], k) => { const d = ring(x * 1000, y * f.height); if (picture.labelled[k]) own += d; else stray += d; });
  for (const [x, y] of picture.predicted) expected += `M${x * 1000 - s} ${y * f.height}h${2 * s}M${x * 1000} ${y * f.height - s}v${2 * s}`;
  f.overlay.replaceChildren(make("path", { class: "stray", d: stray }), make("path", { class: "detected", d: own }), make("path", { class: "predicted", d: expected }));
  say(f.note, f.kind === "large" ? `${found} of ${page.hello.fiducials} found · ${clock(picture.time)}` : `${found} of ${page.hello.fiducials}`);
}

function drawPicture(i) {
  if (!page.hello) return;
  for (const f of figures) if (f.seen && (i === null || f.i === i || f.button.classList.contains("chosen") !== (f.i === page.selected))) fill(f);
  if (i === page.selected || i === null) {
    if (!large || large.i !== page.selected) { large = figure(page.selected, "large"); $("picture").replaceChildren(large.element); }
    fill(large);
  }
}
