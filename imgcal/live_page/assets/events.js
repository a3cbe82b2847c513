// What happened, the latest first; alarms wait to be acknowledged.

const SHOWN_EVENTS = 8;

function openEvent() {
  return [...page.events].reverse().find((event) => event.open);
}

function drawEvents() {
  const rows = [...page.events].reverse().map((event) => {
    const row = make("li", {}, make("time", { datetime: new Date(event.time * 1000).toISOString() }, clock(event.time)), make("span", { class: event.open ? "open" : "" }, readable(event)));
    if (event.open && !fixed) {
      const button = make("button", { type: "button", title: "this alarm and all earlier ones" }, "Acknowledge");
      button.addEventListener("click", () => command("acknowledge", { event: event.number }));
      row.append(button);
    }
    return row;
  });
  $("events").replaceChildren(...(rows.length ? rows.slice(0, SHOWN_EVENTS) : [make("li", { class: "muted" }, "none yet")]));
  $("older").hidden = rows.length <= SHOWN_EVENTS;
  $("events-older").replaceChildren(...rows.slice(SHOWN_EVENTS));
  $("acknowledge").hidden = fixed;
  drawAlarm();
  drawTimelines();
}

function drawAlarm() { // the newest one that is not acknowledged
  const open = page.events.filter((event) => event.open), newest = open[open.length - 1];
  $("alarm").hidden = !newest;
  if (newest) say($("alarm-text"), `${["moved", "relearnt"].includes(newest.kind) ? "" : `${clock(newest.time)} `}${readable(newest)}${open.length > 1 ? ` (and ${plural(open.length - 1, "earlier alarm")})` : ""}`);
}
