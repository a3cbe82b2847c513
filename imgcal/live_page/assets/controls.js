// What people can ask for. Each command carries the token of this page.

async function command(name, more = {}) {
  const camera = more.camera, told = { pause: "Paused.", resume: "Resumed.", acknowledge: "Acknowledged.", factory: "Requested; an event confirms it." };
  try {
    const answer = await fetch("/command", { method: "POST", headers: { "Content-Type": "application/json", "X-Imgcal-Token": data.token }, body: JSON.stringify({ name, ...more }) });
    say($("said"), answer.ok ? told[name] || "Done." : `Not done: ${(await answer.text()).trim()}`);
    if (!answer.ok) notice(`not done: ${answer.status === 403 ? "reload the page" : answer.status > 500 ? "the program that runs the rig does not answer" : "try again"}`);
    return answer.ok;
  } catch {
    notice("not done: no connection");
    return false;
  }
}

function startControls() {
  if (fixed) { $("controls").hidden = true; return; }
  $("pause").addEventListener("click", () => command(page.controls && page.controls.paused ? "resume" : "pause"));
  $("acknowledge").addEventListener("click", () => { const event = openEvent(); if (event) command("acknowledge", { event: event.number }); });
  const dialog = $("confirm");
  $("factory").addEventListener("click", () => {
    const changed = page.state ? page.hello.cameras.filter((_, i) => !["ok", "hidden"].includes(page.state.health[i])).length : 0;
    say($("confirm-text"), `From now on, changes of ${page.hello.rig} are measured against the rig as it is calibrated now.` + (changed ? ` ${changed} of ${plural(page.hello.cameras.length, "camera")} ${changed === 1 ? "needs" : "need"} attention first.` : ""));
    dialog.showModal();
    $("confirm-no").focus();
  });
  $("confirm-no").addEventListener("click", () => dialog.close());
  $("confirm-yes").addEventListener("click", () => { dialog.close(); command("factory", { confirmed: true }); });
}

function buildActions() {
  const holder = $("actions"), { actions, cameras } = page.hello;
  holder.hidden = fixed || !actions.length;
  if (holder.hidden) return;
  const select = make("select", { id: "action-camera" }, ...cameras.map((name, i) => make("option", { value: i }, name)));
  select.value = String(Math.min(6, cameras.length - 1));
  const buttons = actions.map((action) => {
    const button = make("button", { type: "button", "data-action": action.name, "aria-pressed": action.undo ? "false" : null }, action.label);
    button.addEventListener("click", async () => {
      if (action.ofCamera) choose(Number(select.value));
      await command(action.name, action.ofCamera ? { camera: Number(select.value) } : {});
    });
    return button;
  });
  holder.replaceChildren(make("span", {}, "Try it"), make("label", {}, "camera", select), ...buttons);
}

function drawControls() {
  const { paused, on } = page.controls;
  say($("pause"), paused ? "Resume" : "Pause");
  if (!page.hello) return;
  for (const action of page.hello.actions) {
    const button = document.querySelector(`[data-action="${CSS.escape(action.name)}"]`);
    if (!button || !action.undo) continue;
    button.setAttribute("aria-pressed", String(on.includes(action.name)));
    say(button, on.includes(action.name) ? action.undo : action.label);
  }
  drawState();
}
