// All cameras: a table where there is room for one, else a grid; the chosen one is shown below.

const MOST_ROWS = 16;
const cameraRows = [];

function buildCameras() {
  cameraRows.length = 0;
  const many = page.hello.cameras.length > MOST_ROWS, holder = $("cameras");
  const pick = (name, i) => {
    const button = make("button", { type: "button", class: "pick", "aria-pressed": "false" }, make("i"), make("span", { title: name }, name));
    button.addEventListener("click", () => choose(i));
    return button;
  };
  if (many) {
    holder.replaceChildren(make("div", { class: "chips" }, ...page.hello.cameras.map((name, i) => {
      const button = pick(name, i), number = make("small");
      button.append(number, make("span", { class: "hidden" }));
      cameraRows.push({ button, cells: [null, null, null, null, number], words: button.lastChild });
      return button;
    })));
    say($("cameras-note"), "residual, px");
    return;
  }
  const heads = [["Camera", ""], ["State", ""], ["Turned °", ""], ["Moved mm", "wide"], ["Focal %", "wide"], ["Residual px", ""]];
  const head = make("tr", {}, ...heads.map(([text, kind]) => make("th", { scope: "col", class: text === "State" ? "words" : kind }, text)));
  const rows = page.hello.cameras.map((name, i) => {
    const button = pick(name, i), words = make("td", { class: "words" }), cells = ["", "wide", "wide", ""].map((kind) => make("td", { class: kind }));
    cameraRows.push({ button, cells: [words, ...cells], words });
    return make("tr", {}, make("th", { scope: "row" }, button), words, ...cells);
  });
  holder.replaceChildren(make("table", {}, make("thead", {}, head), make("tbody", {}, ...rows)));
}

function drawCameras() {
  if (!page.state) return;
  cameraRows.forEach(({ button, cells, words }, i) => {
    const tone = toneOf(i);
    if (button.dataset.tone !== tone) { button.dataset.tone = tone; button.replaceChild(sign(tone), button.firstChild); }
    button.setAttribute("aria-pressed", String(i === page.selected));
    say(words, wordOf(i));
    words.className = words.tagName === "TD" ? `words ${tone}` : "hidden";
    cells.slice(1).forEach((cell, k) => {
      if (!cell) return;
      const [value, spread] = k === 3 ? [digits(page.state.value[i][k]), ""] : withSigma(page.state.value[i][k], page.state.sigma[i][k]);
      if (cell.dataset.text !== value + spread) { cell.dataset.text = value + spread; cell.replaceChildren(value, ...(spread ? [make("small", {}, spread)] : [])); }
    });
  });
}

function choose(i) {
  page.selected = i;
  history.replaceState(null, "", `#camera-${i}`);
  drawCameras(); drawChosen(); liveRig.refresh();
}

function drawChosen() {
  if (!page.hello) return;
  say($("camera-title"), page.hello.cameras[page.selected]);
  drawTimelines(); drawPicture(page.selected);
}
