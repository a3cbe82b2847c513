"use strict";
(() => {
  const root = document.documentElement;
  const box = (selector) => document.querySelector(selector);
  const every = (selector) => [...document.querySelectorAll(selector)];

  const canvas = box("#scene");
  const view = new RigView(canvas);
  const scene = JSON.parse(box("#rig-scene").textContent);
  view.set(scene, +canvas.dataset.step);
  const factor = box("#factor");
  if (factor) factor.addEventListener("input", () => {
    const times = factor.dataset.factors.split(",")[+factor.value];
    box("#factor-value").textContent = `${times}×`;
    factor.setAttribute("aria-valuetext", `${times} times`);
    view.set(scene, +factor.value);
  });

  // An overlay shows a part of its frame: the whole, what is near the object, or what was clicked at.
  const overlays = every(".overlay").map((svg) => {
    const whole = svg.getAttribute("viewBox").split(" ").map(Number);
    const near = svg.dataset.near.split(" ").map(Number);
    let part = whole;
    function show(next) {
      part = next;
      svg.setAttribute("viewBox", part.join(" "));
      svg.style.setProperty("--k", part[2] / (svg.clientWidth || 560));
    }
    let from = null;
    let moved = false;
    svg.addEventListener("pointerdown", (event) => { from = event; moved = false; });
    svg.addEventListener("pointermove", (event) => {
      if (!from || !event.buttons || !svg.classList.contains("closer")) return;
      const k = part[2] / svg.clientWidth;
      moved = moved || Math.hypot(event.clientX - from.clientX, event.clientY - from.clientY) > 4;
      if (!moved) return;
      show([part[0] - k * (event.clientX - from.clientX), part[1] - k * (event.clientY - from.clientY), part[2], part[3]]);
      from = event;
    });
    svg.addEventListener("click", (event) => {
      if (moved) return;
      const closer = svg.classList.toggle("closer");
      if (!closer) return show(box("#near").checked ? near : whole);
      const area = svg.getBoundingClientRect();
      const [w, h] = [part[2] / 4, part[3] / 4];
      const u = part[0] + part[2] * (event.clientX - area.left) / area.width;
      const v = part[1] + part[3] * (event.clientY - area.top) / area.height;
      show([u - w / 2, v - h / 2, w, h]);
    });
    new ResizeObserver(() => show(part)).observe(svg);
    return () => { svg.classList.remove("closer"); show(box("#near").checked ? near : whole); };
  });
  box("#near").addEventListener("change", () => overlays.forEach((again) => again()));

  const dark = matchMedia("(prefers-color-scheme: dark)");
  box("#theme").addEventListener("click", () => {
    const now = root.style.colorScheme || (dark.matches ? "dark" : "light");
    root.style.colorScheme = now === "dark" ? "light" : "dark";
    view.draw();
  });
  let before = "";
  addEventListener("beforeprint", () => {
    before = root.style.colorScheme;
    root.style.colorScheme = "light";
    view.paint();
  });
  addEventListener("afterprint", () => {
    root.style.colorScheme = before;
    view.draw();
  });
})();
