// The page of `mrcdrl demo`: an arena that is played while this page is open, and what is asked of it.
import { ArenaView } from "./arena.js";
import { byId, element, percent, say } from "./common.js";

const EVERY_MS = 70; // between two places of a thing that is dragged
const CLICK_PX = 4; // that a pointer moves in a click, at most

const arena = new ArenaView();
const canvas = byId("arena-canvas");
let about = null;
let drag = null; // {held, from, moved, sent, place}

async function ask(change) {
  try {
    const answer = await fetch("/change", {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(change),
    });
    say(answer.ok ? "" : (await answer.text()).trim());
  } catch {
    say("The demo has ended, or cannot be reached.");
  }
}

function move({ thing, index }, [x, y]) {
  byId("newest").click(); // what follows is shown at once
  return ask({ move: thing, index, x: Math.round(x), y: Math.round(y) });
}

// -- what is played ----------------------------------------------------------------------

function tell() {
  const { robots, weights, trained_with: trained, layout, successes, episodes, most_robots: most } = about;
  const known = trained.length && !trained.includes(robots) ? `, trained with ${trained.join(", ")} robots` : "";
  byId("about").textContent = `${weights}${known}${layout === "fixed" ? " · trained with targets that stay where they are: moved ones are new to it" : ""}`;
  byId("number").textContent = `${robots} robot${robots === 1 ? "" : "s"}`;
  byId("fewer").disabled = robots <= 1;
  byId("more").disabled = robots >= most;
  byId("tally").textContent = episodes ? `${successes} of ${episodes} episodes succeeded (${percent(successes / episodes)}); those you changed do not count` : "";
}

function listThings(frame) {
  const names = [["target", frame.targets.length], ["robot", frame.robots.length]];
  const options = names.flatMap(([thing, count]) => Array.from({ length: count }, (_, i) => `${thing} ${i + 1}`));
  const select = byId("thing");
  if (select.options.length === options.length) return;
  select.replaceChildren(...options.map((text) => element("option", {}, text)));
}

const source = new EventSource("/live");
source.addEventListener("about", (event) => {
  const told = JSON.parse(event.data);
  if (about?.robots !== told.robots) {
    arena.clear();
    arena.held = null;
    arena.configure(told.arena);
  }
  about = told;
  tell();
});
source.addEventListener("frame", (event) => {
  const frame = JSON.parse(event.data);
  if (byId("message").textContent.startsWith("Preparing")) say("");
  listThings(frame);
  arena.add(frame);
});
source.addEventListener("refused", (event) => say(JSON.parse(event.data).why));
source.addEventListener("error", () => {
  if (source.readyState === EventSource.CLOSED) say("The demo has ended.");
  else if (about) say("The demo cannot be reached; trying again …");
});
source.addEventListener("open", () => { if (about) say(""); });

// -- what is asked of it -----------------------------------------------------------------

byId("fewer").addEventListener("click", () => ask({ robots: about.robots - 1 }));
byId("more").addEventListener("click", () => ask({ robots: about.robots + 1 }));
byId("restart").addEventListener("click", () => ask({ restart: true }));
for (const button of document.querySelectorAll(".shift")) {
  button.addEventListener("click", () => {
    const [thing, number] = byId("thing").value.split(" ");
    const held = { thing, index: Number(number) - 1 };
    const now = arena.frames.at(-1)?.[`${thing}s`][held.index];
    if (!now) return;
    arena.held = held;
    move(held, [now[0] + Number(button.dataset.x), now[1] + Number(button.dataset.y)]);
  });
}

canvas.style.touchAction = "none";
canvas.addEventListener("pointerdown", (event) => {
  if (!arena.arena) return;
  const place = arena.placeOf(event);
  const found = arena.thingAt(place);
  if (!found && arena.held) {
    move(arena.held, place);
    arena.held = null;
  } else if (found) {
    arena.held = found;
    drag = { held: found, from: [event.clientX, event.clientY], moved: false, sent: 0, place };
    canvas.setPointerCapture(event.pointerId);
  }
  arena.drawn = null;
});
canvas.addEventListener("pointermove", (event) => {
  if (!drag) {
    if (arena.arena) canvas.style.cursor = arena.thingAt(arena.placeOf(event)) ? "grab" : arena.held ? "crosshair" : "default";
    return;
  }
  drag.place = arena.placeOf(event);
  drag.moved ||= Math.hypot(event.clientX - drag.from[0], event.clientY - drag.from[1]) > CLICK_PX;
  if (drag.moved && event.timeStamp - drag.sent >= EVERY_MS) {
    drag.sent = event.timeStamp;
    move(drag.held, drag.place);
  }
});
const release = () => {
  if (drag?.moved) {
    move(drag.held, drag.place);
    arena.held = null;
  }
  drag = null;
};
canvas.addEventListener("pointerup", release);
canvas.addEventListener("pointercancel", release);
