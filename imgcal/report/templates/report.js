"use strict";
(function () {
  const root = document.documentElement;
  // Named buttons only: plotly's own choice has one that sends the figure to its makers' server.
  const config = {displaylogo: false, responsive: true, showTips: false, showSendToCloud: false, plotlyServerURL: ""};
  const buttons = {
    flat: [["toImage"], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]],
    scene: [["toImage"], ["zoom3d", "pan3d", "orbitRotation"], ["resetCameraDefault3d"]],
  };
  const drawn = new Set();
  const view = {eye: null, revision: 0};
  const probe = document.body.appendChild(document.createElement("span"));
  probe.hidden = true;

  // Plotly wants plain colours: look up what "var(--name)" is in the present theme.
  function colour(value) {
    probe.style.color = value;
    return getComputedStyle(probe).color;
  }
  function coloured(value) {
    if (typeof value === "string") return value.startsWith("var(") ? colour(value) : value;
    if (Array.isArray(value)) return typeof value[0] === "number" ? value : value.map(coloured);
    if (value && typeof value === "object") return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, coloured(v)]));
    return value;
  }
  function box(selector) {
    return document.querySelector(selector);
  }

  // Each figure is drawn from its specification and the present state of the controls, nothing else.
  function draw(div) {
    const figure = coloured(JSON.parse(document.getElementById(div.dataset.figure).textContent));
    const layout = figure.layout;
    Object.assign(layout, {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", uirevision: "kept", autosize: true,
      font: {family: getComputedStyle(document.body).fontFamily, color: colour("var(--ink)")},
      hoverlabel: {bgcolor: colour("var(--page)"), bordercolor: colour("var(--line)"), font: {color: colour("var(--ink)"), size: 12}},
      modebar: {bgcolor: colour("var(--panel)"), color: colour("var(--muted)"), activecolor: colour("var(--ink)")},
    });
    if (layout.scene) {
      const factor = box("#factor");
      if (factor) layout.meta.moving.forEach(({trace, steps}) => {
        [figure.data[trace].x, figure.data[trace].y, figure.data[trace].z] = steps[+factor.value];
      });
      if (view.eye) layout.scene.camera.eye = view.eye;
      layout.scene.uirevision = String(view.revision);
      layout.height = div.clientHeight;
    } else {
      layout.height = Math.round((div.clientWidth - 38) * layout.meta.aspect) + 26;
      figure.data.forEach((trace) => { trace.visible = box(`[data-layer="${trace.meta}"]`).checked; });
      const near = box("#near").checked;
      if (near) {
        layout.xaxis.range = layout.meta.near.slice(0, 2);
        layout.yaxis.range = [layout.meta.near[3], layout.meta.near[2]];
      }
      layout.uirevision = near ? "near" : "whole";
    }
    drawn.add(div);
    Plotly.react(div, figure.data, layout, {...config, modeBarButtons: layout.scene ? buttons.scene : buttons.flat});
  }
  function redraw(filter) {
    drawn.forEach((div) => { if (!filter || filter(div)) draw(div); });
  }
  const isScene = (div) => div.classList.contains("scene");

  // Figures are drawn when they come near the window, so that many cameras do not delay the page.
  const all = [...document.querySelectorAll(".interactive")];
  all.forEach((div) => {
    if (div.dataset.aspect) div.style.minHeight = `${Math.round((div.clientWidth - 38) * div.dataset.aspect) + 26}px`;
  });
  const watcher = new IntersectionObserver((entries) => entries.forEach((entry) => {
    if (!entry.isIntersecting) return;
    watcher.unobserve(entry.target);
    draw(entry.target);
  }), {rootMargin: "800px"});
  all.forEach((div) => watcher.observe(div));

  document.querySelectorAll("[data-layer], #near").forEach((input) => {
    input.addEventListener("change", () => redraw((div) => !isScene(div)));
  });
  const factor = box("#factor");
  if (factor) factor.addEventListener("input", () => {
    const times = factor.dataset.factors.split(",")[+factor.value];
    box("#factor-value").textContent = `${times}×`;
    factor.setAttribute("aria-valuetext", `${times} times`);
    redraw(isScene);
  });
  function look(eye) {
    view.eye = eye;
    view.revision += 1;
    redraw(isScene);
  }
  document.querySelectorAll("[data-eye]").forEach((button) => button.addEventListener("click", () => {
    const [x, y, z] = button.dataset.eye.split(",").map(Number);
    look({x, y, z});
  }));
  document.querySelectorAll("[data-turn]").forEach((button) => button.addEventListener("click", () => {
    const {x, y, z} = box(".scene").layout.scene.camera.eye;
    const angle = button.dataset.turn * Math.PI / 12;
    look({x: x * Math.cos(angle) - z * Math.sin(angle), y, z: x * Math.sin(angle) + z * Math.cos(angle)});
  }));

  const dark = matchMedia("(prefers-color-scheme: dark)");
  box("#theme").addEventListener("click", () => {
    const now = root.style.colorScheme || (dark.matches ? "dark" : "light");
    root.style.colorScheme = now === "dark" ? "light" : "dark";
    redraw();
  });
  dark.addEventListener("change", () => redraw());
  let before = "";
  addEventListener("beforeprint", () => {
    before = root.style.colorScheme;
    root.classList.add("printing");
    root.style.colorScheme = "light";
    all.forEach(draw);
  });
  addEventListener("afterprint", () => {
    root.style.colorScheme = before;
    root.classList.remove("printing");
    redraw();
  });
})();
